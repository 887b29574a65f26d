//! `grasp.v1` on the wire: the types generated from `proto/grasp/v1/grasp.proto`, and their conversions to and from
//! the domain; and those of the Open Inference Protocol.
//!
//! [`pb::Volume`] → [`grasp::Volume`] is where a request is checked: a [`FieldError`] names the field and its value.

mod error;
mod grasps;
mod options;
mod pose;
mod views;
mod volume;

/// The generated types, the client and the server of `grasp.v1`.
#[allow(missing_docs, reason = "the .proto file documents them, and prost copies that only where there is a comment")]
pub mod pb {
    tonic::include_proto!("grasp.v1");
}

/// The same of the Open Inference Protocol.
#[allow(missing_docs, reason = "the .proto file documents them")]
pub mod oip {
    tonic::include_proto!("inference");
}

pub use error::{FieldError, on_a_line};
pub use options::{Collision, DetectParams, TABLE_HEIGHT};
pub use pose::pose;
pub use views::{MAX_VIEWS, Points, Workspace, check_count, cloud_view, depth_view};
pub use volume::{encode, resolution};

/// The descriptors of everything in `grasp.v1`, encoded: what reflection serves.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
