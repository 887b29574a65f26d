//! Grasp planners: from a volume, or the points in it, to grasps. The server and the benchmark run the same ones.

mod gpd;
mod hand_fit;
mod network;
mod shaf;
mod source;

use grasp::{DecodeError, DecodeParams, Decoded, SurfacePoint, Volume};
use grasp_models::RuntimeError;
use thiserror::Error;

pub use gpd::Gpd;
pub use hand_fit::{HandFit, object_points};
pub use network::NetworkPlanner;
pub use shaf::{HighestProposal, Shaf};
pub use source::{Loaded, Source};

/// What a planner gets.
#[derive(Debug)]
pub struct Scene {
    /// What networks read, and what collisions are checked against.
    pub volume: Volume,
    /// The observed surface in the volume's own frame, where it is known more finely than by the volume.
    pub points: Option<Vec<SurfacePoint>>,
}

/// How a planner chooses grasps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanParams {
    /// Thresholds, constraints, the hand and its clearance.
    pub decode: DecodeParams,
    /// Height of the table above the volume's bottom, metres; `None` where there is no table.
    pub table: Option<f64>,
}

/// Why a planner has no answer.
#[derive(Clone, Debug, Error)]
pub enum PlanError {
    /// The network or the classifier failed.
    #[error(transparent)]
    Run(#[from] RuntimeError),
    /// The network's output is not one of grasps.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The caller no longer wants the answer.
    #[error("planning was cancelled")]
    Cancelled,
}

/// Finds grasps in a scene.
pub trait Planner {
    /// Plans. The same scene and parameters give the same grasps. `is_wanted` is called from time to time; once it is
    /// false, planning stops.
    ///
    /// # Errors
    /// [`PlanError`].
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError>;
}
