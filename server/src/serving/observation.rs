use std::borrow::Cow;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use grasp::{DepthImage, ObjectMap, View, Warning, depth_factor, seen_from};
use grasp_proto::{FieldError, MAX_VIEWS, Points, Workspace, check_png, cloud_view, depth_view, pb};
use nalgebra::{Isometry3, Point3, Translation3};

use super::scene::sees_nothing;

/// What the cameras of a request saw, in the task frame.
pub(crate) enum Observation {
    Depth(Vec<View>),
    Clouds(Vec<Points>),
}

/// What the cameras saw, and the table that determined the pose of the workspace.
pub(crate) type Placed = (Observation, Option<pb::FoundTable>);

/// What the fusion of a request's views showed. The default is a request with a volume.
#[derive(Default)]
pub(crate) struct Observed {
    /// The time that the request waited for its conversion and fusion.
    pub waited: Duration,
    /// The time that the fusion took.
    pub fusion: Option<Duration>,
    /// Signs that the geometry of the request is wrong.
    pub warnings: Vec<Warning>,
    /// The table that determined the workspace.
    pub table: Option<pb::FoundTable>,
    /// By which the depths of each view were multiplied; empty if they were not to be corrected.
    pub depth_factors: Vec<f64>,
}

/// Labelled pixels of an image, and points of a cloud for its scale, that are used, about.
const SAMPLES: usize = 100_000;

impl Observation {
    /// Depth images. If `find_table` is set, its pose is determined from the table in the first of them, with the
    /// table at the height `table` in cubes with this edge, metres.
    pub fn of_depth(
        views: &mut [pb::DepthView],
        workspace: &mut Workspace,
        table: f64,
        edge: f64,
    ) -> Result<Placed, FieldError> {
        // Before a view is decoded to find the table.
        check_png(views)?;
        let table = workspace.find_table(views, table, edge)?;
        Ok((Self::depth(views, &workspace.frame_from_task)?, table))
    }

    /// Depth images in a workspace of known pose.
    pub fn depth(views: &[pb::DepthView], frame_from_task: &Isometry3<f64>) -> Result<Self, FieldError> {
        if views.len() > MAX_VIEWS {
            let needed = format_args!("must have at most {MAX_VIEWS}");
            return Err(FieldError::new("views", format_args!("a list of {}", views.len()), needed));
        }
        check_png(views)?;
        let views = views.iter().enumerate().map(|(index, view)| depth_view(view, index, frame_from_task));
        Ok(Self::Depth(views.collect::<Result<_, _>>()?))
    }

    /// Point clouds, as [`of_depth`](Self::of_depth).
    pub fn of_clouds(
        views: &[pb::CloudView],
        workspace: &mut Workspace,
        table: f64,
        edge: f64,
    ) -> Result<Placed, FieldError> {
        let table = workspace.find_table_in_clouds(views, table, edge)?;
        let views = views.iter().enumerate();
        let views = views.map(|(index, view)| cloud_view(view, index, &workspace.frame_from_task));
        Ok((Self::Clouds(views.collect::<Result<_, _>>()?), table))
    }

    /// Positions of the cameras in the task frame, metres.
    pub fn cameras(&self) -> Vec<Point3<f64>> {
        match self {
            Self::Depth(views) => views.iter().map(camera).collect(),
            Self::Clouds(clouds) => clouds.iter().map(|cloud| cloud.eye).collect(),
        }
    }

    /// Corrects the scale of the distances in each view, so that the table is at its height. Returns the factors, and
    /// warnings about views without a table. `extent` is that of the workspace, metres.
    pub fn correct_depth_scale(&mut self, table: f64, extent: [f64; 2]) -> (Vec<f64>, Vec<Warning>) {
        let factors: Vec<Option<f64>> = match self {
            Self::Depth(views) => views.iter_mut().map(|view| correct_view(view, table, extent)).collect(),
            Self::Clouds(clouds) => clouds.iter_mut().map(|cloud| correct_cloud(cloud, table, extent)).collect(),
        };
        let missing = factors.iter().enumerate().filter(|(_, factor)| factor.is_none());
        let warnings = missing.map(|(view, _)| Warning::DepthScale { view }).collect();
        (factors.into_iter().map(|factor| factor.unwrap_or(1.0)).collect(), warnings)
    }

    /// View `index` as a depth image, with the pose of the camera (`T_camera_cube`) for a cube at `task_from_cube` with
    /// an edge of `size` metres. A point cloud is rendered.
    pub fn image(
        &self,
        index: usize,
        task_from_cube: &Isometry3<f64>,
        size: f64,
    ) -> Result<(Cow<'_, View>, Isometry3<f64>), FieldError> {
        match self {
            Self::Depth(views) => Ok((Cow::Borrowed(&views[index]), views[index].camera_from_task * task_from_cube)),
            Self::Clouds(clouds) => {
                let Points { points, eye, .. } = &clouds[index];
                let in_cube = task_from_cube.inverse();
                let points: Vec<_> = points.iter().map(|point| in_cube * point).collect();
                let view = seen_from(&points, &(in_cube * eye), size).ok_or_else(|| {
                    let reason = "no point is visible, or the camera is inside the cloud; check camera_position and \
                                  the poses";
                    sees_nothing(index, eye, reason)
                })?;
                let camera_from_cube = view.camera_from_task;
                Ok((Cow::Owned(view), camera_from_cube))
            }
        }
    }

    /// Whether a view has labels.
    pub fn is_labelled(&self) -> bool {
        match self {
            Self::Depth(views) => views.iter().any(|view| view.labels.is_some()),
            Self::Clouds(clouds) => clouds.iter().any(|cloud| cloud.labels.is_some()),
        }
    }

    /// The objects that the labels of the views show, of which `wanted` are to be grasped. `None` without labels.
    pub fn objects(
        &self,
        frame_from_task: &Isometry3<f64>,
        wanted: &BTreeSet<u16>,
    ) -> Result<Option<Arc<ObjectMap>>, FieldError> {
        if !self.is_labelled() {
            return Ok(None);
        }
        let points: Box<dyn Iterator<Item = (Point3<f64>, u16)>> = match self {
            Self::Depth(views) => Box::new(views.iter().flat_map(labelled)),
            Self::Clouds(clouds) => Box::new(clouds.iter().flat_map(|cloud| {
                let labels = cloud.labels.iter().flatten().copied();
                cloud.points.iter().copied().zip(labels)
            })),
        };
        let map = ObjectMap::new(points, frame_from_task, wanted.clone());
        match map.missing() {
            None => Ok(Some(Arc::new(map))),
            Some(label) => {
                let needed = "must have labels of the views only; no pixel or point with a depth has this one";
                Err(FieldError::new("options.objects", format_args!("[…, {label}, …]"), needed))
            }
        }
    }
}

/// Multiplies the depths of a view by the factor that puts the table at its height, and returns it.
fn correct_view(view: &mut View, table: f64, extent: [f64; 2]) -> Option<f64> {
    // An image that does not fit its intrinsics is refused when it is fused.
    let image = DepthImage::new(view.intrinsics, &view.depth).ok()?;
    let factor = image.depth_factor(&view.camera_from_task, table, extent)?;
    view.depth.iter_mut().for_each(|depth| *depth *= factor as f32);
    Some(factor)
}

/// Multiplies the distances of the points from their camera, as [`correct_view`].
fn correct_cloud(cloud: &mut Points, table: f64, extent: [f64; 2]) -> Option<f64> {
    let eye = cloud.eye;
    // Odd, because the points of a sensor are often in rows of an even length.
    let every = (cloud.points.len() / SAMPLES) | 1;
    let factor = depth_factor(cloud.points.iter().step_by(every).copied(), &eye, table, extent)?;
    cloud.points.iter_mut().for_each(|point| *point = eye + factor * (*point - eye));
    Some(factor)
}

fn camera(view: &View) -> Point3<f64> {
    Point3::from(view.camera_from_task.inverse().translation.vector)
}

/// The labelled points of a view in the task frame.
fn labelled(view: &View) -> impl Iterator<Item = (Point3<f64>, u16)> {
    let labels = view.labels.as_deref().unwrap_or_default();
    let width = view.intrinsics.width;
    let task_from_camera = view.camera_from_task.inverse();
    // An image that does not fit its intrinsics is refused when it is fused.
    let image = DepthImage::new(view.intrinsics, &view.depth).ok();
    // Odd, so that the pixels are not in few columns.
    let pixels = labels.iter().enumerate().step_by((labels.len() / SAMPLES) | 1);
    pixels.filter_map(move |(pixel, &label)| {
        let point = image.as_ref()?.point(pixel % width, pixel / width)?;
        Some((task_from_camera * point, label))
    })
}

/// `T_camera_task` of a camera at `position`, of any direction.
pub(crate) fn at(position: &Point3<f64>) -> Isometry3<f64> {
    Isometry3::from(Translation3::from(-position.coords))
}
