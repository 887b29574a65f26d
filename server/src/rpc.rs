//! The gRPC services `grasp.v1` and Open Inference Protocol.

pub(crate) mod call;
pub(crate) mod grasp_service;
mod infer_request;
pub(crate) mod inference_service;
mod pending;
mod status;
mod streams;
