use std::time::{Duration, SystemTime};

use grasp::{Grasp, Volume};
use grasp_proto::{encode, pb};
use nalgebra::Isometry3;

use crate::Error;

/// What may be said along with what was seen. The default leaves everything to the server.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Names the request in the reply and the server's log; generated there when empty.
    pub request_id: String,
    /// What is asked of the grasps: which planner, how good, where, for which hand.
    pub detect: pb::Options,
    /// The frame of the volume's or the workspace's pose and of the grasps; echoed.
    pub frame_id: String,
    /// When it was seen; echoed.
    pub stamp: Option<SystemTime>,
    /// How a volume's values travel: F32 (also when unspecified), or half or a quarter of it.
    pub dtype: pb::DataType,
    /// How long each attempt may take, as the server is told, too.
    pub timeout: Option<Duration>,
}

/// A depth image as a camera's driver gives it, and where the camera stood.
#[derive(Clone, Debug)]
pub struct DepthView {
    /// The pixels.
    pub depth: Depth,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// The intrinsic matrix, row by row (ROS: `CameraInfo.k`).
    pub k: [f64; 9],
    /// Where the camera stood.
    pub extrinsics: Extrinsics,
}

/// Pixels of a depth image, row by row; 0 and NaN are no reading.
#[derive(Clone, Debug)]
pub enum Depth {
    /// Along the optical axis.
    Metres(Vec<f32>),
    /// The same, in whole millimetres.
    Millimetres(Vec<u16>),
}

/// A camera's pose, in one of its two directions. Optical axes: z forward, x right, y down.
#[derive(Clone, Copy, Debug)]
pub enum Extrinsics {
    /// `T_camera_task`: maps points of the workspace's cube into the camera.
    CameraFromTask(Isometry3<f64>),
    /// `T_frame_camera`: where the camera stands in the workspace's frame, as hand-eye calibration gives it.
    FrameFromCamera(Isometry3<f64>),
}

/// Points that one camera saw.
#[derive(Clone, Debug)]
pub struct CloudView {
    /// x, y, z, metres.
    pub points: Vec<[f32; 3]>,
    /// `T_frame_cloud`: the points in the workspace's frame.
    pub frame_from_cloud: Isometry3<f64>,
    /// Where the camera stood, in the frame of the points.
    pub camera_position: [f64; 3],
}

/// The cube in which grasps are looked for.
#[derive(Clone, Copy, Debug, Default)]
pub struct Workspace {
    /// `T_frame_task`: the cube's corner, z up.
    pub pose: Isometry3<f64>,
    /// Edge, metres; the model's own where it is `None`.
    pub size: Option<f64>,
}

/// The answer to what was seen.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// The request's id.
    pub request_id: String,
    /// The frame of the grasps.
    pub frame_id: String,
    /// When it was seen.
    pub stamp: Option<SystemTime>,
    /// Best first.
    pub grasps: Vec<Proposal>,
    /// The planner that answered.
    pub model: String,
    /// Its version.
    pub version: String,
    /// Where the time went in the server, seconds.
    pub latency: pb::Latency,
    /// Why the other voxels hold no grasp, when that was asked for or there is none.
    pub dropped: Option<pb::Dropped>,
}

/// A grasp, and the way there and away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Proposal {
    /// `T_frame_grasp`, by the convention that was asked for.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers, metres.
    pub width: f64,
    /// Predicted probability of success, [0, 1].
    pub quality: f32,
    /// Where the hand waits, open, before it approaches.
    pub pregrasp: Isometry3<f64>,
    /// Where the hand goes with what it holds.
    pub retreat: Isometry3<f64>,
    /// Whether the open hand would meet something, where that was asked.
    pub collides: Option<bool>,
}

impl From<&Proposal> for Grasp {
    fn from(proposal: &Proposal) -> Self {
        Self { pose: proposal.pose, width: proposal.width, quality: proposal.quality }
    }
}

impl TryFrom<&pb::Grasp> for Proposal {
    type Error = Error;

    fn try_from(message: &pb::Grasp) -> Result<Self, Error> {
        let Grasp { pose, width, quality } = message.try_into()?;
        let way = |pose: &Option<pb::Pose>, field| {
            pose.as_ref().map(|pose| grasp_proto::pose(pose, field)).transpose().map(Option::unwrap_or_default)
        };
        let pregrasp = way(&message.pregrasp, "grasps.pregrasp")?;
        let retreat = way(&message.retreat, "grasps.retreat")?;
        Ok(Self { pose, width, quality, pregrasp, retreat, collides: message.collides })
    }
}

impl Options {
    pub(crate) fn request(self, volume: &Volume) -> pb::DetectGraspsRequest {
        let mut volume = encode(volume, self.dtype, self.frame_id);
        volume.stamp = self.stamp.map(Into::into);
        pb::DetectGraspsRequest { request_id: self.request_id, volume: Some(volume), options: Some(self.detect) }
    }

    pub(crate) fn depth_request(self, views: &[DepthView], workspace: &Workspace) -> pb::DetectGraspsFromDepthRequest {
        pb::DetectGraspsFromDepthRequest {
            views: views.iter().map(Into::into).collect(),
            workspace: Some(workspace.message(self.frame_id, self.stamp)),
            request_id: self.request_id,
            options: Some(self.detect),
        }
    }

    pub(crate) fn cloud_request(self, views: &[CloudView], workspace: &Workspace) -> pb::DetectGraspsFromCloudRequest {
        pb::DetectGraspsFromCloudRequest {
            views: views.iter().map(Into::into).collect(),
            workspace: Some(workspace.message(self.frame_id, self.stamp)),
            request_id: self.request_id,
            options: Some(self.detect),
        }
    }

    /// With a workspace it starts a volume.
    pub(crate) fn track_request(self, views: &[DepthView], workspace: Option<&Workspace>) -> pb::TrackGraspsRequest {
        pb::TrackGraspsRequest {
            views: views.iter().map(Into::into).collect(),
            workspace: workspace.map(|workspace| workspace.message(self.frame_id, self.stamp)),
            request_id: self.request_id,
            options: Some(self.detect),
        }
    }
}

impl Workspace {
    fn message(&self, frame_id: String, stamp: Option<SystemTime>) -> pb::Workspace {
        let pose = Some((&self.pose).into());
        pb::Workspace { pose, size: self.size.unwrap_or_default(), frame_id, stamp: stamp.map(Into::into) }
    }
}

impl From<&DepthView> for pb::DepthView {
    fn from(view: &DepthView) -> Self {
        use pb::depth_view::Extrinsics as Message;
        let (data, unit): (Vec<u8>, _) = match &view.depth {
            Depth::Metres(depth) => (depth.iter().flat_map(|d| d.to_le_bytes()).collect(), pb::DepthUnit::F32Metres),
            Depth::Millimetres(depth) => {
                (depth.iter().flat_map(|d| d.to_le_bytes()).collect(), pb::DepthUnit::U16Millimetres)
            }
        };
        Self {
            data: data.into(),
            unit: unit.into(),
            camera: Some(pb::Camera { width: view.width, height: view.height, k: view.k.to_vec() }),
            extrinsics: Some(match &view.extrinsics {
                Extrinsics::CameraFromTask(pose) => Message::CameraFromTask(pose.into()),
                Extrinsics::FrameFromCamera(pose) => Message::FrameFromCamera(pose.into()),
            }),
        }
    }
}

impl From<&CloudView> for pb::CloudView {
    fn from(view: &CloudView) -> Self {
        let points: Vec<u8> = view.points.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
        let [x, y, z] = view.camera_position;
        Self {
            points: points.into(),
            frame_from_cloud: Some((&view.frame_from_cloud).into()),
            camera_position: Some(pb::Vector3 { x, y, z }),
        }
    }
}

impl TryFrom<pb::DetectGraspsResponse> for Detection {
    type Error = Error;

    fn try_from(response: pb::DetectGraspsResponse) -> Result<Self, Error> {
        Ok(Self {
            grasps: response.grasps.iter().map(Proposal::try_from).collect::<Result<_, _>>()?,
            request_id: response.request_id,
            frame_id: response.frame_id,
            // One that this machine's clock cannot hold was not sent from here.
            stamp: response.stamp.and_then(|stamp| stamp.try_into().ok()),
            model: response.model,
            version: response.version,
            latency: response.latency.unwrap_or_default(),
            dropped: response.dropped,
        })
    }
}
