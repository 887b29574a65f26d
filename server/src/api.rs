//! The protocols: `grasp.v1` and the Open Inference Protocol over gRPC; the latter and grasps in depth images also over
//! HTTP.

mod blocking;
pub(crate) mod call;
pub(crate) mod grasp;
pub(crate) mod inference;
pub(crate) mod rest;
pub(crate) mod status;
