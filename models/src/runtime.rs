//! Binding to ONNX Runtime. No other module of the workspace calls it.

mod backend;
mod batch_session;
mod classifier;
mod error;
mod library;
mod loading;
mod model_file;
mod network;
mod reference_check;
mod search;

pub use backend::{Backend, BackendError, Choice, NameError, Precision, Provider};
pub use batch_session::batch_sizes;
pub use classifier::Classifier;
pub use error::{LoadError, LoadReason, RuntimeError};
pub use library::{RuntimeInfo, init};
pub use network::{Network, Output};

/// The input of every network: `[batch, 1, N, N, N]`.
pub const INPUT: &str = "tsdf";

/// The outputs of every network with their channels: `[batch, channels, N, N, N]`.
pub const OUTPUTS: [(&str, usize); 3] = [("quality", 1), ("rotation", 4), ("width", 1)];

/// Options for running a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Number of threads of one inference.
    pub threads: usize,
    /// Execution provider; `None` selects the fastest available one whose outputs match the reference.
    pub provider: Option<Provider>,
    /// Precision; `None` selects the fastest.
    pub precision: Option<Precision>,
    /// Largest batch. Some providers prepare for each batch size.
    pub max_batch: usize,
    /// Whether networks use CUDA graphs, if the provider is `cuda` and their outputs with them match the reference.
    pub cuda_graphs: bool,
}

impl Default for Options {
    /// One thread of ONNX Runtime's CPU kernels, one volume at a time. The results are the same on every machine.
    fn default() -> Self {
        Self { threads: 1, provider: Some(Provider::Cpu), precision: None, max_batch: 1, cuda_graphs: true }
    }
}

impl Options {
    /// The fastest available provider and precision.
    #[must_use]
    pub fn auto(threads: usize) -> Self {
        Self { threads, provider: None, ..Self::default() }
    }
}

/// The error of a run of the model.
fn run_error(model: &str, error: &ort::Error) -> RuntimeError {
    RuntimeError::Run { model: model.to_owned(), reason: error.to_string() }
}
