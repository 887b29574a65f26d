//! Training of grasp networks.
//!
//! A [`Trainer`] reads scenes of a [`Dataset`](grasp_data::Dataset), [augments](Augmentation) them and runs them
//! through an [`Executor`]: the ONNX graph that is served, in libtorch with autograd. [`Adam`] minimises
//! [`Targets::loss`]. A [`Teacher`] adds targets at voxels without labels. A [`Checkpoint`] stores the state of a run.
//! A [`Learner`] trains the classifier of grasp candidates on [`Examples`].

mod adam;
mod augment;
mod average;
mod batch;
mod checkpoint;
mod classifier;
pub mod curves;
mod examples;
mod execute;
mod heads;
mod loss;
mod operators;
mod record;
mod settings;
mod teacher;
mod trainer;

pub use adam::Adam;
pub use augment::{Augmentation, Transform};
pub use checkpoint::{Checkpoint, CheckpointError};
pub use classifier::{ClassifierSettings, Learner, Tally};
pub use examples::Examples;
pub use execute::{ExecuteError, Execution, Executor, Outputs};
pub use loss::{Loss, LossError, Sums, Targets, Weights};
pub use record::{Record, Success, Validation};
pub use settings::{Quality, Settings};
pub use teacher::{Teacher, TeacherError};
pub use trainer::{Epoch, TrainError, Trainer};
