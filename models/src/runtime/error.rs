use std::path::PathBuf;

use thiserror::Error;

use super::{Backend, BackendError};
use crate::MetadataError;

/// Why ONNX Runtime cannot be loaded or failed.
#[derive(Clone, Debug, Error)]
pub enum RuntimeError {
    /// The shared library cannot be loaded or is too old.
    #[error(
        "ONNX Runtime (at least 1.{}): {reason}; install it with `pip install onnxruntime-openvino` \
         or `python3 deploy/native.py onnxruntime`, or set ORT_DYLIB_PATH to its library",
        ort::MINOR_VERSION
    )]
    Library {
        /// What is wrong.
        reason: String,
    },
    /// The batch has no volume.
    #[error("the batch is empty")]
    EmptyBatch,
    /// The batch is larger than `max_batch` of the options.
    #[error("the batch has {got} volumes, the network was loaded for at most {largest}")]
    Batch {
        /// Volumes in the batch.
        got: usize,
        /// Largest batch.
        largest: usize,
    },
    /// A volume has another resolution than the network reads.
    #[error("resolution is {got}, the model `{model}` needs {expected}")]
    Resolution {
        /// Resolution of the volume.
        got: usize,
        /// Resolution of the network.
        expected: usize,
        /// Name of the model.
        model: String,
    },
    /// The scores of a classifier are not numbers.
    #[error("the model `{model}` computes NaN; use another --precision or --provider, or train it again")]
    Nan {
        /// Name of the model.
        model: String,
    },
    /// ONNX Runtime failed.
    #[error("the model `{model}`: {reason}")]
    Run {
        /// Name of the model.
        model: String,
        /// The error of ONNX Runtime.
        reason: String,
    },
}

/// Why a model file cannot be loaded.
#[derive(Debug, Error)]
#[error("{}: {reason}", path.display())]
pub struct LoadError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with the file.
    pub reason: LoadReason,
}

/// What is wrong with a model file.
#[derive(Debug, Error)]
pub enum LoadReason {
    /// ONNX Runtime cannot be loaded or failed.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// The file cannot be read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The file has changed since the folder was read.
    #[error("SHA-256 is {found}, was {expected} when the folder was read; read the folder again")]
    Changed {
        /// SHA-256 when the folder was read.
        expected: String,
        /// Current SHA-256.
        found: String,
    },
    /// The file of an evaluator has no coarse evaluator.
    #[error(
        "there is no coarse evaluator in the file; add one with `grasp-train classify --network coarse-evaluator --teacher`"
    )]
    NoCoarseEvaluator,
    /// ONNX Runtime rejects the model.
    #[error("ONNX Runtime rejects the model: {0}; if the file is truncated, download or export it again")]
    Model(String),
    /// The weights are in another file.
    #[error(
        "the weights are in a second file, `{0}`; save both as one file with `onnx.save_model(onnx.load(path), path, \
         save_as_external_data=False)`"
    )]
    Split(String),
    /// The requested backend cannot run it.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The requested backend computes other outputs than the reference.
    #[error("with {backend} the outputs differ from the reference: {what}; use another provider or precision")]
    DiffersFromReference {
        /// The backend.
        backend: Backend,
        /// The difference.
        what: String,
    },
    /// The metadata is invalid.
    #[error(transparent)]
    Metadata(#[from] MetadataError),
    /// The inputs or outputs are not those of a grasp network.
    #[error(
        "{what}; a grasp network has the input `tsdf`, f32 [batch, 1, N, N, N], and the outputs `quality`, `rotation` \
         and `width`, f32 [batch, 1, 4 and 1, N, N, N]"
    )]
    Signature {
        /// The difference.
        what: String,
    },
    /// The inputs or outputs are not those of a classifier of grasp candidates.
    #[error(
        "{what}; a classifier has the input `images`, f32 [batch, {}], and the output `scores`, f32 [batch, classes]; \
         train one with `grasp-train classify`",
        shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
    )]
    Classifier {
        /// The difference.
        what: String,
        /// Shape of an image.
        shape: &'static [usize],
    },
}

impl From<ort::Error> for LoadReason {
    fn from(error: ort::Error) -> Self {
        Self::Model(error.to_string())
    }
}
