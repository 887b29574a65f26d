//! `grasp.v1` as JSON, by protobuf's own mapping: names in lowerCamelCase, enums as words, bytes in base64.

use std::sync::LazyLock;

use grasp_proto::{FILE_DESCRIPTOR_SET, pb};
use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor};
use tonic::Status;

static POOL: LazyLock<DescriptorPool> = LazyLock::new(|| {
    DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("the descriptors are those that prost was built from")
});

fn descriptor(name: &str) -> MessageDescriptor {
    POOL.get_message_by_name(name).expect("the message is in grasp.proto")
}

/// The request in a body.
pub(super) fn request(body: &[u8]) -> Result<pb::DetectGraspsFromDepthRequest, Status> {
    let refused = |error: &dyn std::fmt::Display| {
        let error = error.to_string();
        let advice = if error.contains("base64") { "; base64 must have no line breaks (base64 -w0)" } else { "" };
        Status::invalid_argument(format!(
            "the body is not a grasp.v1.DetectGraspsFromDepthRequest in JSON: {error}{advice}"
        ))
    };
    // Editors on Windows write a byte order mark.
    let mut json = serde_json::Deserializer::from_slice(body.strip_prefix(b"\xef\xbb\xbf").unwrap_or(body));
    let descriptor = descriptor("grasp.v1.DetectGraspsFromDepthRequest");
    let message = DynamicMessage::deserialize(descriptor, &mut json).map_err(|error| refused(&error))?;
    json.end().map_err(|error| refused(&error))?;
    message.transcode_to().map_err(|error| refused(&error))
}

/// The body of a response.
pub(super) fn response(reply: &pb::DetectGraspsResponse) -> Result<Vec<u8>, Status> {
    let failed =
        |error: &dyn std::fmt::Display| Status::internal(format!("the reply cannot be written as JSON: {error}"));
    let descriptor = descriptor("grasp.v1.DetectGraspsResponse");
    let message =
        DynamicMessage::decode(descriptor, reply.encode_to_vec().as_slice()).map_err(|error| failed(&error))?;
    serde_json::to_vec(&message).map_err(|error| failed(&error))
}
