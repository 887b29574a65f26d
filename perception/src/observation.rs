use std::borrow::Cow;
use std::collections::BTreeSet;

use grasp::{DepthImage, ObjectMap, RequestError};
use nalgebra::{Isometry3, Point3};

use crate::cubes::sees_nothing;
use crate::{Cloud, Frame, View, Warning, depth_factor, image_depth_factor, plausible_depth_factor, seen_from};

/// What the cameras of a request saw, as it was sent.
#[derive(Clone, Debug)]
pub enum Frames {
    /// Depth images.
    Depth(Vec<Frame>),
    /// Point clouds in the caller's frame.
    Clouds(Vec<Cloud>),
}

/// What the cameras of a request saw, in the task frame.
#[derive(Clone, Debug)]
pub enum Observation {
    /// Depth images.
    Depth(Vec<View>),
    /// Point clouds.
    Clouds(Vec<Cloud>),
}

/// About this many labelled pixels of an image, and points of a cloud for its scale, are used.
const SAMPLES: usize = 100_000;

impl Frames {
    /// The observation in a task frame at `frame_from_task`.
    ///
    /// # Errors
    /// [`RequestError`] names the view with an unknown pose.
    pub fn in_task(self, frame_from_task: &Isometry3<f64>) -> Result<Observation, RequestError> {
        Ok(match self {
            Self::Depth(frames) => {
                let view = |(index, frame): (usize, Frame)| {
                    frame.in_task(frame_from_task).map_err(|error| error.inside(format_args!("views[{index}]")))
                };
                Observation::Depth(frames.into_iter().enumerate().map(view).collect::<Result<_, _>>()?)
            }
            Self::Clouds(clouds) => {
                Observation::Clouds(clouds.into_iter().map(|cloud| cloud.in_task(frame_from_task)).collect())
            }
        })
    }
}

impl Observation {
    /// Positions of the cameras, metres.
    #[must_use]
    pub fn eyes(&self) -> Vec<Point3<f64>> {
        match self {
            Self::Depth(views) => views.iter().map(View::eye).collect(),
            Self::Clouds(clouds) => clouds.iter().map(|cloud| cloud.eye).collect(),
        }
    }

    /// Corrects the scale of the distances in each depth image where the table shows that it is wrong. Returns the
    /// factors, and warnings about those that moved the table visibly. Point clouds may be merged from several cameras,
    /// so theirs is not corrected. `extent` is that of the workspace, metres.
    pub(crate) fn correct_plausible_depth_scale(&mut self, table: f64, extent: [f64; 2]) -> (Vec<f64>, Vec<Warning>) {
        let Self::Depth(views) = self else { return Default::default() };
        let (mut factors, mut warnings) = (Vec::new(), Vec::new());
        for (index, view) in views.iter_mut().enumerate() {
            let factor = plausible_depth_factor(&view.image, &view.camera_from_task, table, extent).unwrap_or(1.0);
            if factor != 1.0 {
                view.image.scale(factor);
            }
            warnings.extend(Warning::of_depth_factor(index, factor, &view.eye(), table));
            factors.push(factor);
        }
        (factors, warnings)
    }

    /// Corrects the scale of the distances in each view, so that the table is at its height. Returns the factors, and
    /// warnings about views without a table. `extent` is that of the workspace, metres.
    pub(crate) fn correct_depth_scale(&mut self, table: f64, extent: [f64; 2]) -> (Vec<f64>, Vec<Warning>) {
        let of_view = |view: &mut View| {
            let factor = image_depth_factor(&view.image, &view.camera_from_task, table, extent)?;
            view.image.scale(factor);
            Some(factor)
        };
        let of_cloud = |cloud: &mut Cloud| {
            // Odd, because the points of a sensor are often in rows of an even length.
            let every = (cloud.points.len() / SAMPLES) | 1;
            let factor = depth_factor(cloud.points.iter().step_by(every).copied(), &cloud.eye, table, extent)?;
            cloud.scale(factor);
            Some(factor)
        };
        let factors: Vec<Option<f64>> = match self {
            Self::Depth(views) => views.iter_mut().map(of_view).collect(),
            Self::Clouds(clouds) => clouds.iter_mut().map(of_cloud).collect(),
        };
        let missing = factors.iter().enumerate().filter(|(_, factor)| factor.is_none());
        let warnings = missing.map(|(view, _)| Warning::DepthScale { view }).collect();
        (factors.into_iter().map(|factor| factor.unwrap_or(1.0)).collect(), warnings)
    }

    /// View `index` as a depth image, with the pose of the camera (`T_camera_cube`) for a cube at `task_from_cube` with
    /// an edge of `size` metres. A point cloud is rendered.
    pub(crate) fn image(
        &self,
        index: usize,
        task_from_cube: &Isometry3<f64>,
        size: f64,
    ) -> Result<(Cow<'_, DepthImage<'static>>, Isometry3<f64>), RequestError> {
        match self {
            Self::Depth(views) => {
                Ok((Cow::Borrowed(&views[index].image), views[index].camera_from_task * task_from_cube))
            }
            Self::Clouds(clouds) => {
                let Cloud { points, eye, .. } = &clouds[index];
                let in_cube = task_from_cube.inverse();
                let points: Vec<_> = points.iter().map(|point| in_cube * point).collect();
                let view = seen_from(&points, &(in_cube * eye), size).ok_or_else(|| {
                    let reason = "no point is visible, or the camera is inside the cloud; check camera_position and \
                                  the poses";
                    sees_nothing(index, eye, reason)
                })?;
                Ok((Cow::Owned(view.image), view.camera_from_task))
            }
        }
    }

    /// Whether a view has labels.
    pub(crate) fn is_labelled(&self) -> bool {
        match self {
            Self::Depth(views) => views.iter().any(|view| view.labels.is_some()),
            Self::Clouds(clouds) => clouds.iter().any(|cloud| cloud.labels.is_some()),
        }
    }

    /// The objects that the labels of the views show. Those in `wanted` are to be grasped, or all surfaces if it is
    /// `None`. Returns `None` without labels.
    pub(crate) fn objects(
        &self,
        frame_from_task: &Isometry3<f64>,
        wanted: Option<&BTreeSet<u16>>,
    ) -> Option<ObjectMap> {
        if !self.is_labelled() {
            return None;
        }
        let points: Box<dyn Iterator<Item = (Point3<f64>, u16)>> = match self {
            Self::Depth(views) => Box::new(views.iter().flat_map(labelled)),
            Self::Clouds(clouds) => Box::new(clouds.iter().flat_map(|cloud| {
                let labels = cloud.labels.iter().flatten().copied();
                cloud.points.iter().copied().zip(labels)
            })),
        };
        Some(ObjectMap::new(points, frame_from_task, wanted.cloned()))
    }
}

/// The labelled points of a view in the task frame.
fn labelled(view: &View) -> impl Iterator<Item = (Point3<f64>, u16)> {
    let labels = view.labels.as_deref().unwrap_or_default();
    let width = view.intrinsics().width;
    let task_from_camera = view.camera_from_task.inverse();
    // Odd, so that the samples are spread over all columns.
    let pixels = labels.iter().enumerate().step_by((labels.len() / SAMPLES) | 1);
    pixels.filter_map(move |(pixel, &label)| {
        let point = view.image.point(pixel % width, pixel / width)?;
        Some((task_from_camera * point, label))
    })
}
