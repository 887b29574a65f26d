//! Request bodies: messages that are too large, stall or arrive too slowly are refused before they are complete.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http::HeaderValue;
use http_body::{Body as _, Frame, SizeHint};
use tokio::sync::watch;
use tokio::time::{Instant, Sleep, sleep};
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::{Code, Status};

use crate::readiness::{self, draining};
use crate::telemetry::metrics::Metrics;
use crate::transport::deadline::Deadline;
use crate::transport::receive_budget::{PeerShare, Received};

/// Length of a gRPC message's prefix: the compression flag, then the message's length as a big-endian u32.
const PREFIX: usize = 5;

/// Suffixes of the methods with a client stream.
const STREAMS: [&str; 3] = ["Stream", "TrackGrasps", REFLECTION];

/// The method of the reflection service. Its implementation does not end when the server drains.
const REFLECTION: &str = "ServerReflectionInfo";

/// Minimum rate of a message, bytes per second. It refuses clients that send single bytes and so never stall.
const MIN_RATE: f64 = 262_144.0;

/// Completes when the server drains.
type Draining = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Limits on messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// Maximum message size, bytes.
    pub message_bytes: usize,
    /// Maximum pause within a message, before the HTTP/2 preface of a connection, and while a client reads a large
    /// response.
    pub stall: Duration,
}

/// The body of a request, checked against the limits.
pub(crate) struct RequestBody {
    body: Body,
    /// Checked here because tonic ends expired requests as cancelled.
    deadline: Option<Deadline>,
    limits: Limits,
    metrics: Arc<Metrics>,
    /// Whether pauses between messages are allowed, as in a client stream.
    is_stream: bool,
    /// Ends a stream between its messages.
    drain: Option<Draining>,
    message: Message,
    /// The memory of the current message.
    received: Received,
    /// Since when the server has been waiting for the client.
    since: Option<Instant>,
    /// Time that the server has waited for the client within this message. Time in which the server does not read is
    /// excluded.
    waited: Duration,
    timeout: Pin<Box<Sleep>>,
    state: State,
}

impl Limits {
    pub fn too_large(&self, bytes: usize) -> Status {
        let longest = self.message_bytes;
        Status::invalid_argument(format!(
            "the message has {bytes} bytes, must have at most {longest} (--max-message-bytes)"
        ))
    }

    /// Maximum time in which a message of this length is received, or read by the client.
    pub fn longest(&self, length: usize) -> Duration {
        2 * self.stall + Duration::from_secs_f64(length as f64 / MIN_RATE)
    }
}

enum State {
    Open,
    /// The data before the invalid message was passed on; the next poll returns the status.
    Refusing(Status),
    Ended,
}

/// Position of the body within its messages.
#[derive(Debug, Default, PartialEq, Eq)]
struct Message {
    /// Number of the current message, from 1; 0 before the first.
    number: usize,
    prefix: [u8; PREFIX],
    /// Received bytes of the prefix.
    prefixed: usize,
    /// Missing bytes of the message.
    missing: usize,
}

impl RequestBody {
    /// The body of a request for a method at `path`.
    pub fn new(
        path: &str,
        body: Body,
        deadline: Option<Deadline>,
        limits: Limits,
        share: PeerShare,
        metrics: Arc<Metrics>,
        state: watch::Receiver<readiness::State>,
    ) -> Self {
        let is_stream = STREAMS.iter().any(|stream| path.ends_with(stream));
        Self {
            body,
            // Not for streams, whose responses are useful before the stream has ended.
            deadline: deadline.filter(|_| !is_stream),
            limits,
            metrics,
            is_stream,
            // The other streams end on their own, with a status.
            drain: path.ends_with(REFLECTION).then(|| -> Draining { Box::pin(draining(state)) }),
            message: Message::default(),
            received: share.message(),
            since: None,
            waited: Duration::ZERO,
            timeout: Box::pin(sleep(Duration::ZERO)),
            state: State::Open,
        }
    }

    /// Whether the client must send more data now.
    fn expects_data(&self) -> bool {
        self.message.has_begun() || !self.is_stream
    }

    /// Maximum time to wait for the next data.
    fn remaining(&self) -> Duration {
        self.limits.stall.min(self.limits.longest(self.message.length()).saturating_sub(self.waited))
    }

    /// Whether a request ended without a message because the client has reset it.
    fn is_reset(&self) -> bool {
        !self.is_stream && self.message.number == 0 && !self.body.is_end_stream()
    }

    fn refuse(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.metrics.ended("", status.code());
        self.end(status)
    }

    /// Ends a request that the client has cancelled within its message or before it.
    fn cancelled(&mut self) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.metrics.ended("", Code::Cancelled);
        self.end(gone())
    }

    fn end(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.state = State::Ended;
        self.received.clear();
        Poll::Ready(Some(Err(status)))
    }

    fn stalled(&self) -> Status {
        let stall = self.limits.stall;
        let missing = match self.message.missing {
            0 if self.message.number > 0 && !self.message.has_begun() => "the end of the request".to_owned(),
            0 => "its length".to_owned(),
            missing => format!("{missing} bytes"),
        };
        let reason = if self.remaining() < stall {
            format!("is slower than {MIN_RATE} bytes per second")
        } else {
            format!("stalled for {stall:?} (--stall-timeout)")
        };
        Status::deadline_exceeded(format!("the message {reason}, {missing} missing; send it again"))
    }
}

/// The status of a request that was cancelled or whose connection was lost. hyper reports the reset of a stream by a
/// client that cancels as the end of the body, and a lost connection as an error of the body. tonic takes both, and the
/// code CANCELLED, for the end of the request, and would report a malformed message.
fn gone() -> Status {
    Status::aborted("the client has cancelled the request or is gone")
}

fn late() -> Status {
    Status::deadline_exceeded("the deadline passed before the message was received")
}

/// Counts malformed messages and changes their status to `INVALID_ARGUMENT`; tonic returns `INTERNAL` for them, and
/// `RESOURCE_EXHAUSTED` if they are too large when decompressed. tonic's errors differ from ours by having no details.
pub(crate) fn unreadable(mut response: http::Response<Body>, metrics: &Metrics) -> http::Response<Body> {
    let headers = response.headers_mut();
    let is_tonics = !headers.contains_key(Status::GRPC_STATUS_DETAILS);
    let status = headers.get(Status::GRPC_STATUS).and_then(|code| code.to_str().ok()?.parse().ok());
    if is_tonics && [Code::Internal, Code::ResourceExhausted].map(|code| Some(code as i32)).contains(&status) {
        metrics.ended("", Code::InvalidArgument);
        headers.insert(Status::GRPC_STATUS, HeaderValue::from(Code::InvalidArgument as i32));
    }
    response
}

/// The same for a message of a stream.
pub(crate) fn unreadable_message(status: Status, metrics: &Metrics) -> Status {
    let is_tonics = status.details().is_empty();
    if !is_tonics || !matches!(status.code(), Code::Internal | Code::ResourceExhausted) {
        return status;
    }
    metrics.ended("", Code::InvalidArgument);
    Status::invalid_argument(status.message())
}

/// A message exceeds the limit.
#[derive(Debug, PartialEq, Eq)]
struct TooLarge {
    bytes: usize,
    /// Offset of the message in the received data; 0 also if it began in earlier data.
    begins: usize,
}

impl Message {
    /// Advances by received data. `longest` is the maximum message size, bytes.
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
            let count = self.missing.min(bytes.len() - at);
            self.missing -= count;
            at += count;
            if self.missing == 0 {
                self.prefixed = 0;
            }
        }
        Ok(())
    }

    fn has_begun(&self) -> bool {
        self.prefixed > 0
    }

    /// Length of the message, bytes; 0 until its prefix is complete.
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
            State::Ended => {
                this.state = State::Ended;
                return Poll::Ready(None);
            }
        }
        let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) else {
            if !this.expects_data() {
                let Some(drain) = &mut this.drain else { return Poll::Pending };
                ready!(drain.as_mut().poll(context));
                this.state = State::Ended;
                return Poll::Ready(None);
            }
            if this.since.is_none() {
                let now = Instant::now();
                this.since = Some(now);
                let latest = now + this.remaining();
                let until = this.deadline.map_or(latest, |Deadline(deadline)| latest.min(deadline.into()));
                this.timeout.as_mut().reset(until);
            }
            ready!(this.timeout.as_mut().poll(context));
            let is_late = this.deadline.is_some_and(Deadline::has_passed);
            return this.refuse(if is_late { late() } else { this.stalled() });
        };
        if let Some(since) = this.since.take() {
            this.waited += since.elapsed();
        }
        let data = match &frame {
            Some(Ok(frame)) => frame.data_ref(),
            // Nothing is lost between the messages of a stream.
            Some(Err(_)) if this.is_stream && !this.message.has_begun() => return this.end(gone()),
            Some(Err(_)) => return this.cancelled(),
            None if this.message.has_begun() || this.is_reset() => return this.cancelled(),
            None => None,
        };
        let Some(data) = data else { return Poll::Ready(frame) };
        let before = this.message.number;
        if let Err(TooLarge { bytes, begins }) = this.message.advance(data, this.limits.message_bytes) {
            let status = this.limits.too_large(bytes);
            if begins == 0 {
                return this.refuse(status);
            }
            this.state = State::Refusing(status);
            return Poll::Ready(Some(Ok(Frame::data(data.slice(..begins)))));
        }
        if this.message.number != before {
            this.waited = Duration::ZERO;
            this.received.clear();
        }
        if !this.message.has_begun() {
            this.received.clear();
        } else if let Err(status) = this.received.add(data.len()) {
            return this.refuse(status);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        matches!(self.state, State::Ended) || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::io;

    use http_body::Body as _;
    use tokio::sync::mpsc;
    use tokio::time::timeout;

    use super::*;
    use crate::readiness::Readiness;

    /// The data that a client sends.
    struct Sent(mpsc::Receiver<Vec<u8>>);

    impl http_body::Body for Sent {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            self.0.poll_recv(context).map(|data| data.map(|data| Ok(Frame::data(data.into()))))
        }
    }

    const STALL: Duration = Duration::from_secs(10);

    /// The body of a request for `path` to a server that starts, and the channel that fills it.
    fn body(path: &str) -> (RequestBody, mpsc::Sender<Vec<u8>>) {
        let (body, sender, _) = body_of(path, Readiness::starting());
        (body, sender)
    }

    fn body_of(path: &str, readiness: Readiness) -> (RequestBody, mpsc::Sender<Vec<u8>>, Readiness) {
        let (sender, data) = mpsc::channel(1);
        let (log, _guard) = tracing_appender::non_blocking(io::sink());
        let suppressed = prometheus::IntCounter::new("suppressed", "Lines.").unwrap();
        let metrics = Arc::new(Metrics::new(log.error_counter(), suppressed));
        let limits = Limits { message_bytes: 1 << 20, stall: STALL };
        let share = metrics.receiving(4 << 20).of_peer(None);
        let state = readiness.subscribe();
        (RequestBody::new(path, Body::new(Sent(data)), None, limits, share, metrics, state), sender, readiness)
    }

    /// Reads to the end. Returns the refusal, if there is one, and the seconds until then.
    async fn read(mut body: RequestBody) -> (Option<Status>, u64) {
        let started = Instant::now();
        let refusal = loop {
            match poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
                Some(Ok(_)) => {}
                Some(Err(status)) => break Some(status),
                None => break None,
            }
        };
        (refusal, started.elapsed().as_secs())
    }

    /// The prefix of a message.
    fn prefix(length: u32) -> Vec<u8> {
        [&[0][..], &length.to_be_bytes()].concat()
    }

    #[tokio::test(start_paused = true)]
    async fn a_message_that_stalls_is_refused_after_the_stall_timeout() {
        let (body, sender) = body("/grasp.v1.GraspService/DetectGrasps");
        sender.send([prefix(100), vec![7; 10]].concat()).await.unwrap();
        let (refusal, seconds) = read(body).await;
        let refusal = refusal.unwrap();
        assert_eq!((refusal.code(), seconds), (Code::DeadlineExceeded, STALL.as_secs()));
        assert!(refusal.message().contains("stalled for 10s (--stall-timeout), 90 bytes missing"), "{refusal}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_message_that_is_too_slow_is_refused_although_it_never_stalls() {
        let (body, sender) = body("/grasp.v1.GraspService/DetectGrasps");
        tokio::spawn(async move {
            let _ = sender.send(prefix(MIN_RATE as u32)).await;
            while sender.send(vec![7]).await.is_ok() {
                tokio::time::sleep(STALL * 9 / 10).await;
            }
        });
        let (refusal, seconds) = read(body).await;
        let refusal = refusal.unwrap();
        // Two stalls, and one second for 262,144 bytes at the minimum rate.
        assert_eq!((refusal.code(), seconds), (Code::DeadlineExceeded, 21));
        assert!(refusal.message().contains("slower than 262144 bytes per second"), "{refusal}");
    }

    #[tokio::test(start_paused = true)]
    async fn time_in_which_the_server_does_not_read_does_not_count() {
        let (mut body, sender) = body("/grasp.v1.GraspService/DetectGrasps");
        sender.send([prefix(2), vec![7]].concat()).await.unwrap();
        assert!(poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await.unwrap().is_ok());
        sender.send(vec![7]).await.unwrap();
        drop(sender);
        tokio::time::sleep(100 * STALL).await;
        let (refusal, seconds) = read(body).await;
        assert_eq!((refusal.map(|refusal| refusal.to_string()), seconds), (None, 0));
    }

    #[tokio::test(start_paused = true)]
    async fn only_streams_may_pause_between_messages() {
        let message = [prefix(1), vec![7]].concat();
        let (stream, sender) = body("/grasp.v1.GraspService/DetectGraspsStream");
        sender.send(message.clone()).await.unwrap();
        assert!(timeout(100 * STALL, read(stream)).await.is_err(), "the stream is still open");

        let (unary, sender) = body("/grasp.v1.GraspService/DetectGrasps");
        sender.send(message).await.unwrap();
        let (refusal, seconds) = read(unary).await;
        assert!(refusal.unwrap().message().contains("the end of the request missing"));
        assert_eq!(seconds, STALL.as_secs());
    }

    #[tokio::test(start_paused = true)]
    async fn a_reflection_stream_ends_between_messages_when_the_server_drains() {
        let (stream, sender, readiness) =
            body_of("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", Readiness::starting());
        sender.send([prefix(1), vec![7]].concat()).await.unwrap();
        let ended = tokio::spawn(read(stream));
        tokio::time::sleep(100 * STALL).await;
        assert!(!ended.is_finished());
        readiness.drain();
        assert!(ended.await.unwrap().0.is_none());
    }

    #[test]
    fn message_boundaries_are_found_in_pieces_of_any_size() {
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
    fn a_message_over_the_limit_is_refused_by_its_prefix() {
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
