use std::collections::BTreeSet;

use grasp::{DepthImage, RequestError, WORKSPACE_SIZE};
use nalgebra::{Isometry3, Translation3, Unit, Vector3};

use crate::layout::{OBJECT_MARGIN, cover_objects};
use crate::segmentation::{Object, Segmentation};
use crate::{CameraPose, Cloud, DepthScale, Frame, Frames, NoTabletop, Tabletop, View, overview};

/// Where grasps are wanted.
#[derive(Clone, Debug, PartialEq)]
pub struct Workspace {
    /// `T_frame_task`: pose of the workspace in the caller's frame.
    pub frame_from_task: Isometry3<f64>,
    /// Edge of its cubes, metres; `None` means the size of the model.
    pub size: Option<f64>,
    /// Whether to find the table, which determines the pose.
    pub find_table: bool,
    /// Whether to find the objects on that table, and the largest number of cubes for them: grasps are on these objects
    /// only, and without an extent the workspace covers all of them.
    pub find_objects: Option<usize>,
    /// Direction of gravity in the caller's frame.
    pub gravity: Option<Unit<Vector3<f64>>>,
    /// Lengths along x and y, metres; `None` means one cube.
    pub extent: Option<[f64; 2]>,
    /// Whether to multiply the depths of each view by a factor that puts the table at its height.
    pub depth_scale: DepthScale,
}

/// The table that determined the pose of a workspace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundTable {
    /// `T_frame_task`: pose of the workspace in the caller's frame.
    pub frame_from_task: Isometry3<f64>,
    /// The table in the image.
    pub tabletop: Tabletop,
    /// Lengths of the workspace along x and y, metres.
    pub extent: [f64; 2],
    /// Number of objects that stand on the table.
    pub objects: usize,
}

/// What is on a table, in the frame of the workspace.
#[derive(Clone, Debug)]
pub(crate) struct Standing {
    /// The objects.
    pub objects: Vec<Object>,
    /// Their labels in the first frame, if the segmentation labelled it.
    pub labels: Option<BTreeSet<u16>>,
}

/// The cubes that hold the objects on a table, in the frame of the workspace.
#[derive(Clone, Debug)]
pub(crate) struct Cover {
    /// Corners of the cubes, metres.
    pub corners: Vec<[f64; 2]>,
    /// Lengths of the workspace around them along x and y, metres.
    pub extent: [f64; 2],
    /// Number of objects that are in none of them.
    pub left_out: usize,
}

/// Maximum number of cubes of a workspace that covers the objects on a table.
const MAX_FOUND_CUBES: usize = 12;

impl Workspace {
    /// Finds the table in the first of the frames, if `find_table` is set, and sets the pose of the workspace. The
    /// table is at `height` in it, and a workspace without an extent is a cube with this `edge`, metres.
    ///
    /// # Errors
    /// [`RequestError`] if the pose of a camera does not allow it, or the first frame shows no table.
    pub fn find_table(
        &mut self,
        frames: &mut Frames,
        height: f64,
        edge: f64,
    ) -> Result<Option<FoundTable>, RequestError> {
        self.find(frames, height, edge).map(|found| found.map(|(table, _)| table))
    }

    /// Finds the table and what stands on it.
    pub(crate) fn find(
        &mut self,
        frames: &mut Frames,
        height: f64,
        edge: f64,
    ) -> Result<Option<(FoundTable, Standing)>, RequestError> {
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
                frames.first_mut().map(|frame| {
                    let (table, segmentation) = self.find_in_frame(frame, is_only, height, edge)?;
                    // With several views an object would have a different label in each.
                    let labels = (self.find_objects.is_some() && is_only && frame.labels.is_none()).then(|| {
                        frame.labels = Some(segmentation.labels(&frame.image));
                        segmentation.labels_of_objects()
                    });
                    Ok((table, Standing { objects: segmentation.objects, labels }))
                })
            }
            Frames::Clouds(clouds) => {
                let is_only = clouds.len() == 1;
                clouds.first_mut().map(|cloud| {
                    let (table, segmentation, seen) = self.find_in_cloud(cloud, height, edge)?;
                    let labels = (self.find_objects.is_some() && is_only && cloud.labels.is_none()).then(|| {
                        cloud.labels = Some(seen.labels_of(&cloud.points, &segmentation.labels(&seen.image)));
                        segmentation.labels_of_objects()
                    });
                    Ok((table, Standing { objects: segmentation.objects, labels }))
                })
            }
        };
        found.transpose().map_err(|error: RequestError| error.inside("views[0]"))
    }

    /// Finds the table in a frame and sets the pose of the workspace. If it is the only frame and has no pose, its
    /// camera is at the origin of the caller's frame.
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
        self.find_in_frame(frame, is_only, height, edge).map(|(table, _)| table)
    }

    fn find_in_frame(
        &mut self,
        frame: &mut Frame,
        is_only: bool,
        height: f64,
        edge: f64,
    ) -> Result<(FoundTable, Segmentation), RequestError> {
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
        self.find_in_cloud(cloud, height, edge).map(|(table, ..)| table)
    }

    fn find_in_cloud(
        &mut self,
        cloud: &Cloud,
        height: f64,
        edge: f64,
    ) -> Result<(FoundTable, Segmentation, View), RequestError> {
        let Cloud { points, eye, .. } = cloud;
        let seen = overview(points, eye).ok_or_else(|| {
            let value = format_args!("({}, {}, {})", eye.x, eye.y, eye.z);
            RequestError::invalid("camera_position", value, "must be the position from which the points were seen")
        })?;
        let found = self.place_on_table(&seen.image, &seen.camera_from_task.inverse(), height, edge);
        let refused = |error| RequestError::refused("points", format!("seen from camera_position, {error}"));
        found.map(|(table, segmentation)| (table, segmentation, seen)).map_err(refused)
    }

    /// Finds the table in an image and sets the pose of the workspace.
    fn place_on_table(
        &mut self,
        image: &DepthImage,
        frame_from_camera: &Isometry3<f64>,
        height: f64,
        edge: f64,
    ) -> Result<(FoundTable, Segmentation), NoTabletop> {
        let gravity = self.gravity.map(|gravity| frame_from_camera.rotation.inverse() * gravity);
        let (tabletop, segmentation) = Tabletop::find_with_objects(image, gravity, height)?;
        self.frame_from_task = frame_from_camera * tabletop.camera_from_task;
        // The workspace is centred on the cube that was found.
        let extent = self.extent.unwrap_or([edge; 2]);
        let corner = extent.map(|length| (WORKSPACE_SIZE - length) / 2.0);
        let objects = segmentation.objects.len();
        let mut table = FoundTable { frame_from_task: self.frame_from_task, tabletop, extent, objects };
        let segmentation = segmentation.moved(self.moved(&mut table, corner));
        Ok((table, segmentation))
    }

    /// Moves the corner of the workspace by `corner` along the table. Returns the shift of points in its frame.
    fn moved(&mut self, table: &mut FoundTable, corner: [f64; 2]) -> [f64; 2] {
        self.frame_from_task *= Translation3::new(corner[0], corner[1], 0.0);
        table.frame_from_task = self.frame_from_task;
        corner.map(|c| -c)
    }

    /// Places cubes with this `edge` over all objects on the table, and the workspace around them. `None` if that was
    /// not requested, there are no objects, or a cube has no room between its margins.
    pub(crate) fn cover(
        &mut self,
        table: &mut FoundTable,
        objects: &[Object],
        edge: f64,
        margin: f64,
    ) -> Option<Cover> {
        let limit = self.find_objects.filter(|_| self.extent.is_none())?.min(MAX_FOUND_CUBES);
        let margin = margin.max(OBJECT_MARGIN);
        if edge <= 2.0 * margin {
            return None;
        }
        let (corners, left_out) = cover_objects(objects, edge, margin, limit);
        if let [corner] = corners[..]
            && corner.iter().all(|c| c.abs() < 1e-9)
        {
            // The workspace is this cube already. Moving it would only add rounding errors.
            return Some(Cover { corners: vec![[0.0; 2]], extent: table.extent, left_out });
        }
        let lowest = [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).fold(f64::INFINITY, f64::min));
        let highest = [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).fold(f64::NEG_INFINITY, f64::max));
        if corners.is_empty() {
            return None;
        }
        table.extent = [0, 1].map(|axis| highest[axis] - lowest[axis] + edge);
        let [x, y] = self.moved(table, lowest);
        let corners = corners.iter().map(|corner| [corner[0] + x, corner[1] + y]).collect();
        Some(Cover { corners, extent: table.extent, left_out })
    }
}

impl Default for Workspace {
    /// A cube of the model's size at the origin of the caller's frame.
    fn default() -> Self {
        Self {
            frame_from_task: Isometry3::identity(),
            size: None,
            find_table: false,
            find_objects: None,
            gravity: None,
            extent: None,
            depth_scale: DepthScale::default(),
        }
    }
}
