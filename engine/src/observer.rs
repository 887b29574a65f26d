use std::sync::Arc;

use grasp::Priority;

/// Counts what happens in the engine.
pub trait Observer: Send + Sync {
    /// The observer of the model with this label (`name version`), which is about to be served.
    fn model(&self, label: &str) -> Arc<dyn ModelObserver>;

    /// The served models have changed.
    fn replaced(&self, before: &[ModelLabels], now: &[ModelLabels]);

    /// The model folder was read again.
    fn reloaded(&self, outcome: Reload);
}

/// Counts what happens to the requests of one model.
pub trait ModelObserver: Send + Sync {
    /// This many more scenes wait than before.
    fn waiting(&self, more: i64);

    /// A queue has accepted scenes.
    fn accepted(&self, priority: Priority, scenes: usize);

    /// A request was refused.
    fn refused(&self, reason: Refusal);

    /// A session has taken a batch.
    fn batch(&self, scenes: usize);

    /// This many more sessions hang than before.
    fn hanging(&self, more: i64);
}

/// Why a queue refuses a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The queue is full.
    Full,
    /// The reply would be too late.
    Deadline,
    /// Another request displaced it.
    Displaced,
}

/// The outcome of a reload of the model folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reload {
    /// The folder was read; this many files could not be loaded.
    Read {
        /// Number of rejected files.
        rejected: usize,
    },
    /// The folder could not be read, or not in time.
    Failed,
    /// A later reload had begun; this one changed nothing.
    Superseded,
}

/// What identifies a served model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelLabels {
    /// `name version`.
    pub model: String,
    /// The execution provider.
    pub provider: String,
    /// The numeric precision.
    pub precision: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
}
