use grasp::{DepthImage, Intrinsics, RequestError};
use nalgebra::{Isometry3, Point3};

/// A depth image as a camera sent it, with what is known of the camera's pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The image.
    pub image: DepthImage<'static>,
    /// Label of the object that each pixel shows, row by row, if it is known; 0 is no object.
    pub labels: Option<Vec<u16>>,
    /// Pose of the camera.
    pub pose: CameraPose,
}

/// What is known of a camera's pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CameraPose {
    /// `T_camera_task`.
    InTask(Isometry3<f64>),
    /// `T_frame_camera`, in the caller's frame.
    InFrame(Isometry3<f64>),
    /// Nothing. Only with [`Workspace::find_table`](crate::Workspace::find_table) and a single frame, whose camera is
    /// then the caller's frame.
    Unknown,
}

/// A depth image in the task frame.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The image.
    pub image: DepthImage<'static>,
    /// `T_camera_task`.
    pub camera_from_task: Isometry3<f64>,
    /// Label of the object that each pixel shows, row by row, if it is known; 0 is no object.
    pub labels: Option<Vec<u16>>,
}

/// The points that one camera saw, in the caller's frame or in the task frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Cloud {
    /// The points, metres.
    pub points: Vec<Point3<f64>>,
    /// Position of the camera, metres.
    pub eye: Point3<f64>,
    /// Label of the object of each point, if it is known; 0 is no object.
    pub labels: Option<Vec<u16>>,
}

impl Frame {
    /// The view in a task frame at `frame_from_task`.
    ///
    /// # Errors
    /// [`RequestError`] if the pose of the camera is unknown.
    pub fn in_task(self, frame_from_task: &Isometry3<f64>) -> Result<View, RequestError> {
        let Self { image, labels, pose } = self;
        let camera_from_task = match pose {
            CameraPose::InTask(camera_from_task) => camera_from_task,
            CameraPose::InFrame(frame_from_camera) => frame_from_camera.inverse() * frame_from_task,
            CameraPose::Unknown => {
                let needed = "camera_from_task (T_camera_task) or frame_from_camera (T_frame_camera) must be given";
                return Err(RequestError::invalid("extrinsics", "absent", needed));
            }
        };
        Ok(View { image, camera_from_task, labels })
    }
}

impl View {
    /// Intrinsics of the camera.
    #[must_use]
    pub fn intrinsics(&self) -> Intrinsics {
        *self.image.intrinsics()
    }

    /// The labels of points of the task frame, given those of the pixels: 0 for a point that no pixel shows.
    pub(crate) fn labels_of(&self, points: &[Point3<f64>], labels: &[u16]) -> Vec<u16> {
        /// Largest distance of a point from the depth of its pixel, metres.
        const TOLERANCE: f64 = 0.01;
        let Intrinsics { width, height, fx, fy, cx, cy } = self.intrinsics();
        let label = |point: &Point3<f64>| {
            let p = self.camera_from_task * point;
            let [u, v] = [p.x / p.z * fx + cx, p.y / p.z * fy + cy].map(f64::round);
            let is_inside = p.z > 0.0 && u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64;
            let index = is_inside.then(|| v as usize * width + u as usize)?;
            ((f64::from(self.image.depth()[index]) - p.z).abs() <= TOLERANCE).then(|| labels[index])
        };
        points.iter().map(|point| label(point).unwrap_or(0)).collect()
    }

    /// Position of the camera, metres.
    #[must_use]
    pub fn eye(&self) -> Point3<f64> {
        self.camera_from_task.inverse().translation.vector.into()
    }
}

impl Cloud {
    /// The cloud in a task frame at `frame_from_task`.
    #[must_use]
    pub fn in_task(mut self, frame_from_task: &Isometry3<f64>) -> Self {
        let task_from_frame = frame_from_task.inverse();
        self.points.iter_mut().for_each(|point| *point = task_from_frame * *point);
        self.eye = task_from_frame * self.eye;
        self
    }

    /// Multiplies the distances of the points from their camera.
    pub fn scale(&mut self, factor: f64) {
        let eye = self.eye;
        self.points.iter_mut().for_each(|point| *point = eye + factor * (*point - eye));
    }
}
