//! The calls of `grasp.v1` and of the Open Inference Protocol.

pub(crate) mod call;
pub(crate) mod grasp_service;
pub(crate) mod inference_service;
pub(crate) mod refusal;
