use grasp::{Grasp, MAX_OPENING};
use nalgebra::{UnitQuaternion, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::Observation;
use crate::label::{graspable, sample_pose};

/// Proposes one random grasp, or none if there is no graspable surface.
pub(super) fn plan(observation: &Observation, rng: &mut ChaCha8Rng) -> Vec<Grasp> {
    let surface = graspable(&observation.views);
    if surface.is_empty() {
        return Vec::new();
    }
    let yaw = rng.random_range(0.0..std::f64::consts::PI);
    let pose = sample_pose(&surface, rng) * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    vec![Grasp { pose, width: MAX_OPENING, quality: 0.5 }]
}
