//! The generated types of `grasp.v1` (`proto/grasp/v1/grasp.proto`) with their conversions to and from the domain
//! types, and the generated types of the Open Inference Protocol.
//!
//! The conversions from messages validate every field. A [`grasp::RequestError`] names the invalid field and its value.

#![warn(missing_docs)]

mod bounded;
mod clouds;
mod grasps;
mod labels;
mod options;
mod png;
mod pose;
mod views;
mod volume;
mod warning;
mod workspace;

/// Generated types, client and server of `grasp.v1`.
#[allow(missing_docs, reason = "the .proto file documents them, and prost copies only existing comments")]
#[allow(clippy::large_enum_variant, reason = "generated: a response is larger than an error")]
pub mod pb {
    tonic::include_proto!("grasp.v1");
}

/// Generated types, client and server of the Open Inference Protocol.
#[allow(missing_docs, reason = "the .proto file documents them")]
pub mod oip {
    tonic::include_proto!("inference");
}

pub use bounded::{BoundedCodec, BoundedDecoder};
pub use clouds::{cloud, clouds};
pub use grasps::candidates;
pub use png::grey_png;
pub use pose::pose;
pub use views::{MAX_VIEWS, check_views, frame, frames};
pub use volume::{encode, resolution};
pub use workspace::{FrameStamp, check_id};

/// Encoded descriptors of both protocols, for the reflection service.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
