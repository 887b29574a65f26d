//! Where a training run stands, so that it can go on as if it had not been interrupted.
//!
//! To the last bit that holds on the CPU with the same number of threads: with another, and on a GPU at all, libtorch adds
//! in another order, and what it computes differs in the last digits.

use std::fs;
use std::path::{Path, PathBuf};

use grasp_models::onnx::{TensorError, TensorProto};
use prost::Message;
use tch::{Tensor, no_grad};
use thiserror::Error;

use crate::adam::Adam;
use crate::average::Average;
use crate::execute::{Executor, tensor_of, values_of};
use crate::loss::Sums;

/// The file beside the network: what a network does not hold. Shuffling and augmentation are functions of the seed and
/// the epoch, so no generator has to be kept.
#[derive(Clone, PartialEq, Message)]
pub struct Checkpoint {
    /// The settings it was started with, as JSON, and what tells its data from others: another run must not go on from
    /// here.
    #[prost(string, tag = "1")]
    pub settings: String,
    /// Epochs completed.
    #[prost(uint64, tag = "2")]
    pub epoch: u64,
    /// Batches done of the epoch after those.
    #[prost(uint64, tag = "3")]
    pub batch: u64,
    /// Their losses, in the order of [`Sums`].
    #[prost(double, repeated, tag = "4")]
    pub sums: Vec<f64>,
    /// Adam's steps.
    #[prost(uint64, tag = "5")]
    pub steps: u64,
    /// The least so far of what decides which weights are the best: the loss on the scenes held out, or the failures in a
    /// simulator.
    #[prost(double, optional, tag = "6")]
    pub best: Option<f64>,
    /// The weights; those in the network's file may be the best instead of the last.
    #[prost(message, repeated, tag = "7")]
    pub weights: Vec<TensorProto>,
    /// Adam's moments: first and second of each weight in turn.
    #[prost(message, repeated, tag = "8")]
    pub moments: Vec<TensorProto>,
    /// How many scenes of each folder the run has come to know: folders may have grown since.
    #[prost(uint64, repeated, tag = "9")]
    pub scenes: Vec<u64>,
    /// The moving average of the weights, if there is one.
    #[prost(message, repeated, tag = "10")]
    pub average: Vec<TensorProto>,
    /// How often in a row it was not better than the best.
    #[prost(uint64, tag = "11")]
    pub worse: u64,
}

/// Why a run cannot go on from a checkpoint.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
    /// The file is no checkpoint.
    #[error("{}: not a checkpoint, or cut short: {reason}; start without --resume", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// It belongs to a run with other settings or data.
    #[error("the checkpoint was made with {theirs}, this run is {ours}; give the same options and data, or start anew")]
    Settings {
        /// The checkpoint's.
        theirs: String,
        /// This run's.
        ours: String,
    },
    /// It does not hold the losses of the epoch it was made in.
    #[error("the checkpoint holds {0} sums of losses, it must hold 7: it is another version's; start without --resume")]
    Sums(usize),
    /// Its weights are not those of this network.
    #[error("the checkpoint is of another network: {0}")]
    Weights(String),
    /// Its weights cannot be read.
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

    /// Writes it in place of the old one, at once.
    ///
    /// # Errors
    /// [`CheckpointError`] when the file system refuses.
    pub fn write(&self, path: &Path) -> Result<(), CheckpointError> {
        let part = path.with_extension("state.part");
        fs::write(&part, self.encode_to_vec())
            .and_then(|()| fs::rename(&part, path))
            .map_err(|source| CheckpointError::Io { path: path.to_owned(), source })
    }

    /// Stores the weights and the optimiser's state.
    pub(crate) fn keep(&mut self, executor: &Executor, adam: &Adam, average: Option<&Average>) {
        let store = |name: &str, tensor: &Tensor| TensorProto::from_f32(name, &tensor.size(), &values_of(tensor));
        self.weights = executor.parameters().iter().map(|(name, weight)| store(name, weight)).collect();
        self.moments = adam.moments.iter().flatten().map(|moment| store("", moment)).collect();
        self.average = average.iter().flat_map(|average| &average.weights).map(|weight| store("", weight)).collect();
        self.steps = adam.steps;
    }

    /// Puts them back.
    pub(crate) fn restore(
        &self,
        executor: &Executor,
        adam: &mut Adam,
        average: Option<&Average>,
    ) -> Result<(), CheckpointError> {
        let parameters = executor.parameters();
        if self.weights.len() != parameters.len() || self.moments.len() != 2 * parameters.len() {
            let reason = format!("it has {} weights, the network {}", self.weights.len(), parameters.len());
            return Err(CheckpointError::Weights(reason));
        }
        for (stored, (name, weight)) in self.weights.iter().zip(parameters) {
            if stored.name() != name {
                return Err(CheckpointError::Weights(format!("`{}` in place of `{name}`", stored.name())));
            }
            copy(stored, weight)?;
        }
        for (stored, moment) in self.moments.iter().zip(adam.moments.iter().flatten()) {
            copy(stored, moment)?;
        }
        let averages = average.map_or(0, |average| average.weights.len());
        if self.average.len() != averages {
            let reason = format!("it has averages of {} weights, the run {averages}", self.average.len());
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
        let reason = format!("`{}` is {:?}, not {:?}", stored.name(), stored.dims, tensor.size());
        return Err(CheckpointError::Weights(reason));
    }
    let values = tensor_of(stored)?;
    no_grad(|| tensor.shallow_clone().copy_(&values));
    Ok(())
}

impl Sums {
    /// As a list, for a checkpoint.
    pub(crate) fn to_list(self) -> Vec<f64> {
        let Self { voxels, quality, rotation, width, angle, true_positives, false_positives, false_negatives } = self;
        vec![voxels, quality, rotation, width, angle, true_positives, false_positives, false_negatives]
    }

    /// From such a list; none if it is of another length.
    pub(crate) fn from_list(list: &[f64]) -> Option<Self> {
        let &[voxels, quality, rotation, width, angle, true_positives, false_positives, false_negatives] = list else {
            return None;
        };
        Some(Self { voxels, quality, rotation, width, angle, true_positives, false_positives, false_negatives })
    }
}
