//! Grasp pose detection on a point cloud: ten Pas, Gualtieri, Saenko, Platt, "Grasp Pose Detection in Point Clouds",
//! IJRR 2017 (GPD), its constants as in the authors' code; and the highest-point heuristic, SHAF.
//!
//! [`Cloud`] (voxels, normals) → [`candidates`] (where the hand fits around a surface) → [`Image`]s (what lies between
//! its fingers), which a classifier scores; or [`highest_first`], which needs none.

mod candidates;
mod cloud;
mod image;
mod shaf;

pub use candidates::{Candidate, Params, candidates};
pub use cloud::{Cloud, NORMALS_RADIUS, VOXEL_SIZE};
pub use image::{CHANNELS, IMAGE_SIZE, Image};
pub use shaf::highest_first;
