use std::io;
use std::sync::Arc;

use axum::Router;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::health::State;
use crate::metrics::Metrics;

/// What a machine asks over HTTP: Prometheus its metrics, an orchestrator whether to restart or to send requests.
pub(crate) async fn serve(
    listener: TcpListener,
    metrics: Arc<Metrics>,
    state: watch::Receiver<State>,
) -> io::Result<()> {
    let now = state.clone();
    let app = Router::new()
        .route("/metrics", get(async move || ([(CONTENT_TYPE, Metrics::CONTENT_TYPE)], metrics.render(*now.borrow()))))
        .route("/healthz", get("ok\n"))
        .route("/readyz", get(async move || readiness(*state.borrow())));
    axum::serve(listener, app).await
}

fn readiness(state: State) -> impl IntoResponse {
    match state {
        State::Starting => (StatusCode::SERVICE_UNAVAILABLE, "warming up\n"),
        State::Ready => (StatusCode::OK, "ready\n"),
        State::Draining => (StatusCode::SERVICE_UNAVAILABLE, "draining\n"),
    }
}
