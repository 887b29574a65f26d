//! The served models: registry, queues, session threads, hot reload, and the fusion of views into scenes.

pub(crate) mod control;
pub(crate) mod cubes;
pub(crate) mod detection;
pub(crate) mod engine;
pub(crate) mod frame_stamp;
pub(crate) mod job;
mod lines;
mod model_files;
pub(crate) mod observation;
pub(crate) mod queue;
pub(crate) mod refusal;
pub(crate) mod registry;
pub(crate) mod reload;
mod retries;
mod scene;
pub(crate) mod session;
pub(crate) mod session_threads;
pub(crate) mod stamps;
pub(crate) mod tracking;
pub(crate) mod turns;
