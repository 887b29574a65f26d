//! The models that are served: their registry, their queues and session threads, and what is made of a request's views.

pub(crate) mod engine;
pub(crate) mod queue;
pub(crate) mod registry;
pub(crate) mod reload;
pub(crate) mod scene;
pub(crate) mod session;
pub(crate) mod tracking;
