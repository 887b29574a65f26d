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

/// The latest requests, for whoever looks at the page.
pub(crate) struct RecentRequests {
    most: usize,
    ended: Mutex<VecDeque<Arc<RecentRequest>>>,
    /// The number of the last one.
    last: watch::Sender<u64>,
}

/// A request that came to its end.
pub(crate) struct RecentRequest {
    number: u64,
    at: SystemTime,
    request_id: String,
    /// The planner's label, empty if none was reached.
    model: String,
    outcome: Outcome,
}

/// How it ended.
pub(crate) enum Outcome {
    Answered(Box<Answered>),
    /// By a network's maps, which the caller decodes.
    Inferred(StageTimings),
    Refused {
        code: Code,
        message: String,
    },
}

/// What was seen, and the grasps in it.
pub(crate) struct Answered {
    pub timings: StageTimings,
    /// `T_frame_volume`.
    pub pose: Isometry3<f64>,
    /// Edge of the volume, metres.
    pub size: f64,
    /// None where it is too large to be kept.
    pub volume: Option<Volume>,
    /// In the frame of the volume's pose.
    pub grasps: Vec<Grasp>,
    pub collides: Option<Vec<bool>>,
    /// Length of the hand's fingers, metres.
    pub finger_depth: f64,
}

impl Answered {
    /// The largest volumes that are kept, voxels along an edge: a request of 1 MB.
    pub const MAX_RESOLUTION: usize = 64;
}

impl RecentRequests {
    /// Keeps so many; none at all with 0.
    pub fn new(most: usize) -> Self {
        Self { most, ended: Mutex::default(), last: watch::Sender::new(0) }
    }

    /// Whether there is a page to look at.
    pub fn is_kept(&self) -> bool {
        self.most > 0
    }

    /// The latest of all.
    pub fn add(&self, request_id: String, model: String, outcome: Outcome) {
        if self.most == 0 {
            return;
        }
        let mut ended = self.lock();
        let number = ended.back().map_or(1, |last| last.number + 1);
        if ended.len() == self.most {
            ended.pop_front();
        }
        ended.push_back(Arc::new(RecentRequest { number, at: SystemTime::now(), request_id, model, outcome }));
        drop(ended);
        self.last.send_replace(number);
    }

    /// The number of the last one, now and whenever there is another.
    pub fn last(&self) -> watch::Receiver<u64> {
        self.last.subscribe()
    }

    /// All of them in short, the latest first.
    pub fn list(&self) -> Value {
        let ended: Vec<_> = self.lock().iter().rev().cloned().collect();
        ended.iter().map(|ended| ended.short()).collect()
    }

    /// One of them, with what was seen.
    pub fn get(&self, number: u64) -> Option<Value> {
        let ended = self.lock().iter().find(|ended| ended.number == number).cloned()?;
        Some(ended.whole())
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Arc<RecentRequest>>> {
        self.ended.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RecentRequest {
    fn short(&self) -> Value {
        let at = self.at.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let mut value = json!({ "number": self.number, "at": at, "request_id": self.request_id, "model": self.model });
        let more = match &self.outcome {
            Outcome::Answered(answered) => json!({
                "code": "OK",
                "grasps": answered.grasps.len(),
                "best": answered.grasps.first().map(|grasp| grasp.quality),
                "latency": answered.timings.stages().collect::<BTreeMap<_, _>>(),
            }),
            Outcome::Inferred(timings) => json!({
                "code": "OK",
                "message": "The caller has the network's maps; no grasps were decoded here.",
                "latency": timings.stages().collect::<BTreeMap<_, _>>(),
            }),
            Outcome::Refused { code, message } => json!({ "code": code_name(*code), "message": message }),
        };
        if let (Some(value), Value::Object(more)) = (value.as_object_mut(), more) {
            value.extend(more);
        }
        value
    }

    /// With the observed surface and the grasps in the volume's own frame, metres: `vertices` has x, y, z of each corner,
    /// `triangles` three indices of corners each; a grasp's pose is x, y, z and the quaternion's x, y, z, w.
    fn whole(&self) -> Value {
        let mut value = self.short();
        if let (Some(object), Outcome::Answered(answered)) = (value.as_object_mut(), &self.outcome) {
            let Answered { pose, size, volume, grasps, collides, finger_depth, .. } = &**answered;
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
