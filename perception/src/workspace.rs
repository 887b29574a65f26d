use grasp::{DepthImage, RequestError, WORKSPACE_SIZE};
use nalgebra::{Isometry3, Translation3, Unit, Vector3};

use crate::{CameraPose, Cloud, Frame, Frames, NoTabletop, Tabletop, overview};

/// Where grasps are wanted.
#[derive(Clone, Debug, PartialEq)]
pub struct Workspace {
    /// `T_frame_task`: pose of the workspace in the caller's frame.
    pub frame_from_task: Isometry3<f64>,
    /// Edge of its cubes, metres; `None` means the size of the model.
    pub size: Option<f64>,
    /// Whether to find the table, which determines the pose.
    pub find_table: bool,
    /// Direction of gravity in the caller's frame.
    pub gravity: Option<Unit<Vector3<f64>>>,
    /// Lengths along x and y, metres; `None` means one cube.
    pub extent: Option<[f64; 2]>,
    /// Whether to multiply the depths of each view by a factor that puts the table at its height.
    pub correct_depth_scale: bool,
}

/// The table that determined the pose of a workspace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundTable {
    /// `T_frame_task`: pose of the workspace in the caller's frame.
    pub frame_from_task: Isometry3<f64>,
    /// The table in the image.
    pub tabletop: Tabletop,
}

impl Workspace {
    /// Finds the table in the first of the frames, if `find_table` is set, and sets the pose of the workspace. The table is
    /// at `height` in it, and a workspace without an extent is a cube with this `edge`, metres.
    ///
    /// # Errors
    /// [`RequestError`] if the pose of a camera does not allow it, or the first frame shows no table.
    pub fn find_table(
        &mut self,
        frames: &mut Frames,
        height: f64,
        edge: f64,
    ) -> Result<Option<FoundTable>, RequestError> {
        if !self.find_table {
            return Ok(None);
        }
        let found = match frames {
            Frames::Depth(frames) => {
                let is_in_task = |frame: &Frame| matches!(frame.pose, CameraPose::InTask(_));
                if let Some(index) = frames.iter().skip(1).position(is_in_task) {
                    let needed = "must be frame_from_camera with workspace.find_table, which determines the task frame";
                    let error = RequestError::invalid("extrinsics", "camera_from_task", needed);
                    return Err(error.inside(format_args!("views[{}]", index + 1)));
                }
                let is_only = frames.len() == 1;
                frames.first_mut().map(|frame| self.find_table_in_frame(frame, is_only, height, edge))
            }
            Frames::Clouds(clouds) => clouds.first().map(|cloud| self.find_table_in_cloud(cloud, height, edge)),
        };
        found.transpose().map_err(|error| error.inside("views[0]"))
    }

    /// Finds the table in a frame and sets the pose of the workspace. If it is the only frame and has no pose, its camera
    /// is at the origin of the caller's frame.
    ///
    /// # Errors
    /// [`RequestError`] names the field of the view.
    pub fn find_table_in_frame(
        &mut self,
        frame: &mut Frame,
        is_only: bool,
        height: f64,
        edge: f64,
    ) -> Result<FoundTable, RequestError> {
        if is_only && frame.pose == CameraPose::Unknown {
            frame.pose = CameraPose::InFrame(Isometry3::identity());
        }
        let CameraPose::InFrame(frame_from_camera) = frame.pose else {
            let given = if frame.pose == CameraPose::Unknown { "absent" } else { "camera_from_task" };
            let needed = "must be frame_from_camera with workspace.find_table; a single view may have none";
            return Err(RequestError::invalid("extrinsics", given, needed));
        };
        let found = self.place_on_table(&frame.image, &frame_from_camera, height, edge);
        found.map_err(|error| RequestError::refused("data", error))
    }

    /// Finds the table in a point cloud, rendered from the position of its camera, and sets the pose of the workspace.
    ///
    /// # Errors
    /// [`RequestError`] names the field of the view.
    pub fn find_table_in_cloud(&mut self, cloud: &Cloud, height: f64, edge: f64) -> Result<FoundTable, RequestError> {
        let Cloud { points, eye, .. } = cloud;
        let seen = overview(points, eye).ok_or_else(|| {
            let value = format_args!("({}, {}, {})", eye.x, eye.y, eye.z);
            RequestError::invalid("camera_position", value, "must be the position from which the points were seen")
        })?;
        let found = self.place_on_table(&seen.image, &seen.camera_from_task.inverse(), height, edge);
        found.map_err(|error| RequestError::refused("points", format!("seen from camera_position, {error}")))
    }

    /// Finds the table in an image and sets the pose of the workspace.
    fn place_on_table(
        &mut self,
        image: &DepthImage,
        frame_from_camera: &Isometry3<f64>,
        height: f64,
        edge: f64,
    ) -> Result<FoundTable, NoTabletop> {
        let gravity = self.gravity.map(|gravity| frame_from_camera.rotation.inverse() * gravity);
        let tabletop = Tabletop::find(image, gravity, height)?;
        // The workspace has its middle over that of the cube which was found.
        let corner = self.extent.unwrap_or([edge; 2]).map(|length| (WORKSPACE_SIZE - length) / 2.0);
        let in_cube = Translation3::new(corner[0], corner[1], 0.0);
        self.frame_from_task = frame_from_camera * tabletop.camera_from_task * in_cube;
        Ok(FoundTable { frame_from_task: self.frame_from_task, tabletop })
    }
}

impl Default for Workspace {
    /// A cube of the model's size at the origin of the caller's frame.
    fn default() -> Self {
        Self {
            frame_from_task: Isometry3::identity(),
            size: None,
            find_table: false,
            gravity: None,
            extent: None,
            correct_depth_scale: false,
        }
    }
}
