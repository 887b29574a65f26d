//! Limits and shutdown of the REST listener. `tests/python/test_inference.py` has its messages.

use std::time::Duration;

use grasp_tests::{RESOLUTION, Server, TestModel};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// An open request: its head, and the bytes of its body that are sent.
async fn open(server: &Server, path: &str, length: usize, body: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(server.rest().unwrap()).await.unwrap();
    let head = format!("POST {path} HTTP/1.1\r\nHost: graspd\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n");
    stream.write_all(head.as_bytes()).await.unwrap();
    // The server may have refused the request.
    let _ = stream.write_all(body).await;
    stream
}

/// The status and the body of a response.
async fn response(mut stream: TcpStream) -> (u16, String) {
    let mut text = String::new();
    tokio::time::timeout(Duration::from_secs(120), stream.read_to_string(&mut text)).await.unwrap().unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no response: {text}"));
    (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_owned())
}

/// An inference request with one volume of 0.5.
fn infer() -> String {
    let shape = [1, 1, RESOLUTION, RESOLUTION, RESOLUTION];
    let values = vec!["0.5"; RESOLUTION.pow(3)].join(",");
    format!(r#"{{"inputs": [{{"name": "tsdf", "datatype": "FP32", "shape": {shape:?}, "data": [{values}]}}]}}"#)
}

const INFER: &str = "/v2/models/mirror/infer";

#[tokio::test]
async fn bodies_that_stall_or_are_too_large_are_refused() {
    let flags = ["--rest", "127.0.0.1:0", "--stall-timeout", "0.3", "--max-message-bytes", "100000"];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    let (status, body) = response(open(&server, INFER, 1000, b"{").await).await;
    assert!(status == 408 && body.contains("stalled for 300ms (--stall-timeout)"), "{status} {body}");
    let (status, body) = response(open(&server, INFER, 100_001, b"").await).await;
    assert!(status == 400 && body.contains("100001 bytes, must have at most 100000"), "{status} {body}");
    let (status, body) = response(open(&server, INFER, infer().len(), infer().as_bytes()).await).await;
    assert!(status == 200 && body.contains("\"model_name\":\"mirror\""), "{status} {body}");
    assert_eq!(server.metric("graspd_receiving_bytes"), 0.0);
    assert_eq!(server.metric("graspd_requests_total{code=\"DEADLINE_EXCEEDED\",model=\"\"}"), 1.0);
}

#[tokio::test]
async fn web_pages_and_unknown_encodings_are_refused() {
    let server = Server::run(&[TestModel::new("mirror")], &["--rest", "127.0.0.1:0", "--allow-model-control"]);
    for (header, status, reason) in [
        ("Origin: http://attacker.example.com", 403, "requests of web pages are not accepted"),
        ("Content-Encoding: br", 400, "the header Content-Encoding is"),
    ] {
        let mut stream = TcpStream::connect(server.rest().unwrap()).await.unwrap();
        let path = "/v2/repository/models/mirror/unload";
        let head = format!("POST {path} HTTP/1.1\r\nHost: graspd\r\nConnection: close\r\n{header}\r\n\r\n");
        stream.write_all(head.as_bytes()).await.unwrap();
        let (code, body) = response(stream).await;
        assert!(code == status && body.contains(reason), "{code} {body}");
    }
}

#[tokio::test]
async fn a_compressed_body_that_is_cut_short_is_refused() {
    let server = Server::run(&[TestModel::new("mirror")], &["--rest", "127.0.0.1:0"]);
    // `{}` in the zlib format.
    let whole = b"\x78\x9c\xab\xae\x05\x00\x01\x75\x00\xf9";
    for (length, reason) in [(whole.len(), "inputs"), (whole.len() - 2, "it is cut short"), (4, "it is cut short")] {
        let mut stream = TcpStream::connect(server.rest().unwrap()).await.unwrap();
        let head =
            format!("Host: graspd\r\nConnection: close\r\nContent-Encoding: deflate\r\nContent-Length: {length}");
        stream.write_all(format!("POST {INFER} HTTP/1.1\r\n{head}\r\n\r\n").as_bytes()).await.unwrap();
        stream.write_all(&whole[..length]).await.unwrap();
        let (status, body) = response(stream).await;
        assert!(status == 400 && body.contains(reason), "{status} {body}");
    }
}

#[tokio::test]
async fn unknown_paths_and_methods_have_an_error_as_a_body() {
    let server = Server::run(&[TestModel::new("mirror")], &["--rest", "127.0.0.1:0"]);
    for (path, status, reason) in [
        ("/v2/systemsharedmemory/status", 404, "the path `/v2/systemsharedmemory/status` is not served"),
        ("/v2/models/mirror/ready", 405, "the path `/v2/models/mirror/ready` does not accept POST"),
    ] {
        let (code, body) = response(open(&server, path, 0, b"").await).await;
        assert!(code == status && body.starts_with("{\"error\":\"") && body.contains(reason), "{code} {body}");
    }
}

#[tokio::test]
async fn incomplete_bodies_share_the_memory_of_incomplete_messages() {
    let flags = ["--rest", "127.0.0.1:0", "--max-message-bytes", "1000000", "--max-receiving-bytes", "2000000"];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    let part = vec![b' '; 900_000];
    let mut held = Vec::new();
    for _ in 0..4 {
        held.push(open(&server, INFER, 1_000_000, &part).await);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    // The last ones exceed their share.
    let (status, body) = response(held.pop().unwrap()).await;
    assert!(status == 429 && body.contains("--max-receiving-bytes"), "{status} {body}");
    assert!(server.metric("graspd_receiving_bytes") <= 2_000_000.0);
    let (status, _) = response(open(&server, INFER, infer().len(), infer().as_bytes()).await).await;
    assert_eq!(status, 200, "others are served");
    drop(held);
    server.wait_for("graspd_receiving_bytes", 0.0).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn accepted_requests_are_answered_before_the_exit() {
    let mut server = Server::run(&[TestModel::new("mirror").convolutions(60)], &["--rest", "127.0.0.1:0"]);
    let calls = [open(&server, INFER, infer().len(), infer().as_bytes()).await].map(response);
    server.wait_for("graspd_batch_size_count{model=\"mirror 1\"}", 1.0).await;
    // An idle connection does not delay the exit.
    let _idle = TcpStream::connect(server.rest().unwrap()).await.unwrap();
    server.terminate().unwrap();
    for call in calls {
        assert_eq!(call.await.0, 200);
    }
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn connections_are_limited_and_counted() {
    let flags = ["--rest", "127.0.0.1:0", "--max-connections", "2"];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    let metric = |name: &str| server.metric(&format!("graspd_connections{name}{{listener=\"rest\"}}"));
    assert_eq!((metric(""), metric("_limit"), metric("_refused_total")), (0.0, 2.0, 0.0));
    // The header is complete, the body is not.
    let held = [open(&server, INFER, 100, b"{").await, open(&server, INFER, 100, b"{").await];
    server.wait_until("graspd_receiving_bytes", |bytes| bytes > 1.0).await;
    let mut third = TcpStream::connect(server.rest().unwrap()).await.unwrap();
    assert_eq!(third.read(&mut [0]).await.unwrap_or(0), 0);
    assert_eq!((metric(""), metric("_refused_total")), (2.0, 1.0));
    drop(held);
    server.wait_for("graspd_connections{listener=\"rest\"}", 0.0).await;
}

#[tokio::test]
async fn requests_expire_at_the_time_in_their_header() {
    let server = Server::run(&[TestModel::new("mirror").convolutions(60)], &["--rest", "127.0.0.1:0"]);
    let mut stream = TcpStream::connect(server.rest().unwrap()).await.unwrap();
    let (body, head) = (infer(), "Host: graspd\r\nConnection: close\r\ngrpc-timeout: 100m");
    let head = format!("POST {INFER} HTTP/1.1\r\n{head}\r\nContent-Length: {}\r\n\r\n", body.len());
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.write_all(body.as_bytes()).await.unwrap();
    let (status, body) = response(stream).await;
    assert!(status == 408 && body.contains("deadline"), "{status} {body}");
}
