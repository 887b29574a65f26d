//! Messages on their way in: what is too large, or stops in the middle, is refused before it is taken whole.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http_body::{Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;

use crate::metrics::Metrics;

/// A gRPC message's prefix: whether it is compressed, then its length, four bytes from the highest on.
const PREFIX: usize = 5;

/// What is taken of anybody.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// The largest message, bytes.
    pub message_bytes: usize,
    /// How long a message that has begun may stand still.
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
        Self { body, limits, metrics, message: Message::default(), patience: None, state: State::Open }
    }

    fn refuse(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.state = State::Refused;
        self.metrics.ended("", status.code());
        Poll::Ready(Some(Err(status)))
    }

    fn stalled(&self) -> Status {
        let (missing, stall) = (self.message.missing, self.limits.stall);
        let lacks = if missing == 0 { "its length".to_owned() } else { format!("{missing} bytes") };
        Status::deadline_exceeded(format!(
            "the message has stood still for {stall:?}, {lacks} of it are missing; send it anew"
        ))
    }

    fn too_large(&self, bytes: usize) -> Status {
        let longest = self.limits.message_bytes;
        Status::invalid_argument(format!(
            "the message has {bytes} bytes, at most {longest} are taken (--max-message-bytes)"
        ))
    }
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
        match &mut this.patience {
            patience if !this.message.has_begun() => *patience = None,
            Some(patience) => patience.as_mut().reset(Instant::now() + this.limits.stall),
            patience => *patience = Some(Box::pin(sleep(this.limits.stall))),
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
