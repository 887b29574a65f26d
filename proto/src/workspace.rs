use grasp::{DepthImage, NoTabletop, Tabletop, WORKSPACE_SIZE, overview};
use nalgebra::{Isometry3, Translation3, Unit, Vector3};

use crate::options::direction;
use crate::pb::depth_view::Extrinsics;
use crate::pose::{self, PoseFields};
use crate::views::{FRAME_FROM_CAMERA, Points, image, try_cloud_view};
use crate::{FieldError, pb};

/// Largest extent of a workspace, metres.
const MAX_EXTENT: f64 = 2.0;

const WORKSPACE: PoseFields =
    PoseFields { position: "workspace.pose.position", orientation: "workspace.pose.orientation" };

/// The validated workspace.
#[derive(Clone, Debug, PartialEq)]
pub struct Workspace {
    /// `T_frame_task`: pose of the workspace in the caller's frame.
    pub frame_from_task: Isometry3<f64>,
    /// Edge, metres; `None` means the size of the model.
    pub size: Option<f64>,
    /// Name of the caller's frame.
    pub frame_id: String,
    /// Time at which the views were taken.
    pub stamp: Option<prost_types::Timestamp>,
    /// Whether to find the table, which determines the pose.
    pub find_table: bool,
    /// Direction of gravity in the caller's frame.
    pub gravity: Option<Unit<Vector3<f64>>>,
    /// Lengths along x and y, metres; `None` means one cube.
    pub extent: Option<[f64; 2]>,
    /// Whether to multiply the depths of each view by a factor that puts the table at its height.
    pub correct_depth_scale: bool,
}

impl TryFrom<pb::Workspace> for Workspace {
    type Error = FieldError;

    fn try_from(workspace: pb::Workspace) -> Result<Self, FieldError> {
        let pb::Workspace { pose, size, frame_id, stamp, find_table, gravity, extent, correct_depth_scale } = workspace;
        if !(0.0..=100.0).contains(&size) {
            return Err(FieldError::new(
                "workspace.size",
                size,
                "must be above 0 and at most 100 m, or 0 for the size of the model",
            ));
        }
        if find_table && pose.is_some() {
            return Err(FieldError::new("workspace.pose", "given", "must be absent with workspace.find_table"));
        }
        if find_table && correct_depth_scale {
            let needed = "must be false with workspace.find_table, which takes the table where the depths show it";
            return Err(FieldError::new("workspace.correct_depth_scale", true, needed));
        }
        let frame_from_task = pose.map_or(Ok(Isometry3::identity()), |pose| pose::decode(&pose, &WORKSPACE))?;
        let gravity = gravity.map(|gravity| direction(Some(gravity), "workspace.gravity")).transpose()?;
        let size = Some(size).filter(|size| *size > 0.0);
        let extent = extent.map(checked_extent).transpose()?;
        Ok(Self { frame_from_task, size, frame_id, stamp, find_table, gravity, extent, correct_depth_scale })
    }
}

impl Workspace {
    /// Finds the table in the first of the request's views, if `find_table` is set, and sets the pose of the
    /// workspace. The table is at `height` in it, and a workspace without an extent is a cube with this `edge`, metres.
    ///
    /// # Errors
    /// [`FieldError`] if the view is invalid or shows no table.
    pub fn find_table(
        &mut self,
        views: &mut [pb::DepthView],
        height: f64,
        edge: f64,
    ) -> Result<Option<pb::FoundTable>, FieldError> {
        let is_only = views.len() == 1;
        let Some((first, others)) = views.split_first_mut().filter(|_| self.find_table) else { return Ok(None) };
        let in_task = |view: &pb::DepthView| matches!(view.extrinsics, Some(Extrinsics::CameraFromTask(_)));
        if let Some(index) = others.iter().position(in_task) {
            let needed = "must be frame_from_camera with workspace.find_table, which determines the task frame";
            let error = FieldError::new("extrinsics", "camera_from_task", needed);
            return Err(error.inside(format_args!("views[{}]", index + 1)));
        }
        let found = self.find_table_in(first, is_only, height, edge);
        found.map(Some).map_err(|error| error.inside("views[0]"))
    }

    /// Finds the table in a view and sets the pose of the workspace. If it is the only view and has no extrinsics, it
    /// gets those of a camera at the origin of the caller's frame. A PNG is replaced by its depths.
    ///
    /// # Errors
    /// [`FieldError`] names the field of the view.
    pub fn find_table_in(
        &mut self,
        view: &mut pb::DepthView,
        is_only: bool,
        height: f64,
        edge: f64,
    ) -> Result<pb::FoundTable, FieldError> {
        if is_only && view.extrinsics.is_none() {
            view.extrinsics = Some(Extrinsics::FrameFromCamera((&Isometry3::identity()).into()));
        }
        let Some(Extrinsics::FrameFromCamera(pose)) = &view.extrinsics else {
            let given = if view.extrinsics.is_some() { "camera_from_task" } else { "absent" };
            let needed = "must be frame_from_camera with workspace.find_table; a single view may have none";
            return Err(FieldError::new("extrinsics", given, needed));
        };
        let frame_from_camera = pose::decode(pose, &FRAME_FROM_CAMERA)?;
        let (intrinsics, depth) = image(view)?;
        if view.unit() == pb::DepthUnit::PngMillimetres {
            // So that the fusion does not decode the file again.
            view.data = depth.iter().flat_map(|depth| depth.to_le_bytes()).collect();
            view.set_unit(pb::DepthUnit::F32Metres);
        }
        let image = DepthImage::new(intrinsics, &depth).map_err(|error| FieldError::refused("camera", error))?;
        let found = self.place_on_table(&image, &frame_from_camera, height, edge);
        found.map_err(|error| FieldError::refused("data", error))
    }

    /// Finds the table in the first of the request's point clouds, if `find_table` is set, and sets the pose of the
    /// workspace.
    ///
    /// # Errors
    /// [`FieldError`] if the cloud is invalid or shows no table.
    pub fn find_table_in_clouds(
        &mut self,
        views: &[pb::CloudView],
        height: f64,
        edge: f64,
    ) -> Result<Option<pb::FoundTable>, FieldError> {
        match views.first() {
            Some(first) if self.find_table => {
                let found = self.find_table_in_cloud(first, height, edge);
                found.map(Some).map_err(|error| error.inside("views[0]"))
            }
            _ => Ok(None),
        }
    }

    /// Finds the table in a point cloud, rendered from the position of its camera, and sets the pose of the workspace.
    ///
    /// # Errors
    /// [`FieldError`] names the field of the view.
    pub fn find_table_in_cloud(
        &mut self,
        view: &pb::CloudView,
        height: f64,
        edge: f64,
    ) -> Result<pb::FoundTable, FieldError> {
        let Points { points, eye, .. } = try_cloud_view(view, &Isometry3::identity())?;
        let seen = overview(&points, &eye).ok_or_else(|| {
            let value = format_args!("({}, {}, {})", eye.x, eye.y, eye.z);
            FieldError::new("camera_position", value, "must be the position from which the points were seen")
        })?;
        let image = DepthImage::new(seen.intrinsics, &seen.depth);
        let image = image.map_err(|error| FieldError::refused("points", error))?;
        let found = self.place_on_table(&image, &seen.camera_from_task.inverse(), height, edge);
        found.map_err(|error| FieldError::refused("points", format!("seen from camera_position, {error}")))
    }

    /// Finds the table in an image and sets the pose of the workspace.
    fn place_on_table(
        &mut self,
        image: &DepthImage,
        frame_from_camera: &Isometry3<f64>,
        height: f64,
        edge: f64,
    ) -> Result<pb::FoundTable, NoTabletop> {
        let gravity = self.gravity.map(|gravity| frame_from_camera.rotation.inverse() * gravity);
        let found = Tabletop::find(image, gravity, height)?;
        // The workspace has its middle over that of the cube which was found.
        let corner = self.extent.unwrap_or([edge; 2]).map(|length| (WORKSPACE_SIZE - length) / 2.0);
        let in_cube = Translation3::new(corner[0], corner[1], 0.0);
        self.frame_from_task = frame_from_camera * found.camera_from_task * in_cube;
        let Tabletop { distance, angle, share, deviation, tilt, .. } = found;
        Ok(pb::FoundTable { workspace: Some((&self.frame_from_task).into()), distance, angle, share, deviation, tilt })
    }
}

fn checked_extent(extent: pb::Extent) -> Result<[f64; 2], FieldError> {
    for (field, length) in [("workspace.extent.x", extent.x), ("workspace.extent.y", extent.y)] {
        // Written so that NaN fails.
        if !(length > 0.0 && length <= MAX_EXTENT) {
            return Err(FieldError::new(field, length, format_args!("must be above 0 and at most {MAX_EXTENT} m")));
        }
    }
    Ok([extent.x, extent.y])
}
