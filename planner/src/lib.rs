//! Grasp planners: they find grasps in a volume, or in its observed points. The server and the benchmark use the same
//! planners.

mod evaluator;
mod gpd;
mod hand_fit;
mod network;
mod shaf;
mod source;

use grasp::{DecodeError, DecodeParams, Decoded, SurfacePoint, Volume};
use grasp_models::RuntimeError;
use thiserror::Error;

pub use evaluator::Evaluator;
pub use gpd::Gpd;
pub use hand_fit::{HandFit, object_points};
pub use network::{Inference, NetworkPlanner};
pub use shaf::{HighestProposal, Shaf};
pub use source::{Loaded, Source};

/// Input of a planner.
#[derive(Debug)]
pub struct Scene {
    /// The volume: input of networks and of the collision check.
    pub volume: Volume,
    /// The observed surface in the volume's own frame (metres), if it is known at a higher resolution than the
    /// volume's.
    pub points: Option<Vec<SurfacePoint>>,
}

/// Parameters of planning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanParams {
    /// Thresholds, constraints, the hand and its clearance.
    pub decode: DecodeParams,
    /// Height of the table above the volume's bottom, metres; `None` where there is no table.
    pub table: Option<f64>,
}

/// Why planning failed.
#[derive(Clone, Debug, Error)]
pub enum PlanError {
    /// The network or the classifier failed.
    #[error(transparent)]
    Run(#[from] RuntimeError),
    /// The output of the network is invalid.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Planning stopped because `is_wanted` returned false.
    #[error("planning was cancelled")]
    Cancelled,
}

/// Finds grasps in a scene.
pub trait Planner {
    /// Returns the grasps in the frame of the volume's pose, best first. The same scene and parameters give the same
    /// grasps. Planners call `is_wanted` repeatedly and stop when it returns false.
    ///
    /// # Errors
    /// [`PlanError`] if the network fails, its output is invalid, or planning is cancelled.
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError>;
}
