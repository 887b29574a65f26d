//! graspd: grasps for what a depth camera sees, over gRPC.
//!
//! A request goes from `transport` (connections, TLS, tokens, limits) through `rpc` (messages, refusals) to `serving`
//! (model registry, queues, sessions), and back. `telemetry` observes it, `http` shows it.

mod config;
mod http;
mod lifecycle;
mod readiness;
mod rpc;
mod serving;
mod signals;
mod telemetry;
mod transport;

pub use lifecycle::run;
