//! Size limits, at the exact boundaries.

use grasp_proto::{encode, pb};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use prost::Message;
use tokio_stream::StreamExt;
use tonic::Code;
use tonic::codec::CompressionEncoding;

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
