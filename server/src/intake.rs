//! Messages on their way in: what is too large, or stops in the middle, is refused before it is taken whole.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http::HeaderValue;
use http_body::{Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::{Code, Status};

use crate::metrics::Metrics;

/// A gRPC message's prefix: whether it is compressed, then its length, four bytes from the highest on.
const PREFIX: usize = 5;

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
pub(crate) struct Intake {
    body: Body,
    limits: Limits,
    metrics: Arc<Metrics>,
    message: Message,
    /// When the message has stood still for too long; not set between messages, where a stream may rest.
    patience: Option<Pin<Box<Sleep>>>,
    /// When all of the message must be here.
    latest: Instant,
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
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have come.
    prefixed: usize,
    /// Bytes of the message that have still to come.
    missing: usize,
}

impl Intake {
    pub fn new(body: Body, limits: Limits, metrics: Arc<Metrics>) -> Self {
        Self {
            body,
            limits,
            metrics,
            message: Message::default(),
            patience: None,
            latest: Instant::now(),
            state: State::Open,
        }
    }

    fn refuse(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.state = State::Refused;
        self.metrics.ended("", status.code());
        Poll::Ready(Some(Err(status)))
    }

    fn stalled(&self) -> Status {
        let (missing, stall) = (self.message.missing, self.limits.stall);
        let lacks = if missing == 0 { "its length".to_owned() } else { format!("{missing} bytes") };
        let why = if Instant::now() < self.latest {
            format!("has stood still for {stall:?}")
        } else {
            format!("comes more slowly than {SLOWEST} bytes a second")
        };
        Status::deadline_exceeded(format!("the message {why}, {lacks} of it are missing; send it anew"))
    }

    fn too_large(&self, bytes: usize) -> Status {
        let longest = self.limits.message_bytes;
        Status::invalid_argument(format!(
            "the message has {bytes} bytes, at most {longest} are taken (--max-message-bytes)"
        ))
    }
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
                }
                self.prefix[self.prefixed] = bytes[at];
                self.prefixed += 1;
                at += 1;
                if self.prefixed < PREFIX {
                    continue;
                }
                let [_, a, b, c, d] = self.prefix;
                self.missing = u32::from_be_bytes([a, b, c, d]) as usize;
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
}

impl http_body::Body for Intake {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        match std::mem::replace(&mut this.state, State::Open) {
            State::Open => {}
            State::Refusing(status) => return this.refuse(status),
            State::Refused => {
                this.state = State::Refused;
                return Poll::Ready(None);
            }
        }
        let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) else {
            let Some(patience) = &mut this.patience else { return Poll::Pending };
            ready!(patience.as_mut().poll(context));
            let status = this.stalled();
            return this.refuse(status);
        };
        let data = frame.as_ref().and_then(|frame| frame.as_ref().ok()?.data_ref());
        let Some(data) = data else { return Poll::Ready(frame) };
        if let Err(TooLarge { bytes, begins }) = this.message.advance(data, this.limits.message_bytes) {
            let status = this.too_large(bytes);
            if begins == 0 {
                return this.refuse(status);
            }
            this.state = State::Refusing(status);
            return Poll::Ready(Some(Ok(Frame::data(data.slice(..begins)))));
        }
        let until = Instant::now() + this.limits.stall;
        match &mut this.patience {
            patience if !this.message.has_begun() => *patience = None,
            Some(patience) => patience.as_mut().reset(until.min(this.latest)),
            patience => {
                this.latest =
                    until + this.limits.stall + Duration::from_secs_f64(this.message.missing as f64 / SLOWEST);
                *patience = Some(Box::pin(sleep_until(until)));
            }
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
