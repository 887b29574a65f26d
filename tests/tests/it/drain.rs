//! Shutdown of the server, and errors at its start.
//!
//! Several threads, so that clients read what the server sends while a test waits for its exit.

use std::process::{Command, Stdio};
use std::time::Duration;

use grasp::Volume;
use grasp_client::{Client, LocalServer, LocalServerError, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd};
use nalgebra::Isometry3;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Endpoint;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

fn slow() -> TestModel {
    TestModel::new("slow").convolutions(60)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_idle_server_exits_with_code_0() {
    for workers in ["1", "3"] {
        let server = Server::run(&[TestModel::new("mirror")], &["--workers", workers]);
        let client = server.client().await;
        client.detect(&volume(), Options::default()).await.unwrap();
        // The client's connection is still open.
        assert_eq!(stop(server).await, Some(0));
        assert!(client.detect(&volume(), Options::default()).await.is_err());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn accepted_requests_are_answered_before_the_exit() {
    let mut server = Server::run(&[slow()], &["--queue", "8"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..4 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 3.0).await;
    server.terminate().unwrap();
    for outcome in calls.join_all().await {
        assert_eq!(outcome.unwrap().grasps.len(), 1);
    }
    assert!(Client::connect(server.grpc().to_string()).await.is_err(), "new connections are refused");
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_open_stream_is_ended_with_unavailable() {
    let mut server = Server::run(&[TestModel::new("mirror")], &[]);
    let (send, requests) = mpsc::channel(1);
    send.send((volume(), Options::default())).await.unwrap();
    let mut replies = server.client().await.detect_stream(ReceiverStream::new(requests)).await.unwrap();
    assert_eq!(replies.next().await.unwrap().unwrap().grasps.len(), 1);
    server.terminate().unwrap();
    // The client keeps its side open; the server ends the stream with an error.
    let ended = replies.next().await.expect("the error that ends the stream").unwrap_err();
    assert_eq!(ended.code(), Some(tonic::Code::Unavailable), "{ended}");
    assert!(replies.next().await.is_none());
    assert_eq!(server.wait().unwrap().code(), Some(0));
    drop(send);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_open_reflection_stream_does_not_delay_the_exit() {
    let mut server = Server::run(&[TestModel::new("mirror")], &["--drain-timeout", "3600"]);
    let channel = Endpoint::from_shared(format!("http://{}", server.grpc())).unwrap().connect().await.unwrap();
    let mut client = ServerReflectionClient::new(channel);
    let (send, requests) = mpsc::channel(1);
    let message_request = Some(MessageRequest::ListServices(String::new()));
    send.send(ServerReflectionRequest { message_request, ..Default::default() }).await.unwrap();
    let mut replies = client.server_reflection_info(ReceiverStream::new(requests)).await.unwrap().into_inner();
    assert!(replies.next().await.unwrap().is_ok());
    server.terminate().unwrap();
    // The client keeps its side open.
    assert!(replies.next().await.is_none());
    assert_eq!(server.wait().unwrap().code(), Some(0));
    drop(send);
}

#[tokio::test(flavor = "multi_thread")]
async fn after_the_drain_timeout_requests_are_refused_and_the_exit_code_is_0() {
    let mut server = Server::run(&[slow()], &["--queue", "8", "--drain-timeout", "0"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..4 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 3.0).await;
    server.terminate().unwrap();
    for outcome in calls.join_all().await {
        outcome.expect_err("the drain timeout is 0");
    }
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_is_warming_up_exits_with_code_0() {
    let server = Server::start(&[slow()], &[]);
    assert_eq!(stop(server).await, Some(0));
}

#[test]
fn sigterm_at_any_moment_of_the_start_ends_the_process_with_code_0() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["first", "second"] {
        TestModel::new(name).convolutions(60).write(folder.path());
    }
    for milliseconds in [0, 3, 10, 20, 40, 80, 160, 320] {
        let mut process = Command::new(graspd())
            .args(["--models".as_ref(), folder.path().as_os_str()])
            .args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--provider", "cpu", "--threads", "1"])
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        // From the first instructions of the program, in which a signal ends any process.
        while !handles_sigterm(process.id()) {
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(milliseconds));
        assert!(Command::new("kill").arg(process.id().to_string()).status().unwrap().success());
        assert_eq!(process.wait().unwrap().code(), Some(0), "after {milliseconds} ms");
    }
}

/// Whether a process has a handler for SIGTERM (15).
fn handles_sigterm(process: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    u64::from_str_radix(caught.trim(), 16).unwrap() >> 14 & 1 == 1
}

#[test]
fn all_configuration_errors_are_reported_in_one_run() {
    let output = Command::new(graspd())
        .args(["--listen", "nowhere", "--workers", "-1", "--drain-timeout", "-1", "--models", "/no/such/folder"])
        .env("GRASPD_QUEUE", "many")
        .env("GRASPD_LOG", "a=b=c")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    for error in [
        "--listen (GRASPD_LISTEN) is `nowhere`",
        "--workers (GRASPD_WORKERS) is `-1`",
        "--drain-timeout (GRASPD_DRAIN_TIMEOUT) is `-1`",
        "--models (GRASPD_MODELS) is `/no/such/folder`: /no/such/folder: No such file",
        "--queue (GRASPD_QUEUE) is `many`",
        "--log (GRASPD_LOG) is `a=b=c`",
    ] {
        assert!(text.contains(error), "`{error}` is missing from:\n{text}");
    }
    assert!(output.stdout.is_empty(), "no address is bound");
}

#[test]
fn a_local_server_that_exits_is_an_error() {
    let error = LocalServer::spawn(graspd(), ["--models", "/no/such/folder"]).unwrap_err();
    assert!(matches!(error, LocalServerError::Ended(status) if status.code() == Some(2)), "{error}");
    let error = LocalServer::spawn("/no/such/graspd".as_ref(), [""; 0]).unwrap_err();
    assert!(error.to_string().starts_with("cannot run /no/such/graspd: No such file"), "{error}");
}

#[test]
fn an_address_in_use_is_named() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let taken = server.grpc().to_string();
    let output = Command::new(graspd())
        .args(["--models".as_ref(), server.models().as_os_str()])
        .args(["--listen", &taken, "--http", "127.0.0.1:0"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains(&format!("cannot listen on --listen {taken}")), "{text}");
}

/// The exit status after SIGTERM.
async fn stop(mut server: Server) -> Option<i32> {
    server.terminate().unwrap();
    tokio::task::spawn_blocking(move || server.wait().unwrap().code()).await.unwrap()
}
