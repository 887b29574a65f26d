//! Bodies of HTTP requests, with the limits on gRPC messages.

use std::future::poll_fn;
use std::io::{self, Write};
use std::pin::Pin;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::http::HeaderValue;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, EXPECT};
use axum::http::request::Parts;
use flate2::write::{MultiGzDecoder, ZlibDecoder};
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

/// Reads the rest of a body whose request is refused: a client that is still sending would not read the response, and
/// would see only a broken connection. A client that asks first (`Expect: 100-continue`) sends nothing when it is
/// refused.
pub(super) async fn discard(mut body: Body, parts: &Parts, limits: Limits) {
    if parts.headers.contains_key(EXPECT) {
        return;
    }
    let _ = timeout(limits.stall, async { while let Some(Ok(_)) = next(&mut body).await {} }).await;
}

async fn receive(body: &mut Body, parts: &Parts, limits: Limits) -> Result<Message, Status> {
    let mut content = Content::new(parts.headers.get(CONTENT_ENCODING), limits.message_bytes)?;
    let announced = parts.headers.get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    if let Some(bytes) = announced.filter(|bytes| *bytes > limits.message_bytes) {
        return Err(limits.too_large(bytes));
    }
    let peer = Peer::from_extensions(&parts.extensions)
        .ok_or_else(|| Status::internal("the request belongs to no connection"))?;
    let mut received = peer.share.clone().message();
    let started = Instant::now();
    loop {
        let longest = limits.longest(announced.unwrap_or(limits.message_bytes));
        let pause = limits.stall.min(longest.saturating_sub(started.elapsed()));
        let frame = timeout(pause, next(body)).await.map_err(|_| stalled(pause, limits.stall))?;
        let Some(frame) = frame else { return Ok(Message { bytes: content.finish()?, _received: received }) };
        let frame = frame.map_err(|error| Status::cancelled(format!("the body ended early: {error}")))?;
        let Some(data) = frame.data_ref() else { continue };
        let before = content.output().bytes.len();
        if let Err(error) = content.write(data) {
            return Err(match content.output().excess {
                Some(bytes) => limits.too_large(bytes),
                None => Status::invalid_argument(format!("the body is not valid: {error}")),
            });
        }
        received.add(content.output().bytes.len() - before)?;
    }
}

/// The content of a body, decompressed as it arrives.
enum Content {
    Plain(Output),
    Gzip(MultiGzDecoder<Output>),
    /// In the zlib format, as HTTP defines it (RFC 9110).
    Deflate(ZlibDecoder<Output>),
}

impl Content {
    fn new(encoding: Option<&HeaderValue>, limit: usize) -> Result<Self, Status> {
        let output = Output { bytes: Vec::new(), limit, excess: None };
        // Names of encodings have no case (RFC 9110).
        let encoding = encoding.map(|name| String::from_utf8_lossy(name.as_bytes()).trim().to_ascii_lowercase());
        match encoding.as_deref() {
            None | Some("" | "identity") => Ok(Self::Plain(output)),
            Some("gzip" | "x-gzip") => Ok(Self::Gzip(MultiGzDecoder::new(output))),
            Some("deflate") => Ok(Self::Deflate(ZlibDecoder::new(output))),
            Some(other) => {
                let reason = format!("the header Content-Encoding is {other:?}, must be gzip, deflate or absent");
                Err(Status::invalid_argument(reason))
            }
        }
    }

    fn output(&self) -> &Output {
        match self {
            Self::Plain(output) => output,
            Self::Gzip(decoder) => decoder.get_ref(),
            Self::Deflate(decoder) => decoder.get_ref(),
        }
    }

    fn write(&mut self, data: &[u8]) -> io::Result<()> {
        match self {
            Self::Plain(output) => output.write_all(data),
            Self::Gzip(decoder) => decoder.write_all(data).and_then(|()| decoder.flush()),
            Self::Deflate(decoder) => decoder.write_all(data).and_then(|()| decoder.flush()),
        }
    }

    fn finish(self) -> Result<Bytes, Status> {
        let output = match self {
            Self::Plain(output) => Ok(output),
            Self::Gzip(decoder) => decoder.finish(),
            Self::Deflate(mut decoder) => match decoder.write(&[0]) {
                // It takes no byte after the end of its stream; `finish` accepts a stream that is cut short.
                Ok(0) => decoder.finish(),
                _ => Err(io::Error::other("it is cut short")),
            },
        };
        let output = output.map_err(|error| Status::invalid_argument(format!("the body is not valid: {error}")))?;
        Ok(output.bytes.into())
    }
}

/// Decompressed bytes, up to a limit.
struct Output {
    bytes: Vec<u8>,
    limit: usize,
    /// Number of bytes that exceeded the limit.
    excess: Option<usize>,
}

impl Write for Output {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let bytes = self.bytes.len() + data.len();
        if bytes > self.limit {
            self.excess = Some(bytes);
            return Err(io::Error::other("the body is too large"));
        }
        self.bytes.extend_from_slice(data);
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
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
