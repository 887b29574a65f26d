use std::time::{Duration, SystemTime};

use grasp::{Grasp, Volume};
use grasp_proto::{encode, pb};

use crate::Error;

/// What may be said along with a volume. The default leaves everything to the server.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Names the request in the reply and the server's log; generated there when empty.
    pub request_id: String,
    /// Which model answers; when empty, the server's default if the volume fits it.
    pub model: String,
    /// Which version of it; when empty, the newest.
    pub version: String,
    /// Smallest quality of a grasp, above 0 and at most 1; else the model's own.
    pub threshold: Option<f32>,
    /// When nothing reaches the threshold, the best grasp alone, if it reaches this.
    pub force: Option<f32>,
    /// At most this many grasps, the best; 0 for all.
    pub max_grasps: u32,
    /// Also say why the other voxels hold no grasp.
    pub explain: bool,
    /// The frame of the volume's pose and of the grasps; echoed.
    pub frame_id: String,
    /// When the volume was taken; echoed.
    pub stamp: Option<SystemTime>,
    /// How the values travel: F32 (also when unspecified), or half or a quarter of it.
    pub dtype: pb::DataType,
    /// How long each attempt may take, as the server is told, too.
    pub timeout: Option<Duration>,
}

/// The answer to a volume.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// The request's id.
    pub request_id: String,
    /// The frame of the grasps.
    pub frame_id: String,
    /// The volume's stamp.
    pub stamp: Option<SystemTime>,
    /// Best first.
    pub grasps: Vec<Grasp>,
    /// The model that answered.
    pub model: String,
    /// Its version.
    pub version: String,
    /// Where the time went in the server, seconds.
    pub latency: pb::Latency,
    /// Why the other voxels hold no grasp, when that was asked for or there is none.
    pub dropped: Option<pb::Dropped>,
}

impl Options {
    pub(crate) fn request(self, volume: &Volume) -> pb::DetectGraspsRequest {
        let mut volume = encode(volume, self.dtype, self.frame_id);
        volume.stamp = self.stamp.map(Into::into);
        pb::DetectGraspsRequest {
            request_id: self.request_id,
            volume: Some(volume),
            model: self.model,
            version: self.version,
            threshold: self.threshold,
            force: self.force,
            max_grasps: self.max_grasps,
            explain: self.explain,
        }
    }
}

impl TryFrom<pb::DetectGraspsResponse> for Detection {
    type Error = Error;

    fn try_from(response: pb::DetectGraspsResponse) -> Result<Self, Error> {
        Ok(Self {
            grasps: response.grasps.iter().map(Grasp::try_from).collect::<Result<_, _>>()?,
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
