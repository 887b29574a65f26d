//! graspd: a gRPC service that detects grasps in depth images, point clouds and TSDF volumes.
//!
//! A request passes from `transport` (connections, TLS, tokens, limits) through `api` (messages, calls) to the crates
//! `perception` (scenes) and `engine` (queues, sessions). `telemetry` records logs, traces and metrics; `http` serves
//! metrics, probes and a web page.

mod api;
mod config;
mod http;
mod lifecycle;
mod open_streams;
mod readiness;
mod signals;
mod telemetry;
mod tracked_volumes;
mod transport;

pub use lifecycle::run;
