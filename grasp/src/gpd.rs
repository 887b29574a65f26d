//! Grasp pose detection on a point cloud: ten Pas, Gualtieri, Saenko, Platt, "Grasp Pose Detection in Point Clouds",
//! IJRR 2017 (GPD), with the constants of the authors' code; and the highest-point heuristic, SHAF.
//!
//! GPD: [`Cloud`] (downsampled points, normals) → [`candidates`] (poses where the hand fits around a surface) →
//! [`Image`]s (the surface between the fingers) → a classifier that scores them. SHAF orders the candidates with
//! [`highest_first`] and needs no classifier.

mod candidates;
mod cloud;
mod image;
mod shaf;

pub use candidates::{Candidate, Params, by_sample, candidates};
pub use cloud::{Cloud, NORMALS_RADIUS, VOXEL_SIZE};
pub use image::{CHANNELS, IMAGE_SIZE, Image};
pub use shaf::highest_first;

use nalgebra::Point3;

use crate::Grasp;

/// Width of the border of the workspace that is ignored, metres: an object there may lie half outside.
const MARGIN: f64 = 0.02;

/// Height above the table that still counts as the table, metres, because of camera noise.
const SKIN: f64 = 0.005;

/// Whether a point of the task frame belongs to an object on the table. `size` is the edge of the workspace and `table`
/// the height of the table, both in metres.
#[must_use]
pub fn is_on_an_object(position: &Point3<f64>, size: f64, table: f64) -> bool {
    let inner = MARGIN..=size - MARGIN;
    inner.contains(&position.x) && inner.contains(&position.y) && (table + SKIN..=size).contains(&position.z)
}

/// The candidates as grasps, best first. A score is the calibrated log-odds of success; the quality is its sigmoid, the
/// probability of success.
#[must_use]
pub fn scored(candidates: &[Candidate], scores: &[f32]) -> Vec<Grasp> {
    let grasp = |(candidate, &score): (&Candidate, &f32)| Grasp {
        pose: candidate.pose,
        width: candidate.width,
        quality: 1.0 / (1.0 + (-score).exp()),
    };
    let mut grasps: Vec<Grasp> = candidates.iter().zip(scores).map(grasp).collect();
    grasps.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    grasps
}

/// The candidates as grasps in [SHAF's order](highest_first). SHAF predicts no probability: the quality decreases
/// linearly from 1 for the first.
#[must_use]
pub fn ranked(mut candidates: Vec<Candidate>) -> Vec<Grasp> {
    highest_first(&mut candidates);
    let share = |rank: usize| 1.0 - rank as f32 / candidates.len() as f32;
    let grasp = |(rank, c): (usize, &Candidate)| Grasp { pose: c.pose, width: c.width, quality: share(rank) };
    candidates.iter().enumerate().map(grasp).collect()
}
