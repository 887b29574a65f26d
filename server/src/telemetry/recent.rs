use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use grasp::Volume;
use grasp_engine::{Detected, StageTimings};
use nalgebra::{Isometry3, Translation3, Vector3};
use serde_json::{Value, json};
use tokio::sync::watch;
use tonic::Code;

use crate::telemetry::metrics::code_name;

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
    Detected(Box<Shown>),
    /// A `ScoreGrasps` call.
    Scored(StageTimings),
    /// A `ModelInfer` call, which returns the network's output without decoding it.
    Inferred(StageTimings),
    Refused {
        code: Code,
        message: String,
    },
}

/// The scene and the grasps of a successful request.
pub(crate) struct Shown {
    timings: StageTimings,
    /// Pose of the square that contains the cubes, at its corner.
    pose: Isometry3<f64>,
    /// Edge of this square, metres.
    size: f64,
    /// The cubes.
    volumes: Vec<Volume>,
    /// In the frame of the volumes' poses.
    grasps: Vec<Detected>,
    /// Length of the fingers, metres.
    finger_depth: f64,
    /// Signs that the geometry of the request is wrong.
    warnings: Vec<String>,
}

impl Outcome {
    /// The timings of a success.
    pub fn timings(&self) -> Option<StageTimings> {
        match self {
            Self::Detected(shown) => Some(shown.timings),
            Self::Scored(timings) | Self::Inferred(timings) => Some(*timings),
            Self::Refused { .. } => None,
        }
    }

    /// Number of detected grasps.
    pub fn grasps(&self) -> usize {
        if let Self::Detected(shown) = self { shown.grasps.len() } else { 0 }
    }
}

impl Shown {
    /// Maximum number of voxels of the stored volumes: 1 MB per request. Further cubes have no surface on the page.
    const MAX_VOXELS: usize = 1 << 18;

    pub fn new(
        timings: StageTimings,
        mut volumes: Vec<Volume>,
        grasps: Vec<Detected>,
        finger_depth: f64,
        warnings: Vec<String>,
    ) -> Self {
        let (pose, size) = square(&volumes);
        let mut voxels = 0;
        volumes.retain(|volume| {
            voxels += volume.values().len();
            voxels <= Self::MAX_VOXELS
        });
        Self { timings, pose, size, volumes, grasps, finger_depth, warnings }
    }
}

/// Pose and edge of the square that contains cubes.
fn square(volumes: &[Volume]) -> (Isometry3<f64>, f64) {
    let Some(first) = volumes.first() else { return (Isometry3::identity(), 0.0) };
    let corners = volumes.iter().map(|volume| (first.pose().inverse() * volume.pose()).translation.vector);
    let (low, high) = corners
        .fold((Vector3::zeros(), Vector3::zeros()), |(low, high): (Vector3<f64>, Vector3<f64>), corner| {
            (low.inf(&corner), high.sup(&corner))
        });
    let edge = first.voxel_size() * first.resolution() as f64;
    (first.pose() * Translation3::from(low), (high - low).max() + edge)
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
                "best": detected.grasps.first().map(|detected| detected.grasp.quality),
                "warnings": detected.warnings,
                "latency": detected.timings.stages().collect::<BTreeMap<_, _>>(),
            }),
            Outcome::Scored(timings) => json!({
                "code": "OK",
                "message": "ScoreGrasps returns the scores of the caller's grasps; none were detected.",
                "latency": timings.stages().collect::<BTreeMap<_, _>>(),
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
        if let (Some(object), Outcome::Detected(shown)) = (value.as_object_mut(), &self.outcome) {
            let Shown { pose, size, volumes, grasps, finger_depth, .. } = &**shown;
            let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
            for volume in volumes {
                let mesh = volume.mesh();
                let shown_from_volume = pose.inverse() * volume.pose();
                let first = vertices.len() as u32;
                vertices.extend(mesh.vertices.iter().map(|vertex| shown_from_volume * vertex));
                triangles.extend(mesh.triangles.into_iter().flatten().map(|index| first + index));
            }
            let vertices = vertices.iter().flat_map(|v| [v.x, v.y, v.z].map(|number| (number * 1e4).round() / 1e4));
            let grasp = |Detected { grasp, collides, object, .. }: &Detected| {
                json!({
                    "pose": parts(&(pose.inverse() * grasp.pose)),
                    "width": grasp.width,
                    "depth": finger_depth,
                    "quality": grasp.quality,
                    "collides": collides,
                    "object": object,
                })
            };
            object.insert("size".to_owned(), json!(size));
            object.insert("vertices".to_owned(), vertices.collect());
            object.insert("triangles".to_owned(), triangles.into());
            object.insert("grasps".to_owned(), grasps.iter().map(grasp).collect());
        }
        value
    }
}

fn parts(pose: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
}
