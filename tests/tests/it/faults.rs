//! Faults outside and inside the server: failed batches, blocked logs, stalled clients and idle connections.

use std::fs;
use std::process::Command;
use std::time::Duration;

use grasp::Volume;
use grasp_client::{Access, Client, DataType, DetectOptions, Error, LocalServer, Options, Retry};
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use grasp_proto::{encode, pb};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd, metric, resident_bytes};
use h2::client::SendRequest;
use nalgebra::Isometry3;
use prost::Message;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt, copy_bidirectional};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::codegen::Bytes;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

/// The same volume with one unobserved voxel.
fn volume_with_a_zero() -> Volume {
    let mut values = volume().values().to_vec();
    values[0] = 0.0;
    Volume::new(RESOLUTION, volume().voxel_size(), Isometry3::identity(), values).unwrap()
}

#[tokio::test]
async fn a_failed_batch_fails_only_its_requests_and_names_them() {
    let model = TestModel::new("fragile").convolutions(60).fails_at_zero();
    let server = Server::run(&[model], &["--queue", "8", "--max-batch", "4"]);
    let client = server.client().await;
    let detect = |id: &str, volume: Volume| {
        let (client, request_id) = (client.clone(), id.to_owned());
        async move { client.detect(&volume, Options { request_id, ..Options::default() }).await }
    };
    let running = tokio::spawn(detect("alone", volume()));
    server.wait_for("graspd_batch_size_count{model=\"fragile 1\"}", 1.0).await;
    // These four are queued at the same time, so that they form one batch.
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
    // The session is still usable.
    assert_eq!(detect("next", volume()).await.unwrap().grasps.len(), 1);
    assert_eq!(server.metric("graspd_requests_total{code=\"INTERNAL\",model=\"fragile 1\"}"), 4.0);
    assert_eq!(server.metric("graspd_requests_total{code=\"OK\",model=\"fragile 1\"}"), 2.0);
}

/// A graspd with this log level and redirection of stderr.
fn log_to(level: &str, redirection: &str) -> (LocalServer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let models = folder.path().to_str().unwrap();
    // `install` writes the executable script. If this process wrote it, a child that another test forks meanwhile could
    // inherit the open file, and running the script would fail with ETXTBSY.
    let (draft, script) = (folder.path().join("draft"), folder.path().join("graspd-with-a-log"));
    fs::write(&draft, format!("#!/bin/sh\nexec {} \"$@\" {redirection}\n", graspd().display())).unwrap();
    assert!(Command::new("install").arg("-m755").args([&draft, &script]).status().unwrap().success());
    let args = ["--models", models, "--provider", "cpu", "--threads", "1", "--log", level];
    (LocalServer::spawn(&script, args).unwrap(), folder)
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_succeed_when_the_log_cannot_be_written() {
    // Every write to /dev/full fails, as on a full disk.
    let (mut server, _folder) = log_to("trace", "2> /dev/full");
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    for _ in 0..100 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_succeed_when_the_log_blocks_and_dropped_lines_are_counted() {
    let pipes = tempfile::tempdir().unwrap();
    let pipe = pipes.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    // `<>` also opens the pipe for reading, so that the shell does not block until there is a reader.
    let (mut server, _folder) = log_to("trace", &format!("2<> {}", pipe.display()));
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    let mut calls = 0;
    while metric(server.http(), "graspd_log_lines_dropped_total") == 0.0 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
        calls += 1;
        assert!(calls < 10_000, "the pipe is not full after {calls} requests");
    }
    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_client_that_does_not_read_blocks_no_others_and_loses_no_replies() {
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

    // Requests of another client are answered meanwhile, long enough for all of the stream to be read ahead.
    let client = server.client().await;
    for _ in 0..200 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    let answered = server.metric("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}");
    assert!(answered < 200.0 + CALLS as f64, "the server read a whole stream although its client reads no replies");

    // The slow client now reads: all replies are there, in order.
    for number in 0..CALLS {
        let reply = replies.next().await.unwrap().unwrap();
        assert_eq!(reply.request_id, number.to_string());
    }
    sender.await.unwrap();
    assert!(replies.next().await.is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn incomplete_messages_are_refused_after_the_stall_timeout() {
    let mut server = Server::run(&[TestModel::new("mirror")], &["--stall-timeout", "0.3"]);
    let message = pb::DetectGraspsRequest { volume: Some(encode(&volume(), DataType::F32, "")), ..Default::default() };
    let mut bytes = vec![0];
    bytes.extend((message.encoded_len() as u32).to_be_bytes());
    bytes.extend(message.encode_to_vec());
    let mut h2 = connect(&server).await;

    // A slow message is accepted if no pause exceeds the stall timeout.
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

    // Pieces of a stream need not end at message boundaries: the timeout applies to each message.
    let many = bytes.repeat(12);
    let (first, rest) = many.split_at(bytes.len() + 3);
    let pieces: Vec<&[u8]> = std::iter::once(first).chain(rest.chunks(bytes.len())).collect();
    let status = call("1M", &mut h2, "DetectGraspsStream", &pieces, Duration::from_millis(100), true).await;
    assert_eq!(status, (Code::Ok, String::new()));

    // One byte at a time: no pause exceeds the stall timeout, but the rate is below the minimum.
    let single: Vec<&[u8]> = bytes.chunks(1).collect();
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &single, Duration::from_millis(10), true).await;
    assert_eq!(code, Code::DeadlineExceeded);
    assert!(message.starts_with("the message is slower than 262144 bytes per second, "), "{message}");

    // An incomplete message does not delay the shutdown.
    let stuck =
        tokio::spawn(
            async move { call("1M", &mut h2, "DetectGrasps", &[&bytes[..1000]], Duration::ZERO, false).await },
        );
    tokio::task::yield_now().await;
    server.terminate().unwrap();
    assert_eq!(tokio::task::spawn_blocking(move || server.wait().unwrap().code()).await.unwrap(), Some(0));
    // The result is not checked: the connection may have closed before the call began.
    drop(stuck);
}

#[tokio::test]
async fn the_memory_of_incomplete_messages_is_bounded_and_shared() {
    const MESSAGE: usize = 1 << 20;
    const BUDGET: usize = 4 * MESSAGE;
    let budget = BUDGET.to_string();
    let server = Server::run(
        &[TestModel::new("mirror")],
        &["--max-message-bytes", "1048576", "--max-receiving-bytes", &budget, "--stall-timeout", "5"],
    );
    let mut incomplete = vec![0];
    incomplete.extend((MESSAGE as u32).to_be_bytes());
    incomplete.resize(4 + MESSAGE, 0);
    let incomplete: &'static [u8] = incomplete.leak();

    // From another address, with several connections.
    let mut floods = Vec::new();
    for _ in 0..4 {
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind(([127, 0, 0, 2], 0).into()).unwrap();
        floods.push(h2_on(socket.connect(server.grpc()).await.unwrap()).await);
    }
    let mut calls = Vec::new();
    for (index, method) in ["DetectGrasps", "DetectGraspsStream"].into_iter().cycle().take(32).enumerate() {
        let mut flood = floods[index % 4].clone();
        calls.push(tokio::spawn(
            async move { call("1M", &mut flood, method, &[incomplete], Duration::ZERO, false).await },
        ));
    }
    let used = server.wait_until("graspd_receiving_bytes", |bytes| bytes > MESSAGE as f64).await;
    assert!(used <= (BUDGET / 2) as f64, "{used} bytes from one address");
    // Others are served, also with the largest message.
    let other = server.client().await;
    other.detect(&volume(), Options::default()).await.unwrap();
    let padded = pb::DetectGraspsRequest { request_id: "x".repeat(MESSAGE - 4), ..Default::default() };
    let code = server.raw().await.detect_grasps(padded).await.unwrap_err().code();
    assert_eq!(code, Code::InvalidArgument, "the request id is too long, which only a received message can show");

    let mut codes = Vec::new();
    for call in calls {
        let (code, message) = call.await.unwrap();
        assert!(code != Code::ResourceExhausted || message.contains("--max-receiving-bytes"), "{message}");
        codes.push(code);
    }
    let count = |code: Code| codes.iter().filter(|known| **known == code).count();
    assert!(count(Code::ResourceExhausted) >= 30 && count(Code::DeadlineExceeded) >= 1, "{codes:?}");
    assert_eq!(count(Code::ResourceExhausted) + count(Code::DeadlineExceeded), 32, "{codes:?}");
    server.wait_for("graspd_receiving_bytes", 0.0).await;
    assert_eq!(server.metric("graspd_receiving_limit_bytes"), BUDGET as f64);
    let (code, _) = call("1M", &mut floods[0], "DetectGrasps", &[&[0, 0, 0, 0, 0]], Duration::ZERO, true).await;
    assert_eq!(code, Code::InvalidArgument, "the connection is still served");
}

#[tokio::test]
async fn incomplete_messages_are_refused_at_the_deadline_of_the_request() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut h2 = connect(&server).await;
    for timeout in ["1u", "100m"] {
        let (code, message) = call(timeout, &mut h2, "DetectGrasps", &[&[0, 0]], Duration::ZERO, false).await;
        assert_eq!(code, Code::DeadlineExceeded, "{timeout}: {message}");
        assert_eq!(message, "the deadline passed before the message was received");
    }
    assert_eq!(server.metric("graspd_requests_total{code=\"DEADLINE_EXCEEDED\",model=\"\"}"), 2.0);
}

/// The status line of an HTTP request with this `Host`.
async fn http_status(server: &Server, host: &str) -> String {
    let mut stream = TcpStream::connect(server.http()).await.unwrap();
    let request = format!("GET /healthz HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut response = String::new();
    stream.read_to_string(&mut response).await.unwrap();
    response.lines().next().unwrap_or_default().to_owned()
}

#[tokio::test]
async fn silent_and_slow_http_clients_block_neither_probes_nor_grpc() {
    let server = Server::run(&[TestModel::new("mirror")], &["--http-host", "graspd.example.com,other.example.com"]);
    let mut silent = Vec::new();
    for _ in 0..1000 {
        silent.push(TcpStream::connect(server.http()).await.unwrap());
    }
    for own in ["127.0.0.1:9090", "localhost", "other.example.com"] {
        assert_eq!(http_status(&server, own).await, "HTTP/1.1 200 OK", "{own}");
    }
    assert_eq!(http_status(&server, "attacker.example.com").await, "HTTP/1.1 421 Misdirected Request");
    server.client().await.detect(&volume(), Options::default()).await.unwrap();

    // Half a request is dropped in seconds.
    let mut half = TcpStream::connect(server.http()).await.unwrap();
    half.write_all(b"GET /metrics HTTP/1.1\r\nHos").await.unwrap();
    let mut rest = Vec::new();
    tokio::time::timeout(Duration::from_secs(60), half.read_to_end(&mut rest)).await.unwrap().unwrap();
    assert!(!String::from_utf8_lossy(&rest).contains("200 OK"));
}

#[tokio::test]
async fn connections_without_a_preface_are_closed() {
    let server = Server::run(&[TestModel::new("mirror")], &["--stall-timeout", "0.3"]);
    let mut silent =
        [TcpStream::connect(server.grpc()).await.unwrap(), TcpStream::connect(server.grpc()).await.unwrap()];
    silent[1].write_all(b"PRI * HTTP/2.0").await.unwrap();
    server.wait_for("graspd_connections{listener=\"grpc\"}", 2.0).await;
    server.wait_for("graspd_connections{listener=\"grpc\"}", 0.0).await;
    // After the preface a connection may stay idle.
    let client = server.client().await;
    client.detect(&volume(), Options::default()).await.unwrap();
    tokio::time::sleep(Duration::from_millis(600)).await;
    assert_eq!(server.metric("graspd_connections{listener=\"grpc\"}"), 1.0);
    client.detect(&volume(), Options::default()).await.unwrap();
}

#[tokio::test]
async fn malformed_messages_are_invalid_arguments_and_counted() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut h2 = connect(&server).await;
    // Field 5 with wire type 7, which does not exist.
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &[&[0, 0, 0, 0, 1, 0x2f]], Duration::ZERO, true).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 1.0);
    let (code, message) = call("1M", &mut h2, "DetectGrasps", &[&[]], Duration::ZERO, true).await;
    assert_eq!(code, Code::InvalidArgument, "{message}");
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 2.0);
    assert_eq!(server.metric("graspd_requests_total{code=\"INTERNAL\",model=\"\"}"), 0.0);
}

#[tokio::test]
async fn calls_that_are_reset_before_or_within_their_message_count_as_cancelled() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let h2 = connect(&server).await;
    let pieces: [&[u8]; 2] = [&[], &[0, 0, 0, 0, 9, 1]];
    for piece in pieces {
        let request = http::Request::post("http://graspd/grasp.v1.GraspService/DetectGrasps");
        let request = request.header("content-type", "application/grpc").header("te", "trailers").body(()).unwrap();
        let (_response, mut body) = h2.clone().ready().await.unwrap().send_request(request, false).unwrap();
        body.send_data(Bytes::from_static(piece), false).unwrap();
        body.send_reset(h2::Reason::CANCEL);
    }
    server.wait_for("graspd_requests_total{code=\"CANCELLED\",model=\"\"}", 2.0).await;
    assert_eq!(server.metric("graspd_requests_total{code=\"INVALID_ARGUMENT\",model=\"\"}"), 0.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_refusals_does_not_flood_the_log() {
    let logs = tempfile::tempdir().unwrap();
    let log = logs.path().join("log");
    let (mut server, _folder) = log_to("info", &format!("2> {}", log.display()));
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    let suppressed = || metric(server.http(), "graspd_log_lines_suppressed_total");
    let detect = DetectOptions { model: "missing".to_owned(), ..DetectOptions::default() };
    let options = Options { detect, ..Options::default() };
    let mut refused = 0;
    while suppressed() == 0.0 {
        assert!(refused < 10_000, "no line was suppressed");
        for _ in 0..100 {
            client.detect(&volume(), options.clone()).await.unwrap_err();
        }
        refused += 100;
    }
    let suppressed = suppressed() as usize;
    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
    let text = std::fs::read_to_string(log).unwrap();
    let lines = text.lines().filter(|line| line.contains("refused") && line.contains("missing")).count();
    assert_eq!(lines + suppressed, refused, "{text}");
}

#[tokio::test]
async fn connections_above_the_limit_are_closed_and_others_stay() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-connections", "2"]);
    let clients = [server.client().await, server.client().await];
    for client in &clients {
        client.detect(&volume(), Options::default()).await.unwrap();
    }
    assert_eq!(server.metric("graspd_connections{listener=\"grpc\"}"), 2.0);
    let third = Client::connect(server.grpc().to_string()).await;
    let answered = match third {
        Ok(third) => third.detect(&volume(), Options::default()).await.is_ok(),
        Err(_) => false,
    };
    assert!(!answered);
    let [first, second] = clients;
    drop(first);
    server.wait_for("graspd_connections{listener=\"grpc\"}", 1.0).await;
    server.client().await.detect(&volume(), Options::default()).await.unwrap();
    second.detect(&volume(), Options::default()).await.unwrap();
}

#[tokio::test]
async fn connections_are_replaced_at_their_age_and_no_call_fails() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-connection-age", "0.2"]);
    let target = server.grpc();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (sender, mut accepted) = mpsc::channel(100);
    tokio::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            sender.send(()).await.unwrap();
            tokio::spawn(async move {
                let mut server = TcpStream::connect(target).await.unwrap();
                let _ = copy_bidirectional(&mut client, &mut server).await;
            });
        }
    });
    // A call that is sent while its connection is closed was not processed, and is sent again.
    let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
    let client = Client::connect_with(address, access).await.unwrap();
    let (requests, sent) = mpsc::channel(1);
    let mut stream = GraspServiceClient::new(server.channel().await);
    let request =
        pb::DetectGraspsRequest { volume: Some(encode(&volume(), pb::DataType::F32, "")), ..Default::default() };
    let mut replies = stream.detect_grasps_stream(ReceiverStream::new(sent)).await.unwrap().into_inner();
    for _ in 0..3 {
        while accepted.try_recv().is_err() {
            client.detect(&volume(), Options::default()).await.unwrap();
        }
        // A call that is open continues.
        requests.send(request.clone()).await.unwrap();
        assert!(replies.next().await.unwrap().is_ok());
    }
}

#[tokio::test]
#[ignore = "opens as many files: make test-faults"]
async fn ten_thousand_idle_connections_use_little_memory_and_delay_no_requests() {
    const CONNECTIONS: usize = 10_000;
    let server = Server::run(&[TestModel::new("mirror")], &["--log", "warn"]);
    let client = server.client().await;
    client.detect(&volume(), Options::default()).await.unwrap();
    let before = resident_bytes(server.id());
    let mut idle = Vec::new();
    for _ in 0..CONNECTIONS {
        idle.push(connect(&server).await);
    }
    server.wait_for("graspd_connections{listener=\"grpc\"}", CONNECTIONS as f64 + 1.0).await;
    for _ in 0..100 {
        assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 1);
    }
    server.client().await.detect(&volume(), Options::default()).await.unwrap();
    let each = (resident_bytes(server.id()) - before) / CONNECTIONS as u64;
    println!("{each} bytes a connection");
    assert!(each < 100_000, "{each} bytes a connection");
    drop(idle);
    server.wait_for("graspd_connections{listener=\"grpc\"}", 1.0).await;
}

async fn connect(server: &Server) -> SendRequest<Bytes> {
    h2_on(TcpStream::connect(server.grpc()).await.unwrap()).await
}

async fn h2_on(stream: TcpStream) -> SendRequest<Bytes> {
    let (h2, connection) = h2::client::handshake(stream).await.unwrap();
    tokio::spawn(connection);
    h2
}

/// Calls a method with these bytes, piece by piece, with a pause after each. `timeout` is the value of `grpc-timeout`.
/// Returns the code and the message of the status.
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
        // The server may have ended the call.
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
