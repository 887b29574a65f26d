//! Log, traces, metrics, recordings, and the latest requests for the web page.

mod log_rate;
pub(crate) mod metrics;
pub(crate) mod recent;
pub(crate) mod recorder;
pub(crate) mod subscriber;
