//! What operators see: the log, traces, metrics, and the latest requests.

pub(crate) mod metrics;
pub(crate) mod recent;
pub(crate) mod subscriber;
pub(crate) mod timings;
