use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use grasp::{Fusion, Grasp, SurfaceMesh, Volume};
use nalgebra::Isometry3;
use serde_json::{Value, json};
use tokio::sync::watch;
use tonic::Code;

use crate::telemetry::metrics::code_name;
use crate::telemetry::timings::StageTimings;

/// The latest requests, for the web page.
pub(crate) struct RecentRequests {
    limit: usize,
    ended: Mutex<VecDeque<Arc<RecentRequest>>>,
    /// The number of the latest request.
    last: watch::Sender<u64>,
}

/// A finished request.
pub(crate) struct RecentRequest {
    number: u64,
    at: SystemTime,
    request_id: String,
    /// `name version` of the model, empty if none was selected.
    model: String,
    outcome: Outcome,
}

/// How a request ended.
pub(crate) enum Outcome {
    Detected(Box<Detected>),
    /// A `ModelInfer` call, which returns the network's output without decoding it.
    Inferred(StageTimings),
    Refused {
        code: Code,
        message: String,
    },
}

/// The scene and the grasps of a successful request.
pub(crate) struct Detected {
    pub timings: StageTimings,
    /// `T_frame_volume`.
    pub pose: Isometry3<f64>,
    /// Edge length of the volume, metres.
    pub size: f64,
    /// None above [`MAX_RESOLUTION`](Self::MAX_RESOLUTION).
    pub volume: Option<Volume>,
    /// In the parent frame of `pose`.
    pub grasps: Vec<Grasp>,
    pub collides: Option<Vec<bool>>,
    /// Length of the fingers, metres.
    pub finger_depth: f64,
    /// Signs that the geometry of the request is wrong.
    pub warnings: Vec<String>,
}

impl Detected {
    /// Maximum resolution of a stored volume, voxels along an edge: 1 MB per request.
    pub const MAX_RESOLUTION: usize = 64;
}

impl RecentRequests {
    /// Stores up to `limit` requests; 0 disables the page.
    pub fn new(limit: usize) -> Self {
        Self { limit, ended: Mutex::default(), last: watch::Sender::new(0) }
    }

    /// Whether requests are stored for the page.
    pub fn is_enabled(&self) -> bool {
        self.limit > 0
    }

    /// Stores a request and drops the oldest if the limit is reached.
    pub fn add(&self, request_id: String, model: String, outcome: Outcome) {
        if self.limit == 0 {
            return;
        }
        let mut ended = self.lock();
        let number = ended.back().map_or(1, |last| last.number + 1);
        if ended.len() == self.limit {
            ended.pop_front();
        }
        ended.push_back(Arc::new(RecentRequest { number, at: SystemTime::now(), request_id, model, outcome }));
        drop(ended);
        self.last.send_replace(number);
    }

    /// The number of the latest request.
    pub fn last(&self) -> watch::Receiver<u64> {
        self.last.subscribe()
    }

    /// Summaries of all stored requests, newest first.
    pub fn list(&self) -> Value {
        let ended: Vec<_> = self.lock().iter().rev().cloned().collect();
        ended.iter().map(|ended| ended.summary()).collect()
    }

    /// One request with its scene and grasps.
    pub fn get(&self, number: u64) -> Option<Value> {
        let ended = self.lock().iter().find(|ended| ended.number == number).cloned()?;
        Some(ended.details())
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Arc<RecentRequest>>> {
        self.ended.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RecentRequest {
    fn summary(&self) -> Value {
        let at = self.at.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let mut value = json!({ "number": self.number, "at": at, "request_id": self.request_id, "model": self.model });
        let more = match &self.outcome {
            Outcome::Detected(detected) => json!({
                "code": "OK",
                "grasps": detected.grasps.len(),
                "best": detected.grasps.first().map(|grasp| grasp.quality),
                "warnings": detected.warnings,
                "latency": detected.timings.stages().collect::<BTreeMap<_, _>>(),
            }),
            Outcome::Inferred(timings) => json!({
                "code": "OK",
                "message": "ModelInfer returns the network's maps; no grasps were decoded.",
                "latency": timings.stages().collect::<BTreeMap<_, _>>(),
            }),
            Outcome::Refused { code, message } => json!({ "code": code_name(*code), "message": message }),
        };
        if let (Some(value), Value::Object(more)) = (value.as_object_mut(), more) {
            value.extend(more);
        }
        value
    }

    /// The summary with the surface mesh and the grasps in the frame of the volume, metres. `vertices` has x, y, z per
    /// vertex, `triangles` three vertex indices per triangle. A pose is x, y, z and the quaternion x, y, z, w.
    fn details(&self) -> Value {
        let mut value = self.summary();
        if let (Some(object), Outcome::Detected(detected)) = (value.as_object_mut(), &self.outcome) {
            let Detected { pose, size, volume, grasps, collides, finger_depth, .. } = &**detected;
            let mesh = volume.as_ref().map(|volume| Fusion::of(volume).mesh());
            let SurfaceMesh { vertices, triangles } = mesh.unwrap_or_default();
            let vertices = vertices.iter().flat_map(|v| [v.x, v.y, v.z].map(|number| (number * 1e4).round() / 1e4));
            let to_volume = pose.inverse();
            let grasp = |(index, grasp): (usize, &Grasp)| {
                let collides = collides.as_ref().and_then(|collides| collides.get(index));
                let pose = parts(&(to_volume * grasp.pose));
                json!({ "pose": pose, "width": grasp.width, "depth": finger_depth, "quality": grasp.quality, "collides": collides })
            };
            object.insert("size".to_owned(), json!(size));
            object.insert("vertices".to_owned(), vertices.collect());
            object.insert("triangles".to_owned(), triangles.into_iter().flatten().collect());
            object.insert("grasps".to_owned(), grasps.iter().enumerate().map(grasp).collect());
        }
        value
    }
}

fn parts(pose: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
}
