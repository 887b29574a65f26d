//! HTTP connections, with limits that keep silent and slow clients from blocking probes and gRPC.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::AbortHandle;
use tokio_io_timeout::TimeoutStream;
use tower::Service;
use tracing::{debug, warn};

/// Maximum number of open connections.
pub(crate) const CONNECTIONS: usize = 128;

/// Maximum time for the header of a request, and between two requests of a connection.
const READ_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum time without progress while a response is sent.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Pause after an error of the listener. The most likely cause is the limit of open files.
const ERROR_PAUSE: Duration = Duration::from_millis(100);

/// An open connection.
struct Open {
    task: AbortHandle,
    /// Whether the client has sent a request.
    has_requested: Arc<AtomicBool>,
}

/// Serves connections for ever. A connection beyond the limit replaces the oldest that has not sent a request yet;
/// without such a connection it is closed.
pub(super) async fn serve(listener: TcpListener, app: Router) -> Infallible {
    let mut open: Vec<Open> = Vec::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                warn!(%error, "cannot accept an HTTP connection");
                tokio::time::sleep(ERROR_PAUSE).await;
                continue;
            }
        };
        open.retain(|connection| !connection.task.is_finished());
        if open.len() >= CONNECTIONS {
            let is_silent = |connection: &Open| !connection.has_requested.load(Ordering::Relaxed);
            let Some(silent) = open.iter().position(is_silent) else {
                warn!(open = open.len(), "HTTP connection refused: the limit is reached");
                continue;
            };
            open.remove(silent).task.abort();
        }
        let has_requested = Arc::new(AtomicBool::new(false));
        let task = tokio::spawn(serve_connection(stream, app.clone(), Arc::clone(&has_requested)));
        open.push(Open { task: task.abort_handle(), has_requested });
    }
}

async fn serve_connection(stream: TcpStream, app: Router, has_requested: Arc<AtomicBool>) {
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let service = service_fn(move |request| {
        has_requested.store(true, Ordering::Relaxed);
        app.clone().call(request)
    });
    let mut server = http1::Builder::new();
    let connection = server
        .timer(TokioTimer::new())
        .header_read_timeout(READ_TIMEOUT)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    if let Err(error) = connection.await {
        debug!(%error, "HTTP connection ended");
    }
}
