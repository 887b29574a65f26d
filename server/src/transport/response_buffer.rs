//! Limits on the memory of large responses that clients have not read yet, and on the time in which they must read
//! them.

use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::task::{Context, Poll, ready};

use http_body::{Frame, SizeHint};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, sleep_until};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;
use tracing::warn;

use crate::transport::request_body::Limits;

/// Bytes per permit: a semaphore counts in `u32`.
const UNIT: usize = 1 << 10;

/// Bytes per frame. A response is passed on in frames, because HTTP/2 buffers each frame completely, even if the client
/// does not read.
const PIECE: usize = 64 << 10;

/// Memory for responses that clients have not read yet.
#[derive(Clone)]
pub(crate) struct ResponseBuffer(Arc<Semaphore>);

/// The memory of one response, stored as an extension of the response.
#[derive(Clone)]
pub(crate) struct ResponsePermit {
    bytes: usize,
    _permit: Arc<OwnedSemaphorePermit>,
}

impl ResponseBuffer {
    /// Capacity, bytes.
    pub const CAPACITY: usize = 256 << 20;

    pub fn new() -> Self {
        Self(Arc::new(Semaphore::new(Self::CAPACITY / UNIT)))
    }

    /// Reserves memory for a response; None if the buffer is full.
    pub fn acquire(&self, bytes: usize) -> Option<ResponsePermit> {
        let units = u32::try_from(bytes.min(Self::CAPACITY).div_ceil(UNIT)).ok()?;
        let permit = Arc::clone(&self.0).try_acquire_many_owned(units).ok()?;
        Some(ResponsePermit { bytes, _permit: Arc::new(permit) })
    }
}

/// Keeps a response's permit until the client has read the response. A client that pauses too long or reads too slowly
/// does not receive the rest.
pub(crate) fn keep_permit(mut response: http::Response<Body>, limits: Limits) -> http::Response<Body> {
    match response.extensions_mut().remove::<ResponsePermit>() {
        Some(permit) => response.map(|body| Body::new(PermitBody::new(body, permit, limits))),
        None => response,
    }
}

/// A body that is passed on in pieces and holds its permit until it is dropped or late.
struct PermitBody(Arc<Shared>);

/// What the client has not read yet; None after the time to read it.
type Shared = Mutex<Option<Unread>>;

struct Unread {
    body: Body,
    rest: Bytes,
    /// When the last piece was passed on.
    last: Instant,
    _permit: ResponsePermit,
}

impl PermitBody {
    fn new(body: Body, permit: ResponsePermit, limits: Limits) -> Self {
        let now = Instant::now();
        // Only REST responses have a known length: JSON is longer than its maps.
        let length = http_body::Body::size_hint(&body).exact().and_then(|length| usize::try_from(length).ok());
        let end = now + limits.longest(length.unwrap_or(permit.bytes));
        let unread = Unread { body, rest: Bytes::new(), last: now, _permit: permit };
        let shared = Arc::new(Mutex::new(Some(unread)));
        // A task, because hyper does not poll the body of a client that does not read.
        tokio::spawn(drop_late(Arc::downgrade(&shared), end, limits));
        Self(shared)
    }
}

fn lock(shared: &Shared) -> MutexGuard<'_, Option<Unread>> {
    // A panic while it is locked leaves at most a body that ends early.
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Drops what the client has not read at `end`, or after a pause of the stall timeout.
async fn drop_late(shared: Weak<Shared>, end: Instant, limits: Limits) {
    let mut next = end.min(Instant::now() + limits.stall);
    loop {
        sleep_until(next).await;
        let Some(shared) = shared.upgrade() else { return };
        let mut unread = lock(&shared);
        let Some(last) = unread.as_ref().map(|unread| unread.last) else { return };
        next = end.min(last + limits.stall);
        if next <= Instant::now() {
            *unread = None;
            warn!(stall = ?limits.stall, "response dropped: the client does not read it (--stall-timeout)");
            return;
        }
    }
}

impl http_body::Body for PermitBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let mut unread = lock(&self.0);
        let Some(unread) = unread.as_mut() else {
            return Poll::Ready(Some(Err(Status::deadline_exceeded("the client read the response too slowly"))));
        };
        if unread.rest.is_empty() {
            match ready!(Pin::new(&mut unread.body).poll_frame(context)).map(|frame| frame.map(Frame::into_data)) {
                Some(Ok(Ok(data))) => unread.rest = data,
                Some(Ok(Err(other))) => return Poll::Ready(Some(Ok(other))),
                Some(Err(error)) => return Poll::Ready(Some(Err(error))),
                None => return Poll::Ready(None),
            }
        }
        unread.last = Instant::now();
        let piece = unread.rest.split_to(PIECE.min(unread.rest.len()));
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        lock(&self.0).as_ref().is_some_and(|unread| unread.rest.is_empty() && unread.body.is_end_stream())
    }

    fn size_hint(&self) -> SizeHint {
        // The body's hint is valid until its first frame is read.
        match &*lock(&self.0) {
            Some(unread) if unread.rest.is_empty() => unread.body.size_hint(),
            _ => SizeHint::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::time::Duration;

    use http_body::Body as _;
    use tokio::time::sleep;

    use super::*;

    const LIMITS: Limits = Limits { message_bytes: 1 << 20, stall: Duration::from_secs(10) };

    /// A body of one frame, like tonic's.
    struct Whole(Option<Bytes>);

    impl http_body::Body for Whole {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
        }
    }

    /// A response of these bytes that fills the buffer.
    fn response(buffer: &ResponseBuffer, bytes: Vec<u8>, length: usize) -> Body {
        let mut response = http::Response::new(Body::new(Whole(Some(Bytes::from(bytes)))));
        let mut permit = buffer.acquire(ResponseBuffer::CAPACITY).unwrap();
        permit.bytes = length;
        response.extensions_mut().insert(permit);
        assert!(buffer.acquire(1).is_none());
        keep_permit(response, LIMITS).into_body()
    }

    async fn frame(body: &mut Body) -> Option<Result<Frame<Bytes>, Status>> {
        poll_fn(|context| Pin::new(&mut *body).poll_frame(context)).await
    }

    #[tokio::test]
    async fn a_response_keeps_its_permit_until_it_is_read() {
        let buffer = ResponseBuffer::new();
        let all = vec![7; 3 * PIECE + 1];
        let mut body = response(&buffer, all.clone(), all.len());
        let mut read = Vec::new();
        while let Some(frame) = frame(&mut body).await {
            let piece = frame.unwrap().into_data().unwrap();
            assert!(piece.len() <= PIECE && buffer.acquire(1).is_none());
            read.extend(piece);
        }
        assert_eq!(read, all);
        drop(body);
        assert!(buffer.acquire(ResponseBuffer::CAPACITY).is_some());
    }

    #[tokio::test(start_paused = true)]
    async fn a_response_is_dropped_if_the_client_pauses() {
        let buffer = ResponseBuffer::new();
        let mut body = response(&buffer, vec![7; 3 * PIECE], 3 * PIECE);
        for _ in 0..2 {
            sleep(LIMITS.stall * 9 / 10).await;
            assert!(frame(&mut body).await.unwrap().is_ok());
            assert!(buffer.acquire(1).is_none());
        }
        sleep(LIMITS.stall * 11 / 10).await;
        assert!(buffer.acquire(ResponseBuffer::CAPACITY).is_some());
        let error = frame(&mut body).await.unwrap().unwrap_err();
        assert_eq!(error.code(), tonic::Code::DeadlineExceeded, "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_response_is_dropped_if_the_client_reads_too_slowly() {
        let buffer = ResponseBuffer::new();
        let mut body = response(&buffer, vec![7; 9 * PIECE], PIECE);
        // Two stalls, and one second for 65,536 bytes at the minimum rate.
        for _ in 0..3 {
            assert!(frame(&mut body).await.unwrap().is_ok());
            sleep(LIMITS.stall * 7 / 10).await;
        }
        sleep(Duration::from_secs(1)).await;
        assert!(frame(&mut body).await.unwrap().is_err());
        assert!(buffer.acquire(ResponseBuffer::CAPACITY).is_some());
    }
}
