//! The served models: registry, queues, session threads, hot reload, and the fusion of views into scenes.

pub(crate) mod engine;
pub(crate) mod job;
mod model_files;
pub(crate) mod queue;
pub(crate) mod registry;
pub(crate) mod reload;
pub(crate) mod scene;
pub(crate) mod session;
pub(crate) mod stamps;
pub(crate) mod tracking;
