//! Client library of graspd.
//!
//! [`Client`] sends a [`grasp::Volume`], depth images or point clouds over `grasp.v1` and returns a [`Detection`] with
//! [`Proposal`]s. [`load`] generates load and reports latencies. [`LocalServer`] runs a graspd as a child process.
//!
//! Units are metres, radians and seconds. A pose `T_a_b` maps points of frame b into frame a.
//!
//! ```no_run
//! use grasp_client::{Access, Client, Depth, DepthView, DetectOptions, Extrinsics, Options, Retry, Workspace};
//! use nalgebra::Isometry3;
//!
//! # async fn example(millimetres: Vec<u16>, k: [f64; 9], camera_from_task: Isometry3<f64>) -> Result<(), grasp_client::Error> {
//! let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
//! let client = Client::connect_with("127.0.0.1:50051", access).await?;
//! let view = DepthView {
//!     depth: Depth::Millimetres(millimetres),
//!     width: 640,
//!     height: 480,
//!     k,
//!     extrinsics: Extrinsics::CameraFromTask(camera_from_task),
//!     labels: None,
//! };
//! let detect = DetectOptions { max_grasps: 5, ..DetectOptions::default() };
//! let detection = client.detect_from_depth(&[view], &Workspace::default(), Options { detect, ..Options::default() }).await?;
//! for grasp in &detection.grasps {
//!     println!("{:.2} at {}", grasp.quality, grasp.pose);
//! }
//! # Ok(())
//! # }
//! ```

#![warn(missing_docs)]

mod access;
mod address;
mod client;
mod detection;
mod error;
mod load;
mod local;

pub use access::{Access, Retry, Token};
pub use client::{Client, Health, Tracking};
pub use detection::{
    AnyView, Candidate, CloudView, Depth, DepthView, Detection, Extrinsics, FindTable, Observation, Options, Proposal,
    Scores, Workspace,
};
pub use error::Error;
pub use grasp_proto::pb::{
    self, DataType, Dropped, FoundTable, GeometryWarning, Latency, Model, Options as DetectOptions, Score,
};
pub use load::{Arrivals, Report, Until, load};
pub use local::{LocalServer, LocalServerError};
pub use tonic::transport::{Certificate, Identity};
