use std::time::{Duration, SystemTime};

use grasp::{Grasp, RequestError, Volume};
use grasp_proto::{encode, grey_png, pb};
use nalgebra::Isometry3;

use crate::Error;

/// Options of a request. The default uses the server's defaults.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Identifies the request in the reply and in the server's log. The server generates one when it is empty.
    pub request_id: String,
    /// Model, thresholds, filters and gripper.
    pub detect: pb::Options,
    /// Name of the frame of the volume's or workspace's pose and of the grasps. The server returns it unchanged.
    pub frame_id: String,
    /// Time of the observation. The server returns it unchanged.
    pub stamp: Option<SystemTime>,
    /// Encoding of a volume's values on the wire: F32 (also when unspecified), F16 or U8.
    pub dtype: pb::DataType,
    /// Time limit of each attempt. It is sent to the server as the deadline. `None`: that of the connection
    /// ([`Access::timeout`](crate::Access::timeout)).
    pub timeout: Option<Duration>,
}

/// A rectified depth image and the pose of its camera.
#[derive(Clone, Debug)]
pub struct DepthView {
    /// The pixels, `width * height`.
    pub depth: Depth,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// The 3×3 intrinsic matrix in row-major order, pixels (ROS: `CameraInfo.k`).
    pub k: [f64; 9],
    /// The camera's pose.
    pub extrinsics: Extrinsics,
    /// Label of the object that each pixel shows, `width * height`; 0 is no object.
    pub labels: Option<Vec<u16>>,
}

/// Pixels of a depth image in row-major order: the distance along the optical axis. 0 and NaN mean no reading.
#[derive(Clone, Debug)]
pub enum Depth {
    /// Metres.
    Metres(Vec<f32>),
    /// Whole millimetres.
    Millimetres(Vec<u16>),
    /// Whole millimetres, sent as a PNG file: fewer bytes on a slow network, for a few milliseconds of computation.
    Png(Vec<u16>),
}

/// A camera's pose, in one of two directions. Camera axes: z forward, x right, y down.
#[derive(Clone, Copy, Debug)]
pub enum Extrinsics {
    /// `T_camera_task`: maps points of the task frame into the camera frame.
    CameraFromTask(Isometry3<f64>),
    /// `T_frame_camera`: the camera's pose in the frame `frame_id`, as hand-eye calibration returns it. The identity
    /// if that frame is the camera's.
    FrameFromCamera(Isometry3<f64>),
}

/// A point cloud observed by one camera.
#[derive(Clone, Debug)]
pub struct CloudView {
    /// x, y, z, metres.
    pub points: Vec<[f32; 3]>,
    /// `T_frame_cloud`: maps the points into the frame `frame_id`.
    pub frame_from_cloud: Isometry3<f64>,
    /// Position of the camera in the frame of the points, metres.
    pub camera_position: [f64; 3],
    /// Label of the object of each point; 0 is no object.
    pub labels: Option<Vec<u16>>,
}

/// One view.
#[derive(Clone, Copy, Debug)]
pub enum AnyView<'a> {
    /// A depth image.
    Depth(&'a DepthView),
    /// A point cloud.
    Cloud(&'a CloudView),
}

/// An observation of a scene.
#[derive(Clone, Copy, Debug)]
pub enum Observation<'a> {
    /// A truncated signed distance field.
    Volume(&'a Volume),
    /// Depth images, which the server fuses into the workspace.
    Depth(&'a [DepthView], &'a Workspace),
    /// Point clouds, which the server fuses into the workspace.
    Clouds(&'a [CloudView], &'a Workspace),
}

/// A grasp of the caller, to be scored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// `T_frame_grasp`, in the convention of the request.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers when the object is held, metres. `None`: unknown.
    pub width: Option<f64>,
}

impl From<Isometry3<f64>> for Candidate {
    /// A candidate of unknown width.
    fn from(pose: Isometry3<f64>) -> Self {
        Self { pose, width: None }
    }
}

/// The cube that views are fused into and in which grasps are detected, or the part of a table that is covered with
/// such cubes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Workspace {
    /// `T_frame_task`: pose of the task frame (origin at a corner of the cube, z up) in the frame `frame_id`.
    pub pose: Isometry3<f64>,
    /// Edge length, metres. `None`: the size that the model was trained with.
    pub size: Option<f64>,
    /// Lengths along x and y of a larger workspace, metres, which the server covers with cubes. `None`: one cube.
    pub extent: Option<[f64; 2]>,
    /// Find the table in the first depth image or point cloud instead of using `pose`.
    pub find_table: Option<FindTable>,
    /// Multiply the depths of each view by one factor, so that the table is at its height. `None`: in depth images
    /// whose table is level and at most 3 cm from its height. `Some(true)` is an error with `find_table`.
    pub correct_depth_scale: Option<bool>,
}

/// A search for the table in an observation: the workspace is placed over what stands on it.
#[derive(Clone, Copy, Debug, Default)]
pub struct FindTable {
    /// Direction of gravity in the frame `frame_id`, of any length above 0. `None`: unknown; a wall that fills the
    /// image is then taken for a table.
    pub gravity: Option<[f64; 3]>,
}

/// The result of a request.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// The id of the request.
    pub request_id: String,
    /// Name of the frame of the grasps.
    pub frame_id: String,
    /// Time of the observation, as sent.
    pub stamp: Option<SystemTime>,
    /// The grasps, best first.
    pub grasps: Vec<Proposal>,
    /// Name of the model that found them.
    pub model: String,
    /// Version of the model.
    pub version: String,
    /// Duration of each stage in the server, seconds.
    pub latency: pb::Latency,
    /// Number of voxels without a grasp, by reason. Set when `explain` is set or `grasps` is empty.
    pub dropped: Option<pb::Dropped>,
    /// Signs that the geometry of the request is wrong, or that the network was not trained for it.
    pub warnings: Vec<pb::GeometryWarning>,
    /// The table that was found, with [`Workspace::find_table`].
    pub table: Option<pb::FoundTable>,
    /// Factors by which the depths of the views were multiplied ([`Workspace::correct_depth_scale`]).
    pub depth_factors: Vec<f64>,
}

/// A grasp with its pre-grasp and retreat poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Proposal {
    /// `T_frame_grasp`, in the convention of the request.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers, metres.
    pub width: f64,
    /// Predicted probability of success, in [0, 1].
    pub quality: f32,
    /// Pre-grasp pose: the open hand approaches from here along its z axis.
    pub pregrasp: Isometry3<f64>,
    /// Pose to which the hand moves after it has closed.
    pub retreat: Isometry3<f64>,
    /// Whether the open hand would collide; `None` without a collision check.
    pub collides: Option<bool>,
    /// Label of the object between the fingers, for views with labels.
    pub object: Option<u32>,
    /// Largest opening with which the hand is free of collisions, metres; `None` without a collision check, or if there
    /// is none.
    pub open_width: Option<f64>,
}

/// The scores of the caller's grasps.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// The id of the request.
    pub request_id: String,
    /// Name of the frame of the candidates.
    pub frame_id: String,
    /// Time of the observation, as sent.
    pub stamp: Option<SystemTime>,
    /// One score for each candidate, in their order.
    pub scores: Vec<pb::Score>,
    /// Name of the model.
    pub model: String,
    /// Version of the model.
    pub version: String,
    /// Duration of each stage in the server, seconds.
    pub latency: pb::Latency,
    /// Signs that the geometry of the request is wrong.
    pub warnings: Vec<pb::GeometryWarning>,
    /// The table that was found, with [`Workspace::find_table`].
    pub table: Option<pb::FoundTable>,
    /// Factors by which the depths of the views were multiplied ([`Workspace::correct_depth_scale`]).
    pub depth_factors: Vec<f64>,
}

impl From<pb::ScoreGraspsResponse> for Scores {
    fn from(response: pb::ScoreGraspsResponse) -> Self {
        Self {
            request_id: response.request_id,
            frame_id: response.frame_id,
            stamp: response.stamp.and_then(system_time),
            scores: response.scores,
            model: response.model,
            version: response.version,
            latency: response.latency.unwrap_or_default(),
            warnings: response.warnings,
            table: response.table,
            depth_factors: response.depth_factors,
        }
    }
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
        // Not the identity: a robot would move there.
        let required = |pose: &Option<pb::Pose>, field: &'static str| {
            let pose = pose.as_ref().ok_or_else(|| RequestError::invalid(field, "absent", "must be given"))?;
            grasp_proto::pose(pose, field)
        };
        let pregrasp = required(&message.pregrasp, "grasps.pregrasp")?;
        let retreat = required(&message.retreat, "grasps.retreat")?;
        let pb::Grasp { collides, object, open_width, .. } = *message;
        Ok(Self { pose, width, quality, pregrasp, retreat, collides, object, open_width })
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

    pub(crate) fn score_request(
        self,
        observation: Observation<'_>,
        candidates: &[Candidate],
    ) -> pb::ScoreGraspsRequest {
        use pb::score_grasps_request::Scene;
        let candidate =
            |Candidate { pose, width }: &Candidate| pb::Candidate { pose: Some(pose.into()), width: *width };
        let workspace = |workspace: &Workspace| Some(workspace.message(self.frame_id.clone(), self.stamp));
        let scene = match observation {
            Observation::Volume(volume) => {
                let mut volume = encode(volume, self.dtype, self.frame_id.clone());
                volume.stamp = self.stamp.map(Into::into);
                Scene::Volume(volume)
            }
            Observation::Depth(views, of_views) => Scene::Depth(pb::DepthViews {
                views: views.iter().map(Into::into).collect(),
                workspace: workspace(of_views),
            }),
            Observation::Clouds(views, of_views) => Scene::Clouds(pb::CloudViews {
                views: views.iter().map(Into::into).collect(),
                workspace: workspace(of_views),
            }),
        };
        pb::ScoreGraspsRequest {
            request_id: self.request_id,
            candidates: candidates.iter().map(candidate).collect(),
            scene: Some(scene),
            options: Some(self.detect),
        }
    }

    pub(crate) fn table_request(
        self,
        view: AnyView<'_>,
        workspace: &Workspace,
        table_height: Option<f64>,
    ) -> pb::FindTableRequest {
        use pb::find_table_request::Observation as Message;
        // The server refuses a pose and a correction of depths here.
        let find_table = Some(workspace.find_table.unwrap_or_default());
        let workspace = Workspace { find_table, correct_depth_scale: None, ..*workspace };
        pb::FindTableRequest {
            observation: Some(match view {
                AnyView::Depth(view) => Message::View(view.into()),
                AnyView::Cloud(view) => Message::Cloud(view.into()),
            }),
            workspace: Some(workspace.message(self.frame_id, self.stamp)),
            table_height,
            request_id: self.request_id,
        }
    }

    /// A request with a workspace starts a new volume.
    pub(crate) fn track_request(
        self,
        views: &[DepthView],
        workspace: Option<&Workspace>,
        half_life: Option<f64>,
    ) -> pb::TrackGraspsRequest {
        pb::TrackGraspsRequest {
            half_life: half_life.filter(|_| workspace.is_some()),
            views: views.iter().map(Into::into).collect(),
            workspace: workspace.map(|workspace| workspace.message(self.frame_id, None)),
            request_id: self.request_id,
            options: Some(self.detect),
            stamp: self.stamp.map(Into::into),
        }
    }
}

impl Workspace {
    fn message(&self, frame_id: String, stamp: Option<SystemTime>) -> pb::Workspace {
        let gravity = self.find_table.and_then(|search| search.gravity);
        pb::Workspace {
            pose: self.find_table.is_none().then(|| (&self.pose).into()),
            size: self.size.unwrap_or_default(),
            frame_id,
            stamp: stamp.map(Into::into),
            find_table: self.find_table.is_some(),
            gravity: gravity.map(|[x, y, z]| pb::Vector3 { x, y, z }),
            extent: self.extent.map(|[x, y]| pb::Extent { x, y }),
            correct_depth_scale: self.correct_depth_scale,
        }
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
            Depth::Png(depth) => (grey_png(depth, view.width), pb::DepthUnit::PngMillimetres),
        };
        Self {
            data: data.into(),
            unit: unit.into(),
            camera: Some(pb::Camera { width: view.width, height: view.height, k: view.k.to_vec() }),
            extrinsics: Some(match &view.extrinsics {
                Extrinsics::CameraFromTask(pose) => Message::CameraFromTask(pose.into()),
                Extrinsics::FrameFromCamera(pose) => Message::FrameFromCamera(pose.into()),
            }),
            labels: view.labels.as_deref().map(labels),
        }
    }
}

/// Labels with one byte each if all fit.
fn labels(labels: &[u16]) -> pb::Labels {
    let narrow: Option<Vec<u8>> = labels.iter().map(|&label| u8::try_from(label).ok()).collect();
    let (data, label_type) = match narrow {
        Some(narrow) => (narrow, pb::LabelType::U8),
        None => (labels.iter().flat_map(|label| label.to_le_bytes()).collect(), pb::LabelType::U16),
    };
    pb::Labels { data: data.into(), r#type: label_type.into() }
}

impl From<&CloudView> for pb::CloudView {
    fn from(view: &CloudView) -> Self {
        let points: Vec<u8> = view.points.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
        let [x, y, z] = view.camera_position;
        Self {
            points: points.into(),
            frame_from_cloud: Some((&view.frame_from_cloud).into()),
            camera_position: Some(pb::Vector3 { x, y, z }),
            labels: view.labels.as_deref().map(labels),
            scale: None,
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
            stamp: response.stamp.and_then(system_time),
            model: response.model,
            version: response.version,
            latency: response.latency.unwrap_or_default(),
            dropped: response.dropped,
            warnings: response.warnings,
            table: response.table,
            depth_factors: response.depth_factors,
        })
    }
}

/// The time of a reply. A stamp that `SystemTime` cannot represent was not sent by this client.
fn system_time(stamp: impl TryInto<SystemTime>) -> Option<SystemTime> {
    stamp.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_without_a_pre_grasp_or_a_retreat_is_an_error() {
        let pose = Some(pb::Pose::from(&Isometry3::translation(0.1, 0.2, 0.3)));
        let whole = pb::Grasp { pose, pregrasp: pose, retreat: pose, ..Default::default() };
        assert!(Proposal::try_from(&whole).is_ok());
        for (message, field) in [
            (pb::Grasp { pregrasp: None, ..whole }, "grasps.pregrasp is absent"),
            (pb::Grasp { retreat: None, ..whole }, "grasps.retreat is absent"),
        ] {
            let error = Proposal::try_from(&message).unwrap_err();
            assert!(matches!(error, Error::Reply(_)) && error.to_string().contains(field), "{error}");
        }
    }

    #[test]
    fn candidates_are_sent_with_their_widths() {
        let pose = Isometry3::translation(0.1, 0.2, 0.3);
        let candidates = [Candidate::from(pose), Candidate { pose, width: Some(0.04) }];
        let workspace = Workspace::default();
        let request = Options::default().score_request(Observation::Depth(&[], &workspace), &candidates);
        assert_eq!(request.candidates.iter().map(|candidate| candidate.width).collect::<Vec<_>>(), [None, Some(0.04)]);
    }

    #[test]
    fn scores_have_the_frame_and_the_time_of_the_observation() {
        let stamp = SystemTime::UNIX_EPOCH + Duration::from_millis(1500);
        let frame_id = "base".to_owned();
        let scores =
            Scores::from(pb::ScoreGraspsResponse { frame_id, stamp: Some(stamp.into()), ..Default::default() });
        assert_eq!((scores.frame_id.as_str(), scores.stamp), ("base", Some(stamp)));
    }

    #[test]
    fn a_request_for_the_table_has_no_pose() {
        let cloud = CloudView {
            points: vec![[0.0, 0.0, 0.5]],
            frame_from_cloud: Isometry3::identity(),
            camera_position: [0.0; 3],
            labels: None,
        };
        let workspace = Workspace { extent: Some([0.9, 0.6]), correct_depth_scale: Some(true), ..Workspace::default() };
        let options = Options { request_id: "shelf 7".to_owned(), frame_id: "base".to_owned(), ..Options::default() };
        let request = options.table_request(AnyView::Cloud(&cloud), &workspace, Some(0.1));
        assert_eq!((request.request_id.as_str(), request.table_height), ("shelf 7", Some(0.1)));
        assert!(matches!(request.observation, Some(pb::find_table_request::Observation::Cloud(_))));
        let workspace = request.workspace.unwrap();
        assert!(workspace.find_table && workspace.pose.is_none() && workspace.correct_depth_scale.is_none());
        assert_eq!((workspace.frame_id.as_str(), workspace.extent), ("base", Some(pb::Extent { x: 0.9, y: 0.6 })));
    }
}
