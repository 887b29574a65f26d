//! What goes wrong around a server, and inside it.

use std::fs;
use std::process::Command;
use std::time::Duration;

use grasp::Volume;
use grasp_client::{Client, DataType, Error, LocalServer, Options};
use grasp_proto::{encode, pb};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd, metric, resident_bytes};
use h2::client::SendRequest;
use nalgebra::Isometry3;
use prost::Message;
use tempfile::TempDir;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::codegen::Bytes;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

/// The same, but for a voxel that was not observed.
fn volume_with_a_zero() -> Volume {
    let mut values = volume().values().to_vec();
    values[0] = 0.0;
    Volume::new(RESOLUTION, volume().voxel_size(), Isometry3::identity(), values).unwrap()
}

#[tokio::test]
async fn when_a_batch_fails_only_its_requests_do_and_they_say_which_they_were() {
    let model = TestModel::new("fragile").convolutions(60).fails_at_zero();
    let server = Server::run(&[model], &["--queue", "8", "--max-batch", "4"]);
    let client = server.client().await;
    let detect = |id: &str, volume: Volume| {
        let (client, request_id) = (client.clone(), id.to_owned());
        async move { client.detect(&volume, Options { request_id, ..Options::default() }).await }
    };
    let running = tokio::spawn(detect("alone", volume()));
    server.wait_for("graspd_batch_size_count{model=\"fragile 1\"}", 1.0).await;
    // These wait together, hence they run together.
    let mut batch = JoinSet::new();
    for id in ["a", "b", "c"] {
        batch.spawn(detect(id, volume()));
    }
    batch.spawn(detect("bad", volume_with_a_zero()));
    server.wait_for("graspd_queue_requests{model=\"fragile 1\"}", 4.0).await;

    assert_eq!(running.await.unwrap().unwrap().grasps.len(), 1);
    let outcomes = batch.join_all().await;
    assert_eq!(outcomes.len(), 4);
    for outcome in outcomes {
        let Err(Error::Refused { code: Code::Internal, message, .. }) = outcome else { panic!("{outcome:?}") };
        assert!(["a", "b", "c", "bad"].iter().any(|id| message.ends_with(&format!("(request {id})"))), "{message}");
    }
    // The session lives on.
    assert_eq!(detect("next", volume()).await.unwrap().grasps.len(), 1);
    assert_eq!(server.metric("graspd_requests_total{code=\"INTERNAL\",model=\"fragile 1\"}"), 4.0);
    assert_eq!(server.metric("graspd_requests_total{code=\"OK\",model=\"fragile 1\"}"), 2.0);
}

/// A graspd that logs all there is to log, to wherever the shell puts it.
fn log_to(redirection: &str) -> (LocalServer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let models = folder.path().to_str().unwrap();
    // Another process makes the script executable: had this one written it, a child that another test forks meanwhile
    // would hold it open for writing, and it could not be run.
    let (draft, script) = (folder.path().join("draft"), folder.path().join("graspd-with-a-log"));
    fs::write(&draft, format!("#!/bin/sh\nexec {} \"$@\" {redirection}\n", graspd().display())).unwrap();
    assert!(Command::new("install").arg("-m755").args([&draft, &script]).status().unwrap().success());
    let args = ["--models", models, "--provider", "cpu", "--threads", "1", "--log", "trace"];
    (LocalServer::spawn(&script, args).unwrap(), folder)
}

#[tokio::test]
async fn a_log_that_cannot_be_written_stops_nothing() {
    // A disk that is always full.
    let (mut server, _folder) = log_to("2> /dev/full");
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    for _ in 0..100 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_log_that_nobody_reads_holds_up_nobody_and_what_it_loses_is_counted() {
    let pipes = tempfile::tempdir().unwrap();
    let pipe = pipes.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    // Opened for reading, too, lest the shell wait for a reader.
    let (mut server, _folder) = log_to(&format!("2<> {}", pipe.display()));
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    let mut calls = 0;
    while metric(server.http(), "graspd_log_lines_dropped_total") == 0.0 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
        calls += 1;
        assert!(calls < 10_000, "the pipe never filled");
    }
    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_client_that_does_not_read_holds_up_nobody_and_loses_nothing() {
    const CALLS: usize = 3000;
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let endpoint = tonic::transport::Channel::from_shared(format!("http://{}", server.grpc())).unwrap();
    let channel = endpoint.initial_stream_window_size(1024).connect().await.unwrap();
    let mut slow = pb::grasp_service_client::GraspServiceClient::new(channel);
    let message = encode(&volume(), DataType::U8, "");
    let (send, requests) = mpsc::channel(1);
    let mut replies = slow.detect_grasps_stream(ReceiverStream::new(requests)).await.unwrap().into_inner();
    let sender = tokio::spawn(async move {
        for number in 0..CALLS {
            let request_id = number.to_string();
            let request = pb::DetectGraspsRequest { request_id, volume: Some(message.clone()), ..Default::default() };
            send.send(request).await.unwrap();
        }
    });

    // Somebody else is answered meanwhile, more often than the slow one could have been if it were all read ahead.
    let client = server.client().await;
    for _ in 0..200 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    let answered = server.metric("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}");
    assert!(answered < 200.0 + CALLS as f64, "the server reads no further ahead than it can answer");

    // It comes back to its senses, and finds every answer in its order.
    for number in 0..CALLS {
        let reply = replies.next().await.unwrap().unwrap();
        assert_eq!(reply.request_id, number.to_string());
    }
    sender.await.unwrap();
    assert!(replies.next().await.is_none());
}

#[tokio::test]
async fn half_a_message_is_waited_for_no_longer_than_it_may_stand_still() {
    let mut server = Server::run(&[TestModel::new("mirror")], &["--stall-timeout", "0.3"]);
    let message = pb::DetectGraspsRequest { volume: Some(encode(&volume(), DataType::F32, "")), ..Default::default() };
    let mut bytes = vec![0];
    bytes.extend((message.encoded_len() as u32).to_be_bytes());
    bytes.extend(message.encode_to_vec());
    let mut h2 = connect(&server).await;

    // A slow one is heard out, for it never stands still for long.
    let pieces: Vec<&[u8]> = bytes.chunks(bytes.len() / 4 + 1).collect();
    let status = call("1M", &mut h2, "DetectGrasps", &pieces, Duration::from_millis(100), true).await;
    assert_eq!(status, (Code::Ok, String::new()));

    for sent in [0, 3, 5, 1000, bytes.len() - 1] {
        let (code, message) = call("1M", &mut h2, "DetectGrasps", &[&bytes[..sent]], Duration::ZERO, false).await;
        assert_eq!(code, Code::DeadlineExceeded);
        let missing = if sent < 5 { "its length".to_owned() } else { format!("{} bytes", bytes.len() - sent) };
        assert_eq!(
            message,
            format!("the message stalled for 300ms (--stall-timeout), {missing} missing; send it again")
        );
    }
    assert_eq!(server.metric("graspd_requests_total{code=\"DEADLINE_EXCEEDED\",model=\"\"}"), 5.0);

    // Messages of a stream may be cut anywhere: each has its own time.
    let many = bytes.repeat(12);
    let (first, rest) = many.split_at(bytes.len() + 3);
    let pieces: Vec<&[u8]> = std::iter::once(first).chain(rest.chunks(bytes.len())).collect();
    let status = call("1M", &mut h2, "DetectGraspsStream", &pieces, Duration::from_millis(100), true).await;
    assert_eq!(status, (Code::Ok, String::new()));

    // Fed a byte at a time it never stands still, and is refused all the same.
    let single: Vec<&[u8]> = bytes.chunks(1).collect();
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &single, Duration::from_millis(10), true).await;
    assert_eq!(code, Code::DeadlineExceeded);
    assert!(message.starts_with("the message is slower than 65536 bytes per second, "), "{message}");

    // Nor does it hold up the end.
    let stuck =
        tokio::spawn(
            async move { call("1M", &mut h2, "DetectGrasps", &[&bytes[..1000]], Duration::ZERO, false).await },
        );
    tokio::task::yield_now().await;
    server.terminate().unwrap();
    assert_eq!(tokio::task::spawn_blocking(move || server.wait().unwrap().code()).await.unwrap(), Some(0));
    // The connection may have been closed before the call was begun.
    drop(stuck);
}

#[tokio::test]
async fn nobody_is_waited_for_beyond_their_own_deadline() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut h2 = connect(&server).await;
    for timeout in ["1u", "100m"] {
        let (code, message) = call(timeout, &mut h2, "DetectGrasps", &[&[0, 0]], Duration::ZERO, false).await;
        assert_eq!(code, Code::DeadlineExceeded, "{timeout}: {message}");
        assert_eq!(message, "the deadline passed before the message was received");
    }
    assert_eq!(server.metric("graspd_requests_total{code=\"DEADLINE_EXCEEDED\",model=\"\"}"), 2.0);
}

#[tokio::test]
async fn who_connects_and_says_nothing_is_not_waited_for() {
    let server = Server::run(&[TestModel::new("mirror")], &["--stall-timeout", "0.3"]);
    let mut silent =
        [TcpStream::connect(server.grpc()).await.unwrap(), TcpStream::connect(server.grpc()).await.unwrap()];
    silent[1].write_all(b"PRI * HTTP/2.0").await.unwrap();
    server.wait_for("graspd_connections", 2.0).await;
    server.wait_for("graspd_connections", 0.0).await;
    // Who has greeted may rest.
    let client = server.client().await;
    client.detect(&volume(), Options::default()).await.unwrap();
    tokio::time::sleep(Duration::from_millis(600)).await;
    assert_eq!(server.metric("graspd_connections"), 1.0);
    client.detect(&volume(), Options::default()).await.unwrap();
}

#[tokio::test]
async fn what_is_no_message_is_the_callers_fault_and_counted() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut h2 = connect(&server).await;
    // The fifth field of wire type 7, which there is none of.
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &[&[0, 0, 0, 0, 1, 0x2f]], Duration::ZERO, true).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 1.0);
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &[&[]], Duration::ZERO, true).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 2.0);
    assert_eq!(server.metric("graspd_requests_total{code=\"INTERNAL\",model=\"\"}"), 0.0);
}

#[tokio::test]
async fn connections_beyond_the_most_are_closed_and_those_below_are_not() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-connections", "2"]);
    let clients = [server.client().await, server.client().await];
    for client in &clients {
        client.detect(&volume(), Options::default()).await.unwrap();
    }
    assert_eq!(server.metric("graspd_connections"), 2.0);
    let third = Client::connect(server.grpc().to_string()).await;
    let answered = match third {
        Ok(third) => third.detect(&volume(), Options::default()).await.is_ok(),
        Err(_) => false,
    };
    assert!(!answered);
    let [first, second] = clients;
    drop(first);
    server.wait_for("graspd_connections", 1.0).await;
    server.client().await.detect(&volume(), Options::default()).await.unwrap();
    second.detect(&volume(), Options::default()).await.unwrap();
}

#[tokio::test]
#[ignore = "opens as many files: make test-faults"]
async fn ten_thousand_idle_connections_cost_little_and_hold_up_nobody() {
    const CONNECTIONS: usize = 10_000;
    let server = Server::run(&[TestModel::new("mirror")], &["--log", "warn"]);
    let client = server.client().await;
    client.detect(&volume(), Options::default()).await.unwrap();
    let before = resident_bytes(server.id());
    let mut idle = Vec::new();
    for _ in 0..CONNECTIONS {
        idle.push(connect(&server).await);
    }
    server.wait_for("graspd_connections", CONNECTIONS as f64 + 1.0).await;
    for _ in 0..100 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    server.client().await.detect(&volume(), Options::default()).await.unwrap();
    let each = (resident_bytes(server.id()) - before) / CONNECTIONS as u64;
    println!("{each} bytes a connection");
    assert!(each < 100_000, "{each} bytes a connection");
    drop(idle);
    server.wait_for("graspd_connections", 1.0).await;
}

async fn connect(server: &Server) -> SendRequest<Bytes> {
    let stream = TcpStream::connect(server.grpc()).await.unwrap();
    let (h2, connection) = h2::client::handshake(stream).await.unwrap();
    tokio::spawn(connection);
    h2
}

/// Calls a method with these bytes, piece by piece, as one who waits so long, as `grpc-timeout` has it; the status and its
/// message.
async fn call(
    timeout: &str,
    h2: &mut SendRequest<Bytes>,
    method: &str,
    pieces: &[&[u8]],
    pause: Duration,
    ends: bool,
) -> (Code, String) {
    let request = http::Request::post(format!("http://graspd/grasp.v1.GraspService/{method}"));
    let request = request.header("content-type", "application/grpc").header("te", "trailers");
    let request = request.header("grpc-timeout", timeout).body(()).unwrap();
    let (response, mut body) = h2.clone().ready().await.unwrap().send_request(request, false).unwrap();
    for (index, piece) in pieces.iter().enumerate() {
        // The server may have ended it.
        if body.send_data(Bytes::copy_from_slice(piece), ends && index + 1 == pieces.len()).is_err() {
            break;
        }
        tokio::time::sleep(pause).await;
    }
    let response = response.await.unwrap();
    let mut headers = response.headers().clone();
    let mut body = response.into_body();
    while let Some(data) = body.data().await {
        let length = data.unwrap().len();
        body.flow_control().release_capacity(length).unwrap();
    }
    headers.extend(body.trailers().await.unwrap().unwrap_or_default());
    let status = tonic::Status::from_header_map(&headers).expect("a status");
    (status.code(), status.message().to_owned())
}
