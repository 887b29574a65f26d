//! HTTP/1.1 connections, with limits that keep silent and slow clients from blocking others.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_io_timeout::TimeoutStream;
use tokio_rustls::TlsAcceptor;
use tokio_util::either::Either;
use tokio_util::task::TaskTracker;
use tower::Service;
use tracing::{debug, warn};

use crate::readiness::{State, draining};
use crate::transport::connections::{ConnectionLimit, ConnectionPermit, Peer};
use crate::transport::receive_budget::ReceiveBudget;

/// Maximum time for the header of a request, and between two requests of a connection.
const READ_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum time without progress while a response is sent, and for the TLS handshake.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Pause after an error of the listener. The most likely cause is the limit of open files.
const ERROR_PAUSE: Duration = Duration::from_millis(100);

/// Settings of a listener.
#[derive(Clone)]
pub(crate) struct HttpConfig {
    pub limit: ConnectionLimit,
    /// None for plaintext.
    pub tls: Option<TlsAcceptor>,
    /// The messages that are being received.
    pub budget: Arc<ReceiveBudget>,
}

/// An open connection.
struct Open {
    task: JoinHandle<()>,
    /// Whether the client has sent a request.
    has_requested: Arc<AtomicBool>,
}

/// Serves connections until the state is draining and the requests that were accepted before are answered. A connection
/// beyond the limit replaces the oldest that has not sent a request yet; without such a connection it is closed.
pub(crate) async fn serve(listener: TcpListener, config: HttpConfig, app: Router, state: watch::Receiver<State>) {
    let tasks = TaskTracker::new();
    let mut open: Vec<Open> = Vec::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = draining(state.clone()) => break,
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                warn!(%error, "cannot accept an HTTP connection");
                tokio::time::sleep(ERROR_PAUSE).await;
                continue;
            }
        };
        open.retain(|connection| !connection.task.is_finished());
        let Some(permit) = place(&mut open, &config.limit).await else {
            config.limit.refused.inc();
            warn!(open = open.len(), "HTTP connection refused: the limit is reached");
            continue;
        };
        let has_requested = Arc::new(AtomicBool::new(false));
        let (app, requested) = (app.clone(), Arc::clone(&has_requested));
        let connection = serve_connection(stream, config.clone(), app, requested, permit, state.clone());
        open.push(Open { task: tasks.spawn(connection), has_requested });
    }
    drop(listener);
    tasks.close();
    tasks.wait().await;
}

/// A place for a connection. At the limit, the oldest connection without a request is closed to make room.
async fn place(open: &mut Vec<Open>, limit: &ConnectionLimit) -> Option<ConnectionPermit> {
    if let Some(permit) = limit.acquire() {
        return Some(permit);
    }
    let silent = open.iter().position(|connection| !connection.has_requested.load(Ordering::Relaxed))?;
    let silent = open.remove(silent);
    silent.task.abort();
    let _ = silent.task.await;
    limit.acquire()
}

async fn serve_connection(
    stream: TcpStream,
    HttpConfig { tls, budget, .. }: HttpConfig,
    app: Router,
    has_requested: Arc<AtomicBool>,
    _permit: ConnectionPermit,
    state: watch::Receiver<State>,
) {
    let address = stream.peer_addr().ok();
    let peer = Peer { address, share: budget.of_peer(address.map(|address| address.ip().to_canonical())) };
    // Without TCP_NODELAY, a response of several packets waits for the client's acknowledgement of the first.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let stream = Box::pin(stream);
    let stream = match tls {
        None => Either::Left(stream),
        Some(tls) => match tokio::time::timeout(WRITE_TIMEOUT, tls.accept(stream)).await {
            Ok(Ok(stream)) => Either::Right(stream),
            Ok(Err(error)) => return debug!(%error, "TLS handshake failed"),
            Err(_) => return debug!("TLS handshake timed out"),
        },
    };
    let service = service_fn(move |mut request: Request<Incoming>| {
        has_requested.store(true, Ordering::Relaxed);
        request.extensions_mut().insert(peer.clone());
        app.clone().call(request)
    });
    let mut server = http1::Builder::new();
    let server = server.timer(TokioTimer::new()).header_read_timeout(READ_TIMEOUT);
    let mut connection = std::pin::pin!(server.serve_connection(TokioIo::new(stream), service));
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = draining(state) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        debug!(%error, "HTTP connection ended");
    }
}
