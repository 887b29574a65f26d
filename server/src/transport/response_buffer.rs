//! A limit on the memory of large responses that clients have not read yet.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use http_body::{Frame, SizeHint};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;

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
        Some(ResponsePermit { _permit: Arc::new(permit) })
    }
}

/// Keeps a response's permit until the client has read the response.
pub(crate) fn keep_permit(mut response: http::Response<Body>) -> http::Response<Body> {
    match response.extensions_mut().remove::<ResponsePermit>() {
        Some(permit) => response.map(|body| Body::new(PermitBody { body, rest: Bytes::new(), _permit: permit })),
        None => response,
    }
}

/// A body that is passed on in pieces and holds its permit until it is dropped.
struct PermitBody {
    body: Body,
    rest: Bytes,
    _permit: ResponsePermit,
}

impl http_body::Body for PermitBody {
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
        // The body's hint is valid until its first frame is read.
        if self.rest.is_empty() { self.body.size_hint() } else { SizeHint::default() }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;

    use http_body::Body as _;

    use super::*;

    /// A body of one frame, like tonic's.
    struct Whole(Option<Bytes>);

    impl http_body::Body for Whole {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
        }
    }

    #[tokio::test]
    async fn a_response_keeps_its_permit_until_it_is_read() {
        let buffer = ResponseBuffer::new();
        let all = vec![7; 3 * PIECE + 1];
        let mut response = http::Response::new(Body::new(Whole(Some(Bytes::from(all.clone())))));
        response.extensions_mut().insert(buffer.acquire(ResponseBuffer::CAPACITY).unwrap());
        assert!(buffer.acquire(1).is_none());
        let mut body = keep_permit(response).into_body();
        let mut read = Vec::new();
        while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
            let piece = frame.unwrap().into_data().unwrap();
            assert!(piece.len() <= PIECE && buffer.acquire(1).is_none());
            read.extend(piece);
        }
        assert_eq!(read, all);
        drop(body);
        assert!(buffer.acquire(ResponseBuffer::CAPACITY).is_some());
    }
}
