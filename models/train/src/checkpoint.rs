//! The state of a training run. A run that is resumed from it gives the same result as an uninterrupted run.
//!
//! On the CPU with the same number of threads the result is bit-identical. With another number of threads, or on a GPU,
//! libtorch adds in another order and the results differ in the last digits.

use std::fs;
use std::path::{Path, PathBuf};

use grasp_models::onnx::{TensorError, TensorProto};
use prost::Message;
use tch::{Tensor, no_grad};
use thiserror::Error;

use crate::adam::Adam;
use crate::executor::Executor;
use crate::loss::LossSums;
use crate::tensors::{tensor_of, values_of};
use crate::weight_average::WeightAverage;

/// The state of a run that the network's file does not contain. Shuffling and augmentation are functions of the seed
/// and the epoch, so the state of a random generator is not part of it.
#[derive(Clone, PartialEq, Message)]
pub struct Checkpoint {
    /// The settings of the run as JSON, and a fingerprint of its data. Only a run with the same value can be resumed.
    #[prost(string, tag = "1")]
    pub settings: String,
    /// Epochs completed.
    #[prost(uint64, tag = "2")]
    pub epoch: u64,
    /// Completed batches of the current epoch.
    #[prost(uint64, tag = "3")]
    pub batch: u64,
    /// Sums over these batches, in the order of [`LossSums`].
    #[prost(double, repeated, tag = "4")]
    pub sums: Vec<f64>,
    /// Adam's steps.
    #[prost(uint64, tag = "5")]
    pub steps: u64,
    /// Smallest cost so far, by which the best weights are selected: the validation loss, or the mean of 1 − GSR and
    /// 1 − DR of --evaluate.
    #[prost(double, optional, tag = "6")]
    pub best: Option<f64>,
    /// The last weights. The network's file may contain the best instead.
    #[prost(message, repeated, tag = "7")]
    pub weights: Vec<TensorProto>,
    /// Adam's moments: first and second of each weight, alternating.
    #[prost(message, repeated, tag = "8")]
    pub moments: Vec<TensorProto>,
    /// Number of scenes of each folder that the run uses. The folders may have grown since.
    #[prost(uint64, repeated, tag = "9")]
    pub scenes: Vec<u64>,
    /// The moving average of the weights, if there is one.
    #[prost(message, repeated, tag = "10")]
    pub average: Vec<TensorProto>,
    /// Consecutive results that were not better than the best.
    #[prost(uint64, tag = "11")]
    pub results_since_best: u64,
    /// Duration of the run so far, seconds.
    #[prost(double, tag = "12")]
    pub seconds: f64,
    /// Whether the smallest cost is that of --evaluate.
    #[prost(bool, tag = "13")]
    pub evaluated: bool,
    /// Whether the network's file contains the best weights, not the last.
    #[prost(bool, tag = "14")]
    pub keeps_best: bool,
    /// Whether --evaluate has no result for the last epoch, because it failed or was interrupted.
    #[prost(bool, tag = "15")]
    pub unevaluated: bool,
}

/// Why a run cannot be resumed from a checkpoint.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not a checkpoint.
    #[error("{}: not a checkpoint, or truncated: {reason}; start without --resume", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// The decoder's error.
        reason: String,
    },
    /// The checkpoint belongs to a run with other settings or data.
    #[error(
        "the checkpoint has the settings {theirs}, this run has {ours}; give the same options and data, or start without \
         --resume"
    )]
    Settings {
        /// The checkpoint's.
        theirs: String,
        /// This run's.
        ours: String,
    },
    /// The sums of the losses are incomplete.
    #[error("the checkpoint has {0} sums of losses, must have 10: it is of another version; start without --resume")]
    Sums(usize),
    /// The weights are not those of this network.
    #[error("the checkpoint is of another network: {0}; start without --resume")]
    Weights(String),
    /// The weights cannot be read.
    #[error(transparent)]
    Tensor(#[from] TensorError),
}

impl Checkpoint {
    /// Reads a checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError`] names the file.
    pub fn read(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = fs::read(path).map_err(|source| CheckpointError::Io { path: path.to_owned(), source })?;
        Self::decode(bytes.as_slice())
            .map_err(|error| CheckpointError::Decode { path: path.to_owned(), reason: error.to_string() })
    }

    /// Replaces the file atomically.
    ///
    /// # Errors
    /// [`CheckpointError`] when the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), CheckpointError> {
        let part = path.with_extension("state.part");
        fs::write(&part, self.encode_to_vec())
            .and_then(|()| fs::rename(&part, path))
            .map_err(|source| CheckpointError::Io { path: path.to_owned(), source })
    }

    /// Copies the weights and the state of the optimizer into the checkpoint.
    pub(crate) fn store(&mut self, executor: &Executor, adam: &Adam, average: Option<&WeightAverage>) {
        let proto = |name: &str, tensor: &Tensor| TensorProto::from_f32(name, &tensor.size(), &values_of(tensor));
        self.weights = executor.parameters().iter().map(|(name, weight)| proto(name, weight)).collect();
        self.moments = adam.moments.iter().flatten().map(|moment| proto("", moment)).collect();
        self.average = average.iter().flat_map(|average| &average.weights).map(|weight| proto("", weight)).collect();
        self.steps = adam.steps;
    }

    /// Copies the weights and the state of the optimizer from the checkpoint.
    pub(crate) fn restore(
        &self,
        executor: &Executor,
        adam: &mut Adam,
        average: Option<&WeightAverage>,
    ) -> Result<(), CheckpointError> {
        let parameters = executor.parameters();
        if self.weights.len() != parameters.len() || self.moments.len() != 2 * parameters.len() {
            let reason = format!("it has {} weights, the network has {}", self.weights.len(), parameters.len());
            return Err(CheckpointError::Weights(reason));
        }
        for (stored, (name, weight)) in self.weights.iter().zip(parameters) {
            if stored.name() != name {
                return Err(CheckpointError::Weights(format!("weight `{}` instead of `{name}`", stored.name())));
            }
            copy(stored, weight)?;
        }
        for (stored, moment) in self.moments.iter().zip(adam.moments.iter().flatten()) {
            copy(stored, moment)?;
        }
        let averages = average.map_or(0, |average| average.weights.len());
        if self.average.len() != averages {
            let reason = format!("it has {} averaged weights, the run has {averages}", self.average.len());
            return Err(CheckpointError::Weights(reason));
        }
        for (stored, weight) in self.average.iter().zip(average.iter().flat_map(|average| &average.weights)) {
            copy(stored, weight)?;
        }
        adam.steps = self.steps;
        Ok(())
    }
}

fn copy(stored: &TensorProto, tensor: &Tensor) -> Result<(), CheckpointError> {
    if stored.dims != tensor.size() {
        let reason = format!("`{}` has shape {:?}, must be {:?}", stored.name(), stored.dims, tensor.size());
        return Err(CheckpointError::Weights(reason));
    }
    let values = tensor_of(stored)?;
    no_grad(|| tensor.shallow_clone().copy_(&values));
    Ok(())
}

impl LossSums {
    /// The sums as a list, for a checkpoint.
    pub(crate) fn to_list(mut self) -> Vec<f64> {
        self.fields().map(|sum| *sum).to_vec()
    }

    /// The inverse of [`to_list`](Self::to_list); `None` if the length is wrong.
    pub(crate) fn from_list(list: &[f64]) -> Option<Self> {
        let mut sums = Self::default();
        let fields = sums.fields();
        if list.len() != fields.len() {
            return None;
        }
        fields.into_iter().zip(list).for_each(|(sum, value)| *sum = *value);
        Some(sums)
    }
}
