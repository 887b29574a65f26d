use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use prometheus::{IntCounter, IntGauge};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Sleep, sleep};
use tokio_stream::{Stream, StreamExt};
use tonic::transport::server::{Connected, TcpConnectInfo, TcpIncoming};
use tracing::warn;

/// How many connections may be open, and what is counted of them.
pub(crate) struct ConnectionLimit {
    pub most: usize,
    /// How long one may be open without a word.
    pub patience: Duration,
    pub open: IntGauge,
    pub refused: IntCounter,
}

/// The connections of a listener, of which no more than `most` are open at a time: a further one is closed at once, which
/// clients see as the server being unavailable.
pub(crate) fn accept(listener: TcpListener, doors: ConnectionLimit) -> impl Stream<Item = io::Result<Connection>> {
    let ConnectionLimit { most, patience, open, refused } = doors;
    // `Server::tcp_nodelay` does nothing for a listener that was bound before; without TCP_NODELAY a reply of several
    // packets waits 40 ms for the client to acknowledge the first.
    let accepted = TcpIncoming::from(listener).with_nodelay(Some(true)).then(async |accepted| {
        if let Err(error) = &accepted {
            // Most likely too many files are open; asked again at once, it would say the same.
            warn!(%error, "a connection could not be taken");
            sleep(PAUSE).await;
        }
        accepted
    });
    accepted.filter_map(move |accepted| match accepted {
        Ok(stream) if open.get() < i64::try_from(most).unwrap_or(i64::MAX) => {
            Some(Ok(Connection::new(stream, patience, &open)))
        }
        Ok(_) => {
            refused.inc();
            warn!(open = open.get(), "too many connections, a further one was closed (--max-connections)");
            None
        }
        Err(error) => Some(Err(error)),
    })
}

/// After a connection could not be taken.
const PAUSE: Duration = Duration::from_millis(100);

/// What every client says first, before HTTP/2 (RFC 9113, section 3.4) and, longer than this, before TLS. From then on
/// keep-alive pings and TLS's own timeout watch over the connection.
const PREFACE: usize = 24;

/// A connection, counted as long as it is open.
pub(crate) struct Connection {
    stream: TcpStream,
    /// Bytes of the preface that are missing, and how long they may take.
    greeting: Option<(usize, Pin<Box<Sleep>>)>,
    open: IntGauge,
}

impl Connection {
    fn new(stream: TcpStream, patience: Duration, open: &IntGauge) -> Self {
        open.inc();
        Self { stream, greeting: Some((PREFACE, Box::pin(sleep(patience)))), open: open.clone() }
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.open.dec();
    }
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;

    fn connect_info(&self) -> TcpConnectInfo {
        self.stream.connect_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer)?;
        if let Some((missing, patience)) = &mut self.greeting {
            let come = buffer.filled().len() - before;
            *missing = missing.saturating_sub(come);
            if *missing == 0 {
                self.greeting = None;
            } else if patience.as_mut().poll(context).is_ready() {
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
        }
        read.map(Ok)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use tokio::io::AsyncReadExt;

    use super::*;

    #[tokio::test]
    async fn connections_are_counted_limited_and_do_not_wait_to_fill_packets() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let open = IntGauge::new("open", "How many are open.").unwrap();
        let refused = IntCounter::new("refused", "How many were closed at once.").unwrap();
        let doors = ConnectionLimit {
            most: 1,
            patience: Duration::from_secs(10),
            open: open.clone(),
            refused: refused.clone(),
        };
        let mut incoming = pin!(accept(listener, doors));

        let _first = TcpStream::connect(address).await.unwrap();
        let connection = incoming.next().await.unwrap().unwrap();
        assert!(connection.stream.nodelay().unwrap());
        assert_eq!(open.get(), 1);

        let mut second = TcpStream::connect(address).await.unwrap();
        let closed = async { second.read(&mut [0]).await.unwrap_or(0) };
        let read = tokio::select! { read = closed => read, _ = incoming.next() => panic!("it was taken") };
        assert_eq!((read, refused.get()), (0, 1));

        drop(connection);
        assert_eq!(open.get(), 0);
        let _third = TcpStream::connect(address).await.unwrap();
        assert!(incoming.next().await.unwrap().is_ok());
    }
}
