//! A client of graspd.
//!
//! [`Client`] speaks `grasp.v1` in the types of the domain: a [`grasp::Volume`], depth images or point clouds in, a
//! [`Detection`] with [`Proposal`]s out. [`load`] makes many calls and says how they went.
//! [`LocalServer`] runs a server of one's own for as long as it is needed.

mod access;
mod client;
mod detection;
mod error;
mod load;
mod local;

pub use access::{Access, Retry, Token};
pub use client::{Client, Health, Tracking};
pub use detection::{CloudView, Depth, DepthView, Detection, Extrinsics, Options, Proposal, Workspace};
pub use error::Error;
pub use grasp_proto::pb::{self, DataType, Dropped, Latency, Model, Options as Asked};
pub use load::{Arrivals, Report, Until, load};
pub use local::{LocalServer, LocalServerError};
pub use tonic::transport::{Certificate, Identity};
