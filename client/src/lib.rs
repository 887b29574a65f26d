//! A client of graspd.
//!
//! [`Client`] speaks `grasp.v1` in the types of the domain: a [`grasp::Volume`] in, a [`Detection`] with
//! [`grasp::Grasp`]s out. [`load`] makes many calls and says how they went.
//! [`LocalServer`] runs a server of one's own for as long as it is needed.

mod access;
mod client;
mod detection;
mod error;
mod load;
mod local;

pub use access::{Access, Retry, Token};
pub use client::{Client, Health};
pub use detection::{Detection, Options};
pub use error::Error;
pub use grasp_proto::pb::{DataType, Dropped, Latency, Model};
pub use load::{Arrivals, Report, Until, load};
pub use local::{LocalServer, LocalServerError};
pub use tonic::transport::{Certificate, Identity};
