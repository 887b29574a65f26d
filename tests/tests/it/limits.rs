//! Size limits, at the exact boundaries.

use std::collections::BTreeMap;
use std::time::Duration;

use grasp_proto::{FILE_DESCRIPTOR_SET, encode, oip, pb};
use grasp_tests::{RESOLUTION, Raw, Server, TestModel, blobs};
use nalgebra::Isometry3;
use prost::Message;
use prost::bytes::Bytes;
use prost::encoding::WireType;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FileDescriptorSet};
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tonic::codec::{CompressionEncoding, Streaming};
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

fn request(padding: usize) -> pb::DetectGraspsRequest {
    let volume = encode(&blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]), pb::DataType::F32, "");
    pb::DetectGraspsRequest { request_id: "x".repeat(padding), volume: Some(volume), ..Default::default() }
}

#[tokio::test]
async fn a_message_at_the_limit_is_accepted_and_a_larger_one_is_refused() {
    let limit = request(10).encoded_len();
    assert_eq!(request(11).encoded_len(), limit + 1);
    let server = Server::run(&[TestModel::new("mirror")], &["--max-message-bytes", &limit.to_string()]);
    let mut client = server.raw().await;
    for _ in 0..3 {
        assert_eq!(client.detect_grasps(request(10)).await.unwrap().into_inner().grasps.len(), 1);
        let status = client.detect_grasps(request(11)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument);
        for number in [limit, limit + 1] {
            assert!(status.message().contains(&number.to_string()), "{}", status.message());
        }
    }
}

#[tokio::test]
async fn compressed_messages_are_accepted_up_to_the_limit_of_their_content() {
    let limit = request(10).encoded_len();
    let server = Server::run(&[TestModel::new("mirror")], &["--max-message-bytes", &limit.to_string()]);
    for encoding in [CompressionEncoding::Gzip, CompressionEncoding::Zstd] {
        let mut client = server.raw().await.send_compressed(encoding);
        assert_eq!(client.detect_grasps(request(10)).await.unwrap().into_inner().grasps.len(), 1);
        let status = client.detect_grasps(request(11)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert!(status.message().contains(&limit.to_string()), "{status}");
        // 200 MB of zeros, which are 200 kB when they are compressed.
        let bomb = pb::Volume { data: vec![0; 200 << 20].into(), ..Default::default() };
        let status =
            client.detect_grasps(pb::DetectGraspsRequest { volume: Some(bomb), ..request(0) }).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        let mut replies =
            client.detect_grasps_stream(tokio_stream::iter([request(10), request(11)])).await.unwrap().into_inner();
        assert_eq!(replies.next().await.unwrap().unwrap().request_id, "x".repeat(10));
        assert_eq!(replies.next().await.unwrap().unwrap_err().code(), Code::InvalidArgument);
    }
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 6.0);
    assert!(grasp_tests::peak_bytes(server.id()) < 200 << 20, "the bombs were not decompressed");
}

/// Adds a message and the messages declared in it, by their full names.
fn collect<'a>(message: &'a DescriptorProto, scope: &str, messages: &mut BTreeMap<String, &'a DescriptorProto>) {
    let name = format!("{scope}.{}", message.name());
    message.nested_type.iter().for_each(|nested| collect(nested, &name, messages));
    messages.insert(name, message);
}

/// Many empty or small elements of each repeated field of a message and of the messages in it: the path of the field
/// and the encoded message of about `size` bytes.
fn floods(messages: &BTreeMap<String, &DescriptorProto>, message: &str, size: usize) -> Vec<(String, Vec<u8>)> {
    let mut all = Vec::new();
    for field in &messages[message].field {
        let prefixed = |content: &[u8]| {
            let mut bytes = Vec::new();
            prost::encoding::encode_key(field.number() as u32, WireType::LengthDelimited, &mut bytes);
            prost::encode_length_delimiter(content.len(), &mut bytes).unwrap();
            bytes.extend(content);
            bytes
        };
        let is_length_delimited = matches!(field.r#type(), Type::Message | Type::String | Type::Bytes);
        // These numbers are not larger in memory than in the message.
        if field.label() == Label::Repeated && !matches!(field.r#type(), Type::Bool | Type::Float | Type::Double) {
            let many = if is_length_delimited { prefixed(&[]).repeat(size / 2) } else { prefixed(&vec![1; size]) };
            all.push((field.name().to_owned(), many));
        }
        if field.r#type() == Type::Message {
            let inner = floods(messages, field.type_name(), size);
            all.extend(inner.into_iter().map(|(path, bytes)| (format!("{}.{path}", field.name()), prefixed(&bytes))));
        }
    }
    all
}

#[tokio::test]
async fn a_message_of_many_small_elements_is_refused_before_it_is_decoded() {
    const SIZE: usize = 15 << 20;
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let channel = server.channel().await;
    let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
    let mut messages = BTreeMap::new();
    for file in &files.file {
        file.message_type.iter().for_each(|message| collect(message, &format!(".{}", file.package()), &mut messages));
    }
    let before = grasp_tests::peak_bytes(server.id());
    let mut paths = Vec::new();
    for file in &files.file {
        for service in &file.service {
            for method in &service.method {
                let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                for (field, message) in floods(&messages, method.input_type(), SIZE) {
                    let mut client = tonic::client::Grpc::new(channel.clone());
                    client.ready().await.unwrap();
                    let request = Request::new(tokio_stream::once(Bytes::from(message)));
                    let replies = client.streaming(request, path.parse().unwrap(), Raw).await;
                    let status = match replies {
                        Ok(replies) => replies.into_inner().next().await.and_then(Result::err),
                        Err(status) => Some(status),
                    };
                    let status = status.unwrap_or_else(|| panic!("{path}: {field} was accepted"));
                    assert_eq!(status.code(), Code::InvalidArgument, "{path}: {field}: {status}");
                    paths.push(field);
                }
            }
        }
    }
    let peak = grasp_tests::peak_bytes(server.id()) - before;
    println!("{} fields, {} MiB above {} MiB", paths.len(), peak >> 20, before >> 20);
    assert!(paths.iter().any(|path| path == "inputs.contents.int64_contents") && paths.len() > 20, "{paths:?}");
    assert!(peak < 3 * SIZE as u64, "{} MiB for messages of {} MiB", peak >> 20, SIZE >> 20);
}

#[tokio::test]
async fn a_message_over_the_limit_ends_the_stream_but_not_the_connection() {
    let limit = request(10).encoded_len();
    let server = Server::run(&[TestModel::new("mirror")], &["--max-message-bytes", &limit.to_string()]);
    let mut client = server.raw().await;
    let requests = tokio_stream::iter([request(10), request(11), request(10)]);
    let mut replies = client.detect_grasps_stream(requests).await.unwrap().into_inner();
    assert_eq!(replies.next().await.unwrap().unwrap().request_id, "x".repeat(10));
    assert_eq!(replies.next().await.unwrap().unwrap_err().code(), Code::InvalidArgument);
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 1.0);
    assert!(replies.next().await.is_none());
    assert!(client.detect_grasps(request(10)).await.is_ok());
}

#[tokio::test]
async fn a_volume_larger_than_the_http2_windows_is_accepted() {
    let resolution = 128;
    let server = Server::run(&[TestModel::new("mirror").resolution(resolution)], &[]);
    let volume = encode(&blobs(resolution, Isometry3::identity(), &[[50, 60, 70]]), pb::DataType::F32, "");
    assert_eq!(volume.data.len(), 8 << 20);
    let request = pb::DetectGraspsRequest { volume: Some(volume), ..Default::default() };
    let mut client = server.raw().await;
    assert_eq!(client.detect_grasps(request).await.unwrap().into_inner().grasps.len(), 1);
}

#[tokio::test]
async fn request_ids_are_accepted_up_to_the_limit() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut client = server.raw().await;
    assert_eq!(client.detect_grasps(request(256)).await.unwrap().into_inner().request_id.len(), 256);
    assert_eq!(client.detect_grasps(request(257)).await.unwrap_err().code(), Code::InvalidArgument);
}

/// Calls ModelInfer. Its response is read only when the stream is.
async fn infer(
    channel: Channel,
    request: oip::ModelInferRequest,
) -> Result<Streaming<oip::ModelInferResponse>, Status> {
    let mut client = tonic::client::Grpc::new(channel).max_decoding_message_size(usize::MAX);
    client.ready().await.unwrap();
    let path = "/inference.GRPCInferenceService/ModelInfer".parse().unwrap();
    let codec = tonic_prost::ProstCodec::default();
    Ok(client.server_streaming(Request::new(request), path, codec).await?.into_inner())
}

#[tokio::test]
async fn the_rest_of_a_response_is_dropped_if_the_client_does_not_read_it() {
    // Its maps have 50 MB, of which the buffer of unread responses holds five.
    let resolution: usize = 128;
    let server = Server::run(&[TestModel::new("mirror").resolution(resolution)], &["--stall-timeout", "3"]);
    let edge = i64::try_from(resolution).unwrap();
    let request = oip::ModelInferRequest {
        model_name: "mirror".to_owned(),
        inputs: vec![oip::model_infer_request::InferInputTensor {
            name: "tsdf".to_owned(),
            datatype: "FP32".to_owned(),
            shape: vec![1, 1, edge, edge, edge],
            ..Default::default()
        }],
        raw_input_contents: vec![0.5_f32.to_le_bytes().repeat(resolution.pow(3)).into()],
        ..Default::default()
    };
    let channel = server.channel().await;
    let mut calls = JoinSet::new();
    for _ in 0..8 {
        calls.spawn(infer(channel.clone(), request.clone()));
    }
    let mut unread = Vec::new();
    let mut refusals = Vec::new();
    for call in calls.join_all().await {
        match call {
            Ok(response) => unread.push(response),
            Err(refusal) => refusals.push(refusal),
        }
    }
    assert!(!unread.is_empty() && !refusals.is_empty(), "{refusals:?}");
    for refusal in refusals {
        assert_eq!(refusal.code(), Code::ResourceExhausted, "{refusal}");
        assert!(refusal.message().contains("unread"), "{refusal}");
    }
    // The buffer has room again although no client has read.
    let mut attempts = 0..600;
    let mut later = loop {
        attempts.next().expect("the unread responses are still kept");
        match infer(channel.clone(), request.clone()).await {
            Ok(response) => break response,
            Err(refusal) => assert_eq!(refusal.code(), Code::ResourceExhausted, "{refusal}"),
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    };
    drop(unread);
    assert_eq!(later.message().await.unwrap().unwrap().raw_output_contents.len(), 3);
}
