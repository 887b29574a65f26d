//! Messages on their way in: what is too large, or stops in the middle, is refused before it is taken whole.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http::HeaderValue;
use http_body::{Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep};
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::{Code, Status};

use crate::telemetry::metrics::Metrics;
use crate::transport::deadline::Deadline;

/// A gRPC message's prefix: whether it is compressed, then its length, four bytes from the highest on.
const PREFIX: usize = 5;

/// How the methods end that take a stream of messages.
const STREAMS: [&str; 3] = ["Stream", "TrackGrasps", "ServerReflectionInfo"];

/// What a message must come by at least, bytes a second: one that is fed a byte at a time never stands still.
const SLOWEST: f64 = 65_536.0;

/// What is taken of anybody.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// The largest message, bytes.
    pub message_bytes: usize,
    /// How long a message that has begun may stand still, and a connection before its first.
    pub stall: Duration,
}

/// The body of a request, held to the limits.
pub(crate) struct RequestBody {
    body: Body,
    /// When the caller gives up. tonic watches over it, too, and calls what it ends cancelled.
    deadline: Option<Deadline>,
    limits: Limits,
    metrics: Arc<Metrics>,
    /// Whether messages may come whenever they like, as those of a stream do.
    rests: bool,
    message: Message,
    /// Since when the client is waited for.
    since: Option<Instant>,
    /// For how long it was, in this message; what the server takes to read on is not the client's fault.
    waited: Duration,
    /// Ends the waiting.
    patience: Pin<Box<Sleep>>,
    state: State,
}

enum State {
    Open,
    /// What came before is still handed on.
    Refusing(Status),
    Refused,
}

/// Where in a message the body is.
#[derive(Debug, Default, PartialEq, Eq)]
struct Message {
    /// Which message, from 1 on; 0 before the first.
    number: usize,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have come.
    prefixed: usize,
    /// Bytes of the message that have still to come.
    missing: usize,
}

impl RequestBody {
    /// The body of a request for a method at `path`.
    pub fn new(path: &str, body: Body, deadline: Option<Deadline>, limits: Limits, metrics: Arc<Metrics>) -> Self {
        let rests = STREAMS.iter().any(|stream| path.ends_with(stream));
        Self {
            body,
            // Answers of a stream may be worth having although its end never comes.
            deadline: deadline.filter(|_| !rests),
            limits,
            metrics,
            rests,
            message: Message::default(),
            since: None,
            waited: Duration::ZERO,
            patience: Box::pin(sleep(Duration::ZERO)),
            state: State::Open,
        }
    }

    /// Whether there is something that the client should send at once.
    fn is_owed(&self) -> bool {
        self.message.has_begun() || !self.rests
    }

    /// For how much longer the client is waited for.
    fn left(&self) -> Duration {
        let Limits { stall, .. } = self.limits;
        let slowest = 2 * stall + Duration::from_secs_f64(self.message.length() as f64 / SLOWEST);
        stall.min(slowest.saturating_sub(self.waited))
    }

    fn refuse(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.state = State::Refused;
        self.metrics.ended("", status.code());
        Poll::Ready(Some(Err(status)))
    }

    fn stalled(&self) -> Status {
        let stall = self.limits.stall;
        let lacks = match self.message.missing {
            0 if self.message.number > 0 && !self.message.has_begun() => "the end of the request is".to_owned(),
            0 => "its length is".to_owned(),
            missing => format!("{missing} bytes of it are"),
        };
        let why = if self.left() < stall {
            format!("comes more slowly than {SLOWEST} bytes a second")
        } else {
            format!("has stood still for {stall:?}")
        };
        Status::deadline_exceeded(format!("the message {why}, {lacks} missing; send it anew"))
    }

    fn too_large(&self, bytes: usize) -> Status {
        let longest = self.limits.message_bytes;
        Status::invalid_argument(format!(
            "the message has {bytes} bytes, at most {longest} are taken (--max-message-bytes)"
        ))
    }
}

fn late() -> Status {
    Status::deadline_exceeded("the caller's time was up before its message had come")
}

/// Of what is no message tonic says `INTERNAL`, as if it were to blame, and nobody counts it. Its own errors are told from
/// ours by having no details.
pub(crate) fn unreadable(mut response: http::Response<Body>, metrics: &Metrics) -> http::Response<Body> {
    let headers = response.headers_mut();
    let is_tonics = !headers.contains_key(Status::GRPC_STATUS_DETAILS);
    let status = headers.get(Status::GRPC_STATUS).and_then(|code| code.to_str().ok()?.parse().ok());
    if is_tonics && status == Some(Code::Internal as i32) {
        metrics.ended("", Code::InvalidArgument);
        headers.insert(Status::GRPC_STATUS, HeaderValue::from(Code::InvalidArgument as i32));
    }
    response
}

/// The same of a message of a stream.
pub(crate) fn unreadable_message(status: Status, metrics: &Metrics) -> Status {
    if status.code() != Code::Internal {
        return status;
    }
    metrics.ended("", Code::InvalidArgument);
    Status::invalid_argument(status.message())
}

/// A message that is longer than it may be.
#[derive(Debug, PartialEq, Eq)]
struct TooLarge {
    bytes: usize,
    /// Where in what has come it begins, 0 also if it began before.
    begins: usize,
}

impl Message {
    /// Goes on by what has come.
    fn advance(&mut self, bytes: &[u8], longest: usize) -> Result<(), TooLarge> {
        let (mut at, mut begins) = (0, 0);
        while at < bytes.len() {
            if self.prefixed < PREFIX {
                if self.prefixed == 0 {
                    begins = at;
                    self.number += 1;
                }
                self.prefix[self.prefixed] = bytes[at];
                self.prefixed += 1;
                at += 1;
                if self.prefixed < PREFIX {
                    continue;
                }
                self.missing = self.length();
                if self.missing > longest {
                    return Err(TooLarge { bytes: self.missing, begins });
                }
            }
            let taken = self.missing.min(bytes.len() - at);
            self.missing -= taken;
            at += taken;
            if self.missing == 0 {
                self.prefixed = 0;
            }
        }
        Ok(())
    }

    fn has_begun(&self) -> bool {
        self.prefixed > 0
    }

    /// Of the message, bytes; 0 until it is known.
    fn length(&self) -> usize {
        let [_, a, b, c, d] = self.prefix;
        if self.prefixed == PREFIX { u32::from_be_bytes([a, b, c, d]) as usize } else { 0 }
    }
}

impl http_body::Body for RequestBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        match std::mem::replace(&mut this.state, State::Open) {
            State::Open if this.deadline.is_some_and(Deadline::has_passed) => return this.refuse(late()),
            State::Open => {}
            State::Refusing(status) => return this.refuse(status),
            State::Refused => {
                this.state = State::Refused;
                return Poll::Ready(None);
            }
        }
        let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) else {
            if !this.is_owed() {
                return Poll::Pending;
            }
            if this.since.is_none() {
                let (now, left) = (Instant::now(), this.left());
                this.since = Some(now);
                let until = this.deadline.map_or(now + left, |Deadline(deadline)| (now + left).min(deadline.into()));
                this.patience.as_mut().reset(until);
            }
            ready!(this.patience.as_mut().poll(context));
            let is_late = this.deadline.is_some_and(Deadline::has_passed);
            return this.refuse(if is_late { late() } else { this.stalled() });
        };
        if let Some(since) = this.since.take() {
            this.waited += since.elapsed();
        }
        let data = match &frame {
            Some(Ok(frame)) => frame.data_ref(),
            // Who goes resets the stream, which hyper tells as its end; tonic would take it for a broken message.
            Some(Err(_)) | None if this.message.has_begun() => {
                let status = Status::cancelled("the caller has gone in the middle of the message");
                return this.refuse(status);
            }
            Some(Err(_)) | None => None,
        };
        let Some(data) = data else { return Poll::Ready(frame) };
        let before = this.message.number;
        if let Err(TooLarge { bytes, begins }) = this.message.advance(data, this.limits.message_bytes) {
            let status = this.too_large(bytes);
            if begins == 0 {
                return this.refuse(status);
            }
            this.state = State::Refusing(status);
            return Poll::Ready(Some(Ok(Frame::data(data.slice(..begins)))));
        }
        if this.message.number != before {
            this.waited = Duration::ZERO;
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        matches!(self.state, State::Refused) || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_followed_however_they_are_cut() {
        let mut bytes = Vec::new();
        for length in [0_u32, 3, 0, 300, 7] {
            bytes.push(0);
            bytes.extend(length.to_be_bytes());
            bytes.extend((0..length).map(|byte| byte as u8));
        }
        for size in [1, 2, 5, 6, 17, 1000] {
            let mut message = Message::default();
            let mut begun = 0;
            for piece in bytes.chunks(size) {
                message.advance(piece, 300).unwrap();
                begun += usize::from(message.has_begun());
            }
            assert_eq!((message.prefixed, message.missing), (0, 0), "in pieces of {size}");
            assert!(size != 1 || begun == bytes.len() - 5, "all bytes but the last ones of five messages");
        }
    }

    #[test]
    fn a_message_over_the_limit_is_known_by_its_length() {
        let mut message = Message::default();
        assert_eq!(message.advance(&[0, 0, 0, 1], 300), Ok(()));
        assert!(message.has_begun());
        assert_eq!(message.advance(&[45], 300), Err(TooLarge { bytes: 301, begins: 0 }));
        // One byte of a message, then a longer one.
        let mut message = Message::default();
        assert_eq!(message.advance(&[0, 0, 0, 0, 1], 1), Ok(()));
        assert_eq!(message.advance(&[7, 0, 0, 0, 0, 9, 7], 1), Err(TooLarge { bytes: 9, begins: 1 }));
    }
}
