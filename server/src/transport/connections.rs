use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http::Extensions;
use prometheus::{IntCounter, IntGauge};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Sleep, sleep};
use tokio_rustls::server::TlsStream;
use tokio_rustls::{Accept, TlsAcceptor};
use tokio_stream::{Stream, StreamExt};
use tonic::transport::server::Connected;
use tracing::warn;

use crate::transport::address::{Listener, Socket, peer};
use crate::transport::receive_budget::{PeerShare, ReceiveBudget};

/// The limit on the open connections of a listener, with its metrics.
#[derive(Clone)]
pub(crate) struct ConnectionLimit {
    pub limit: usize,
    permits: Arc<Semaphore>,
    open: IntGauge,
    pub refused: IntCounter,
}

impl ConnectionLimit {
    /// A limit whose open and refused connections are counted.
    pub fn new(limit: usize, open: IntGauge, refused: IntCounter) -> Self {
        Self { limit, permits: Arc::new(Semaphore::new(limit.min(Semaphore::MAX_PERMITS))), open, refused }
    }

    /// A place for a connection; None if the limit is reached.
    pub fn acquire(&self) -> Option<ConnectionPermit> {
        let permit = Arc::clone(&self.permits).try_acquire_owned().ok()?;
        self.open.inc();
        Some(ConnectionPermit { _permit: permit, open: self.open.clone() })
    }
}

/// The place of an open connection, which is counted.
pub(crate) struct ConnectionPermit {
    _permit: OwnedSemaphorePermit,
    open: IntGauge,
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        self.open.dec();
    }
}

/// Accepts the connections of a listener, with TLS if it is given. Connections beyond the limit are closed immediately,
/// which clients report as UNAVAILABLE. `timeout` is the maximum time until a client has sent the HTTP/2 preface, with
/// the TLS handshake.
pub(crate) fn accept(
    listener: Listener,
    tls: Option<TlsAcceptor>,
    limit: ConnectionLimit,
    timeout: Duration,
    budget: Arc<ReceiveBudget>,
) -> impl Stream<Item = io::Result<Connection>> {
    let accepted = listener.sockets().then(async |accepted| {
        if let Err(error) = &accepted {
            // The most likely cause is the limit of open files. An immediate retry would fail again.
            warn!(%error, "cannot accept a connection");
            sleep(ERROR_PAUSE).await;
        }
        accepted
    });
    accepted.filter_map(move |accepted| match (accepted, limit.acquire()) {
        (Ok(stream), Some(permit)) => Some(Ok(Connection::new(stream, tls.as_ref(), timeout, permit, &budget))),
        (Ok(_), None) => {
            limit.refused.inc();
            warn!(open = limit.limit, "connection refused: the limit is reached (--max-connections)");
            None
        }
        (Err(error), _) => Some(Err(error)),
    })
}

/// Pause after an error of the listener.
const ERROR_PAUSE: Duration = Duration::from_millis(100);

/// Length of the HTTP/2 connection preface (RFC 9113, section 3.4), bytes. After it, keep-alive pings close dead
/// connections.
const PREFACE: usize = 24;

/// A connection to the gRPC listener.
pub(crate) struct Connection {
    stream: Stage,
    /// Missing bytes of the preface and their timeout; None after the preface.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    _permit: ConnectionPermit,
    peer: Peer,
}

/// The stream of a connection.
enum Stage {
    Plain(Socket),
    Handshake(Box<Accept<Socket>>),
    Tls(Box<TlsStream<Socket>>),
    /// The handshake has failed. It must not be polled again.
    Failed,
}

/// The bytes of a connection, decrypted.
trait Bytes: AsyncRead + AsyncWrite + Unpin {}

impl<T: AsyncRead + AsyncWrite + Unpin> Bytes for T {}

/// The client of a connection.
#[derive(Clone)]
pub(crate) struct Peer {
    /// None for UNIX sockets, or if the connection has ended already.
    pub address: Option<SocketAddr>,
    pub share: PeerShare,
}

impl Peer {
    /// The client that sent a request.
    pub fn from_extensions(extensions: &Extensions) -> Option<&Self> {
        extensions.get()
    }
}

impl Connection {
    fn new(
        stream: Socket,
        tls: Option<&TlsAcceptor>,
        timeout: Duration,
        permit: ConnectionPermit,
        budget: &Arc<ReceiveBudget>,
    ) -> Self {
        let address = peer(&stream);
        let peer = Peer { address, share: budget.of_peer(address.map(|address| address.ip().to_canonical())) };
        let stream = match tls {
            None => Stage::Plain(stream),
            Some(tls) => Stage::Handshake(Box::new(tls.accept(stream))),
        };
        Self { stream, preface: Some((PREFACE, Box::pin(sleep(timeout)))), _permit: permit, peer }
    }

    /// The bytes, once the handshake is done.
    fn poll_bytes(&mut self, context: &mut Context<'_>) -> Poll<io::Result<Pin<&mut dyn Bytes>>> {
        if let Stage::Handshake(handshake) = &mut self.stream {
            let done = Pin::new(handshake.as_mut()).poll(context);
            if done.is_pending() {
                self.check_time(context)?;
            }
            match ready!(done) {
                Ok(stream) => self.stream = Stage::Tls(Box::new(stream)),
                Err(error) => {
                    self.stream = Stage::Failed;
                    return Poll::Ready(Err(error));
                }
            }
        }
        match &mut self.stream {
            Stage::Plain(stream) => Poll::Ready(Ok(Pin::new(stream))),
            Stage::Tls(stream) => Poll::Ready(Ok(Pin::new(stream.as_mut()))),
            Stage::Handshake(_) => Poll::Pending,
            Stage::Failed => Poll::Ready(Err(io::ErrorKind::NotConnected.into())),
        }
    }

    /// An error if the preface is late.
    fn check_time(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        let is_late = self.preface.as_mut().is_some_and(|(_, timeout)| timeout.as_mut().poll(context).is_ready());
        if is_late { Err(io::ErrorKind::TimedOut.into()) } else { Ok(()) }
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = ready!(self.poll_bytes(context))?.poll_read(context, buffer)?;
        let received = buffer.filled().len() - before;
        match &mut self.preface {
            Some((missing, _)) if *missing <= received => self.preface = None,
            Some((missing, _)) => {
                *missing -= received;
                self.check_time(context)?;
            }
            None => {}
        }
        read.map(Ok)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        ready!(self.poll_bytes(context))?.poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_bytes(context))?.poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_bytes(context))?.poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        ready!(self.poll_bytes(context))?.poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        match &self.stream {
            Stage::Plain(stream) => stream.is_write_vectored(),
            // Like `TlsStream`, which encrypts the slices one after the other.
            Stage::Handshake(_) | Stage::Tls(_) | Stage::Failed => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use tokio::io::AsyncReadExt;
    use tokio::net::TcpStream;
    use tokio::time::Instant;
    use tokio_util::either::Either;

    use super::*;
    use crate::transport::address::Address;

    async fn listener() -> (Listener, SocketAddr) {
        let listener = Address::Tcp(([127, 0, 0, 1], 0).into()).bind().await.unwrap();
        let Address::Tcp(address) = listener.address else { panic!("{}", listener.address) };
        (listener, address)
    }

    fn budget() -> Arc<ReceiveBudget> {
        ReceiveBudget::new(1, IntGauge::new("receiving", "Bytes.").unwrap())
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_without_a_preface_ends_after_the_timeout() {
        let (listener, address) = listener().await;
        let open = IntGauge::new("open", "Open connections.").unwrap();
        let refused = IntCounter::new("refused", "Refused connections.").unwrap();
        let timeout = Duration::from_secs(10);
        let limit = ConnectionLimit::new(1, open, refused);
        let mut incoming = pin!(accept(listener, None, limit, timeout, budget()));

        let _silent = TcpStream::connect(address).await.unwrap();
        let mut connection = incoming.next().await.unwrap().unwrap();
        let accepted = Instant::now();
        let error = connection.read(&mut [0]).await.unwrap_err();
        assert_eq!((error.kind(), accepted.elapsed().as_secs()), (io::ErrorKind::TimedOut, 10));
    }

    #[tokio::test]
    async fn connections_are_counted_and_limited_and_have_tcp_nodelay() {
        let (listener, address) = listener().await;
        let open = IntGauge::new("open", "Open connections.").unwrap();
        let refused = IntCounter::new("refused", "Refused connections.").unwrap();
        let limit = ConnectionLimit::new(1, open.clone(), refused.clone());
        let mut incoming = pin!(accept(listener, None, limit, Duration::from_secs(10), budget()));

        let _first = TcpStream::connect(address).await.unwrap();
        let connection = incoming.next().await.unwrap().unwrap();
        let Stage::Plain(Either::Left(stream)) = &connection.stream else { panic!("it is a TCP connection") };
        assert!(stream.nodelay().unwrap());
        assert_eq!(open.get(), 1);

        let mut second = TcpStream::connect(address).await.unwrap();
        let closed = async { second.read(&mut [0]).await.unwrap_or(0) };
        let read = tokio::select! { read = closed => read, _ = incoming.next() => panic!("it was accepted") };
        assert_eq!((read, refused.get()), (0, 1));

        drop(connection);
        assert_eq!(open.get(), 0);
        let _third = TcpStream::connect(address).await.unwrap();
        assert!(incoming.next().await.unwrap().is_ok());
    }
}
