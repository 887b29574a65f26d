//! Training of grasp networks.
//!
//! A [`Trainer`] reads scenes of a [`Dataset`](grasp_data::Dataset) and [augments](Augmentation) them. An [`Executor`]
//! executes the ONNX graph that is served in libtorch with autograd. [`Adam`] minimises [`Targets::loss`]. A [`Teacher`]
//! adds targets at voxels without labels. A [`Checkpoint`] stores the state of a run.
//! A [`ClassifierTrainer`] trains the classifier of grasp candidates on a [`CandidateDataset`].

mod adam;
mod augment;
mod batch;
mod candidate_dataset;
mod checkpoint;
mod classifier_trainer;
mod epoch_record;
mod execution_options;
mod executor;
mod gelu;
pub mod learning_curves;
mod loss;
mod occupancy;
mod operators;
mod pointwise;
mod proposal_dataset;
mod scored_poses;
mod supported;
mod teacher;
mod tensors;
mod train_error;
mod trainer;
mod training_settings;
mod weight_average;

pub use adam::Adam;
pub use augment::{Augmentation, Transform};
pub use candidate_dataset::CandidateDataset;
pub use checkpoint::{Checkpoint, CheckpointError};
pub use classifier_trainer::{ClassifierMetrics, ClassifierSettings, ClassifierTrainer, Examples};
pub use epoch_record::{BenchmarkRates, EpochRecord, Validation};
pub use execution_options::ExecutionOptions;
pub use executor::{Executor, NetworkOutputs};
pub use loss::{Loss, LossError, LossSums, LossWeights, Targets};
pub use proposal_dataset::ProposalDataset;
pub use scored_poses::ScoredPoses;
pub use supported::ExecuteError;
pub use teacher::{Teacher, TeacherError};
pub use train_error::TrainError;
pub use trainer::{EpochOutcome, Trainer};
pub use training_settings::{QualityTarget, TrainingSettings};
