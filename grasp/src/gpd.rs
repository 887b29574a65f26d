//! Grasp pose detection on a point cloud: ten Pas, Gualtieri, Saenko, Platt, "Grasp Pose Detection in Point Clouds",
//! IJRR 2017 (GPD), its constants as in the authors' code; and the highest-point heuristic, SHAF.
//!
//! [`Cloud`] (voxels, normals) → [`candidates`] (where the hand fits around a surface) → [`Image`]s (what lies between
//! its fingers), which a classifier scores; or [`highest_first`], which needs none.

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

/// Metres at the borders of the workspace where nothing is looked at: half of an object may lie outside.
const MARGIN: f64 = 0.02;

/// Metres above the table that still belong to it, for the noise of a camera.
const SKIN: f64 = 0.005;

/// Whether a point of the task frame is one of the objects on a table at the height `table`, in a cube with an edge of
/// `size` metres.
#[must_use]
pub fn is_on_an_object(position: &Point3<f64>, size: f64, table: f64) -> bool {
    let inner = MARGIN..=size - MARGIN;
    inner.contains(&position.x) && inner.contains(&position.y) && (table + SKIN..=size).contains(&position.z)
}

/// Candidates as a classifier scores them, the best first. A score is the logit of a success less that of a
/// failure, so that the quality is the probability of a success.
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

/// The candidates in [SHAF's order](highest_first). Nothing says how probable a success is: the quality falls evenly from
/// 1 for the first.
#[must_use]
pub fn ranked(mut candidates: Vec<Candidate>) -> Vec<Grasp> {
    highest_first(&mut candidates);
    let share = |rank: usize| 1.0 - rank as f32 / candidates.len() as f32;
    let grasp = |(rank, c): (usize, &Candidate)| Grasp { pose: c.pose, width: c.width, quality: share(rank) };
    candidates.iter().enumerate().map(grasp).collect()
}
