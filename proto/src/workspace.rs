use grasp::RequestError;
use grasp_perception::{DepthScale, FoundTable, Tabletop, Workspace};
use nalgebra::Isometry3;

use crate::options::direction;
use crate::pb;
use crate::pose::{self, PoseFields};

/// Largest extent of a workspace, metres.
const MAX_EXTENT: f64 = 2.0;

/// Maximum length of a request id and a frame id, bytes. Both are echoed; the request id is also logged.
const MAX_ID: usize = 256;

const WORKSPACE: PoseFields =
    PoseFields { position: "workspace.pose.position", orientation: "workspace.pose.orientation" };

/// Frame id and time stamp of a volume or of views, echoed in the response.
#[derive(Clone, Debug, Default)]
pub struct FrameStamp {
    /// Name of the caller's frame.
    pub frame_id: String,
    /// Time at which the views were taken.
    pub stamp: Option<prost_types::Timestamp>,
}

impl FrameStamp {
    /// Checks the frame id, which is in the field `field`.
    ///
    /// # Errors
    /// [`RequestError`] if it is too long.
    pub fn checked(
        field: &'static str,
        frame_id: String,
        stamp: Option<prost_types::Timestamp>,
    ) -> Result<Self, RequestError> {
        check_id(field, &frame_id)?;
        Ok(Self { frame_id, stamp })
    }
}

/// Checks the length of a request id or a frame id.
///
/// # Errors
/// [`RequestError`] if it is too long.
pub fn check_id(field: &'static str, id: &str) -> Result<(), RequestError> {
    if id.len() <= MAX_ID {
        return Ok(());
    }
    Err(RequestError::invalid(field, format_args!("{} bytes long", id.len()), format_args!("must be at most {MAX_ID}")))
}

/// Frame id and time stamp are converted by [`FrameStamp::checked`].
impl TryFrom<pb::Workspace> for Workspace {
    type Error = RequestError;

    fn try_from(workspace: pb::Workspace) -> Result<Self, RequestError> {
        let pb::Workspace { pose, size, find_table, gravity, extent, correct_depth_scale, .. } = workspace;
        if !(0.0..=100.0).contains(&size) {
            let needed = "must be above 0 and at most 100 m, or 0 for the size of the model";
            return Err(RequestError::invalid("workspace.size", size, needed));
        }
        if find_table && pose.is_some() {
            return Err(RequestError::invalid("workspace.pose", "given", "must be absent with workspace.find_table"));
        }
        let depth_scale = match correct_depth_scale {
            Some(true) => DepthScale::Correct,
            None if !find_table => DepthScale::Auto,
            None | Some(false) => DepthScale::Keep,
        };
        if find_table && depth_scale == DepthScale::Correct {
            let needed = "must be false with workspace.find_table, which takes the table where the depths show it";
            return Err(RequestError::invalid("workspace.correct_depth_scale", true, needed));
        }
        let frame_from_task = pose.map_or(Ok(Isometry3::identity()), |pose| pose::decode(&pose, &WORKSPACE))?;
        let gravity = gravity.map(|gravity| direction(Some(gravity), "workspace.gravity")).transpose()?;
        let size = Some(size).filter(|size| *size > 0.0);
        let extent = extent.map(checked_extent).transpose()?;
        Ok(Self { frame_from_task, size, find_table, find_objects: None, gravity, extent, depth_scale })
    }
}

impl From<&FoundTable> for pb::FoundTable {
    fn from(table: &FoundTable) -> Self {
        let Tabletop { distance, angle, share, deviation, tilt, .. } = table.tabletop;
        let [x, y] = table.extent;
        Self {
            workspace: Some((&table.frame_from_task).into()),
            distance,
            angle,
            share,
            deviation,
            tilt,
            extent: Some(pb::Extent { x, y }),
            // Fits: an image has at most `u16::MAX` labels.
            objects: table.objects as u32,
        }
    }
}

fn checked_extent(extent: pb::Extent) -> Result<[f64; 2], RequestError> {
    for (field, length) in [("workspace.extent.x", extent.x), ("workspace.extent.y", extent.y)] {
        // Written so that NaN fails.
        if !(length > 0.0 && length <= MAX_EXTENT) {
            let needed = format_args!("must be above 0 and at most {MAX_EXTENT} m");
            return Err(RequestError::invalid(field, length, needed));
        }
    }
    Ok([extent.x, extent.y])
}
