use grasp_data::DataError;
use tch::TchError;
use thiserror::Error;

use crate::checkpoint::CheckpointError;
use crate::loss::LossError;
use crate::supported::ExecuteError;
use crate::teacher::TeacherError;

/// Why training stopped.
#[derive(Debug, Error)]
pub enum TrainError {
    /// The settings do not fit the data.
    #[error("{0}")]
    Settings(String),
    /// The data cannot be read.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The graph cannot be executed.
    #[error(transparent)]
    Execute(#[from] ExecuteError),
    /// libtorch failed.
    #[error(transparent)]
    Torch(#[from] TchError),
    /// The checkpoint cannot be resumed.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The teacher failed.
    #[error("--teacher: {0}")]
    Teacher(#[from] TeacherError),
    /// The loss cannot be computed.
    #[error(transparent)]
    Loss(#[from] LossError),
    /// The training diverged.
    #[error("the loss is not finite at step {step}; use a smaller learning rate or a warm-up")]
    Diverged {
        /// Number of the step.
        step: u64,
    },
}
