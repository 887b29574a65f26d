//! Bodies of HTTP requests, with the limits on gRPC messages.

use std::future::poll_fn;
use std::pin::Pin;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, EXPECT};
use axum::http::request::Parts;
use http_body::{Body as _, Frame};
use tokio::time::timeout;
use tonic::{Code, Status};

use crate::transport::connections::Peer;
use crate::transport::receive_budget::Received;
use crate::transport::request_body::Limits;

/// The body of a request. It counts as a message that is being received until it is dropped.
pub(super) struct Message {
    pub bytes: Bytes,
    _received: Received,
}

/// Reads the body of a request. Refuses it if it is too large, stalls, arrives too slowly, or exceeds the memory for
/// messages that are being received.
pub(super) async fn read(mut body: Body, parts: &Parts, limits: Limits) -> Result<Message, Status> {
    let message = receive(&mut body, parts, limits).await;
    if message.as_ref().is_err_and(|status| status.code() != Code::DeadlineExceeded) {
        discard(body, parts, limits).await;
    }
    message
}

/// Reads the rest of a body whose request is refused: a client that is still sending would not read the response, and see
/// only a broken connection. A client that asks first (`Expect: 100-continue`) sends nothing when it is refused.
pub(super) async fn discard(mut body: Body, parts: &Parts, limits: Limits) {
    if parts.headers.contains_key(EXPECT) {
        return;
    }
    let _ = timeout(limits.stall, async { while let Some(Ok(_)) = next(&mut body).await {} }).await;
}

async fn receive(body: &mut Body, parts: &Parts, limits: Limits) -> Result<Message, Status> {
    if let Some(encoding) = parts.headers.get(CONTENT_ENCODING) {
        return Err(Status::invalid_argument(format!("the header Content-Encoding is {encoding:?}, must be absent")));
    }
    let announced = parts.headers.get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    if let Some(bytes) = announced.filter(|bytes| *bytes > limits.message_bytes) {
        return Err(limits.too_large(bytes));
    }
    let peer = Peer::of(&parts.extensions).ok_or_else(|| Status::internal("the request belongs to no connection"))?;
    let mut received = peer.share.clone().message();
    let mut bytes: Vec<u8> = Vec::new();
    let started = Instant::now();
    loop {
        let longest = limits.longest(announced.unwrap_or(limits.message_bytes));
        let pause = limits.stall.min(longest.saturating_sub(started.elapsed()));
        let frame = timeout(pause, next(body)).await.map_err(|_| stalled(pause, limits.stall))?;
        let Some(frame) = frame else { return Ok(Message { bytes: bytes.into(), _received: received }) };
        let frame = frame.map_err(|error| Status::cancelled(format!("the body ended early: {error}")))?;
        let Some(data) = frame.data_ref() else { continue };
        if bytes.len() + data.len() > limits.message_bytes {
            return Err(limits.too_large(bytes.len() + data.len()));
        }
        received.add(data.len())?;
        bytes.extend_from_slice(data);
    }
}

async fn next(body: &mut Body) -> Option<Result<Frame<Bytes>, axum::Error>> {
    poll_fn(|context| Pin::new(&mut *body).poll_frame(context)).await
}

fn stalled(pause: Duration, stall: Duration) -> Status {
    let reason =
        if pause < stall { "is too slow".to_owned() } else { format!("stalled for {stall:?} (--stall-timeout)") };
    Status::deadline_exceeded(format!("the body {reason}; send it again"))
}
