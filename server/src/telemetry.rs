//! Log, traces, metrics, and the latest requests for the web page.

pub(crate) mod metrics;
pub(crate) mod recent;
pub(crate) mod subscriber;
pub(crate) mod timings;
