use std::borrow::Cow;
use std::collections::BTreeSet;
use std::sync::Arc;

use grasp::{DepthImage, ObjectMap, View, seen_from};
use grasp_proto::{FieldError, Points};
use nalgebra::{Isometry3, Point3, Translation3};

use super::scene::sees_nothing;

/// What the cameras of a request saw, in the task frame.
pub(crate) enum Observation {
    Depth(Vec<View>),
    Clouds(Vec<Points>),
}

/// Labelled pixels of an image that are used, about.
const LABELS: usize = 100_000;

impl Observation {
    /// Positions of the cameras in the task frame, metres.
    pub fn cameras(&self) -> Vec<Point3<f64>> {
        match self {
            Self::Depth(views) => views.iter().map(camera).collect(),
            Self::Clouds(clouds) => clouds.iter().map(|cloud| cloud.eye).collect(),
        }
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
    let pixels = labels.iter().enumerate().step_by((labels.len() / LABELS) | 1);
    pixels.filter_map(move |(pixel, &label)| {
        let point = image.as_ref()?.point(pixel % width, pixel / width)?;
        Some((task_from_camera * point, label))
    })
}

/// `T_camera_task` of a camera at `position`, of any direction.
pub(crate) fn at(position: &Point3<f64>) -> Isometry3<f64> {
    Isometry3::from(Translation3::from(-position.coords))
}
