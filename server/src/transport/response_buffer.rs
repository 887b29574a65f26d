//! Large replies on their way out, which are in memory until their clients have read them.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use http_body::{Frame, SizeHint};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;

/// Bytes in one unit of what is counted: a semaphore's permits are `u32`.
const UNIT: usize = 1 << 10;

/// HTTP/2 buffers whatever it is given at once, however little of it the client takes.
const PIECE: usize = 64 << 10;

/// How much may wait for clients to read it.
#[derive(Clone)]
pub(crate) struct ResponseBuffer(Arc<Semaphore>);

/// The place of one reply in the outbox, an extension of its response.
#[derive(Clone)]
pub(crate) struct ResponsePermit {
    _permit: Arc<OwnedSemaphorePermit>,
}

impl ResponseBuffer {
    /// Bytes.
    pub const CAPACITY: usize = 256 << 20;

    pub fn new() -> Self {
        Self(Arc::new(Semaphore::new(Self::CAPACITY / UNIT)))
    }

    /// A place for a reply of so many bytes, if there is one.
    pub fn hold(&self, bytes: usize) -> Option<ResponsePermit> {
        let units = u32::try_from(bytes.min(Self::CAPACITY).div_ceil(UNIT)).ok()?;
        let permit = Arc::clone(&self.0).try_acquire_many_owned(units).ok()?;
        Some(ResponsePermit { _permit: Arc::new(permit) })
    }
}

/// Has a reply keep its place until it has been read.
pub(crate) fn outgoing(mut response: http::Response<Body>) -> http::Response<Body> {
    match response.extensions_mut().remove::<ResponsePermit>() {
        Some(held) => response.map(|body| Body::new(Outgoing { body, rest: Bytes::new(), _held: held })),
        None => response,
    }
}

/// A body that is given away piece by piece.
struct Outgoing {
    body: Body,
    rest: Bytes,
    _held: ResponsePermit,
}

impl http_body::Body for Outgoing {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        if this.rest.is_empty() {
            match ready!(Pin::new(&mut this.body).poll_frame(context)).map(|frame| frame.map(Frame::into_data)) {
                Some(Ok(Ok(data))) => this.rest = data,
                Some(Ok(Err(other))) => return Poll::Ready(Some(Ok(other))),
                Some(Err(error)) => return Poll::Ready(Some(Err(error))),
                None => return Poll::Ready(None),
            }
        }
        let piece = this.rest.split_to(PIECE.min(this.rest.len()));
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        // As long as nothing was taken from it.
        if self.rest.is_empty() { self.body.size_hint() } else { SizeHint::default() }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;

    use http_body::Body as _;

    use super::*;

    /// All at once, as tonic has it.
    struct Whole(Option<Bytes>);

    impl http_body::Body for Whole {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
        }
    }

    #[tokio::test]
    async fn a_reply_keeps_its_place_until_it_was_read() {
        let outbox = ResponseBuffer::new();
        let all = vec![7; 3 * PIECE + 1];
        let mut response = http::Response::new(Body::new(Whole(Some(Bytes::from(all.clone())))));
        response.extensions_mut().insert(outbox.hold(ResponseBuffer::CAPACITY).unwrap());
        assert!(outbox.hold(1).is_none());
        let mut body = outgoing(response).into_body();
        let mut read = Vec::new();
        while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
            let piece = frame.unwrap().into_data().unwrap();
            assert!(piece.len() <= PIECE && outbox.hold(1).is_none());
            read.extend(piece);
        }
        assert_eq!(read, all);
        drop(body);
        assert!(outbox.hold(ResponseBuffer::CAPACITY).is_some());
    }
}
