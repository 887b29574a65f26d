//! graspd: a gRPC service that detects grasps in depth images, point clouds and TSDF volumes.
//!
//! A request passes from `transport` (connections, TLS, tokens, limits) through `rpc` (messages, refusals) to `serving`
//! (model registry, queues, sessions). `rest` is the Open Inference Protocol over HTTP. `telemetry` records logs, traces
//! and metrics; `http` serves metrics, probes and a web page.

mod config;
mod http;
mod lifecycle;
mod readiness;
mod rest;
mod rpc;
mod serving;
mod signals;
mod telemetry;
mod transport;

pub use lifecycle::run;
