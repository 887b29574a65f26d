//! Grasp planners: they find grasps in a volume, or in its observed points. The server and the benchmark use the same
//! planners.

mod evaluator;
mod gpd;
mod hand_fit;
mod model_files;
mod model_spec;
mod network;
mod outline;
mod shaf;

use grasp::{Code, DecodeError, DecodeParams, Decoded, RequestError};
use grasp_models::RuntimeError;
use grasp_perception::Scene;
use thiserror::Error;

pub use evaluator::Evaluator;
pub use gpd::Gpd;
pub use hand_fit::{HandFit, object_points};
pub use model_files::{CLASSIFIERS, EVALUATORS, ModelFiles};
pub use model_spec::{Loaded, ModelSpec};
pub use network::{Inference, NetworkPlanner};
pub use shaf::{HighestProposal, Shaf};

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

impl From<PlanError> for RequestError {
    fn from(error: PlanError) -> Self {
        match error {
            PlanError::Run(_) | PlanError::Decode(_) => Self::new(Code::Internal, error.to_string()),
            // Planning is cancelled when the deadline passes or the client cancels; the latter receives no response.
            PlanError::Cancelled => Self::expired(),
        }
    }
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
