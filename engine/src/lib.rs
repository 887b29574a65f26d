//! The engine: serves the planners of a model folder. It is independent of gRPC and Prometheus: errors are
//! [`RequestError`](grasp::RequestError)s, and what is counted goes to an [`Observer`].
//!
//! A request becomes one scene per cube. [`Model::detect`] puts the scenes into the model's queue; a session thread
//! takes batches from it, runs the planner, and sends each result to its [`Reply`].

#![warn(missing_docs)]

mod control;
mod detection;
mod fair_queue;
mod fair_semaphore;
mod fingerprints;
mod job;
mod model;
mod model_folder;
mod observer;
mod registry;
mod retry_hints;
mod scheduler;
mod service_time;
mod session;
mod session_health;
mod session_threads;
mod timings;

pub use control::{Change, ModelControl};
pub use detection::{Detected, Detection, Score, Scores, Violation};
pub use fair_queue::{Caller, RequestMetadata};
pub use fair_semaphore::{FairSemaphore, Permit};
pub use fingerprints::{Fingerprints, fingerprints};
pub use job::{Reply, SessionOutput, Tensors};
pub use model::{Model, ModelSettings};
pub use model_folder::{FolderSettings, Loads, ModelFolder};
pub use observer::{ModelLabels, ModelObserver, Observer, Refusal, Reload};
pub use registry::{ModelRegistry, Models, Unavailable};
pub use scheduler::Batching;
pub use session_threads::SessionThreads;
pub use timings::{StageTimings, Statistics, Totals};
