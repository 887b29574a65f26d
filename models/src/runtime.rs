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

use std::num::NonZeroUsize;
use std::thread::available_parallelism;

pub use backend::{Backend, BackendError, Choice, NameError, Precision, Provider};
pub use batch_session::batch_sizes;
pub use classifier::{Classifier, ClassifierKind};
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
    /// Number of sessions of a model; `None` selects the number that is fastest with the provider.
    pub sessions: Option<usize>,
    /// Number of threads of one inference; `None`: as many as there are CPUs.
    pub threads: Option<usize>,
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
        Self {
            sessions: Some(1),
            threads: Some(1),
            provider: Some(Provider::Cpu),
            precision: None,
            max_batch: 1,
            cuda_graphs: true,
        }
    }
}

impl Options {
    /// The fastest available provider and precision.
    #[must_use]
    pub fn auto(threads: usize) -> Self {
        Self { threads: Some(threads), provider: None, ..Self::default() }
    }

    /// Number of sessions of a model on this backend.
    ///
    /// OpenVINO needs two to use all CPUs: while one waits for the slower of its threads, or for its next job, the other
    /// one computes. With ONNX Runtime's own kernels a second session gains little, and a GPU computes one inference at a
    /// time.
    #[must_use]
    pub fn sessions(&self, backend: Backend) -> usize {
        self.sessions.unwrap_or(if backend.provider == Provider::OpenVino { cpus().min(2) } else { 1 })
    }

    /// Number of threads of one inference.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.threads.unwrap_or_else(cpus)
    }
}

/// The CPUs that are available to the process.
fn cpus() -> usize {
    available_parallelism().map_or(1, NonZeroUsize::get)
}

/// The error of a run of the model.
fn run_error(model: &str, error: &ort::Error) -> RuntimeError {
    RuntimeError::Run { model: model.to_owned(), reason: error.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_openvino_has_several_sessions_by_default_and_each_has_all_cpus() {
        let all = Options { sessions: None, threads: None, ..Options::default() };
        let sessions = |provider| all.sessions(Backend { provider, ..Backend::REFERENCE });
        assert_eq!([Provider::OpenVino, Provider::Cpu, Provider::Cuda].map(sessions), [cpus().min(2), 1, 1]);
        assert_eq!(all.threads(), cpus());
        let given = Options { sessions: Some(3), threads: Some(5), ..all };
        assert_eq!((given.sessions(Backend::REFERENCE), given.threads()), (3, 5));
    }
}
