use std::convert::Infallible;
use std::io;
use std::sync::Arc;

use axum::extract::{Path, State as Shared};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{Html, IntoResponse};
use axum::routing::get;
use axum::{Json, Router};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt};

use crate::readiness::State;
use crate::serving::engine::Engine;
use crate::serving::registry::ModelRegistry;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::RecentRequests;

/// State shared by the HTTP handlers.
#[derive(Clone)]
pub(crate) struct HttpState {
    pub metrics: Arc<Metrics>,
    pub models: Arc<ModelRegistry>,
    pub recent: Arc<RecentRequests>,
}

/// Serves `/metrics` for Prometheus, the probes `/healthz` and `/readyz`, and the web page with its API.
pub(crate) async fn serve(listener: TcpListener, pages: HttpState, state: watch::Receiver<State>) -> io::Result<()> {
    let (metrics, now) = (Arc::clone(&pages.metrics), state.clone());
    let mut app = Router::new()
        .route("/metrics", get(async move || ([(CONTENT_TYPE, Metrics::CONTENT_TYPE)], metrics.render(*now.borrow()))))
        .route("/healthz", get("ok\n"))
        .route("/readyz", get(async move || readiness(*state.borrow())));
    if pages.recent.is_enabled() {
        let page = Router::new()
            .route("/", get(Html(include_str!("http/page.html"))))
            .route("/api/requests", get(requests))
            .route("/api/requests/{number}", get(request))
            .route("/api/models", get(models))
            .route("/api/events", get(events));
        app = app.merge(page.with_state(pages));
    }
    axum::serve(listener, app).await
}

fn readiness(state: State) -> impl IntoResponse {
    match state {
        State::Starting => (StatusCode::SERVICE_UNAVAILABLE, "warming up\n"),
        State::Ready => (StatusCode::OK, "ready\n"),
        State::Draining => (StatusCode::SERVICE_UNAVAILABLE, "draining\n"),
    }
}

/// Summaries of the latest requests, newest first.
async fn requests(Shared(pages): Shared<HttpState>) -> Json<Value> {
    Json(pages.recent.list())
}

/// One request with its surface mesh and grasps.
async fn request(Path(number): Path<u64>, Shared(pages): Shared<HttpState>) -> Result<Json<Value>, StatusCode> {
    // Meshing takes milliseconds, too long for the threads of the async runtime.
    let found = tokio::task::spawn_blocking(move || pages.recent.get(number)).await;
    found.ok().flatten().map(Json).ok_or(StatusCode::NOT_FOUND)
}

/// The served models with their provider and precision.
async fn models(Shared(pages): Shared<HttpState>) -> Json<Value> {
    let model = |engine: &Arc<Engine>| {
        json!({
            "name": engine.source.name(),
            "version": engine.source.version(),
            "provider": engine.backend.provider.to_string(),
            "precision": engine.backend.precision.to_string(),
        })
    };
    Json(pages.models.now().iter().map(model).collect())
}

/// Server-sent events: the number of the latest request, on each new request.
async fn events(Shared(pages): Shared<HttpState>) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let numbers = WatchStream::new(pages.recent.last());
    Sse::new(numbers.map(|number| Ok(Event::default().data(number.to_string())))).keep_alive(KeepAlive::default())
}
