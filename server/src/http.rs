use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;

use axum::extract::{Path, Request, State as Shared};
use axum::http::StatusCode;
use axum::http::header::{CONTENT_TYPE, HOST};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use grasp_engine::{Model, ModelRegistry};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, watch};
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt};

use crate::readiness::State;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::RecentRequests;
use crate::transport::http_connections::{self, HttpConfig};

/// Maximum number of open connections.
pub(crate) const CONNECTIONS: usize = 128;

/// Maximum number of open event streams, so that connections remain for probes and Prometheus.
const PAGES: usize = 32;

/// State shared by the HTTP handlers.
#[derive(Clone)]
pub(crate) struct HttpState {
    pub metrics: Arc<Metrics>,
    pub models: Arc<ModelRegistry>,
    pub recent: Arc<RecentRequests>,
    /// Permits of the open event streams.
    pub pages: Arc<Semaphore>,
}

impl HttpState {
    pub fn new(metrics: Arc<Metrics>, models: Arc<ModelRegistry>, recent: Arc<RecentRequests>) -> Self {
        Self { metrics, models, recent, pages: Arc::new(Semaphore::new(PAGES)) }
    }
}

/// Serves `/metrics` for Prometheus, the probes `/healthz` and `/readyz`, and the web page with its API. `hosts` are
/// further names of the server.
pub(crate) async fn serve(
    listener: TcpListener,
    hosts: Vec<String>,
    pages: HttpState,
    config: HttpConfig,
    state: watch::Receiver<State>,
) {
    let (metrics, now, health) = (Arc::clone(&pages.metrics), state.clone(), state.clone());
    let mut app = Router::new()
        .route("/metrics", get(async move || ([(CONTENT_TYPE, Metrics::CONTENT_TYPE)], metrics.render(*now.borrow()))))
        .route("/healthz", get(async move || liveness(*health.borrow())))
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
    let app = app.layer(from_fn_with_state(Arc::new(hosts), check_host));
    // Probes and Prometheus are answered during the drain, too.
    let (_serving, for_ever) = watch::channel(State::Ready);
    http_connections::serve(listener, config, app, for_ever).await;
}

/// Refuses requests to names that are not this server's. Otherwise a page of another site could read the responses in a
/// browser that can reach this server, if the site's name resolves to this server's address (DNS rebinding).
async fn check_host(Shared(hosts): Shared<Arc<Vec<String>>>, request: Request, next: Next) -> Response {
    let host = request.headers().get(HOST).map(|host| String::from_utf8_lossy(host.as_bytes()).into_owned());
    match host {
        Some(host) if !is_own(&host, &hosts) => {
            let reason = format!("`{host}` is not a name of this server; use its IP address, or add --http-host\n");
            (StatusCode::MISDIRECTED_REQUEST, reason).into_response()
        }
        _ => next.run(request).await,
    }
}

/// Whether a `Host` header is an IP address, one of `hosts`, or a name without a dot, which no other site can have.
fn is_own(host: &str, hosts: &[String]) -> bool {
    let is_port = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    let name = host.rsplit_once(':').filter(|(_, port)| is_port(port)).map_or(host, |(name, _)| name);
    let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    address.parse::<IpAddr>().is_ok()
        || !name.trim_end_matches('.').contains('.')
        || hosts.iter().any(|own| own.eq_ignore_ascii_case(name))
}

const UNHEALTHY: (StatusCode, &str) = (
    StatusCode::SERVICE_UNAVAILABLE,
    "all sessions of a model hang in an inference, or fail each one, see the log; restart the server\n",
);

fn liveness(state: State) -> impl IntoResponse {
    if state == State::Unhealthy { UNHEALTHY } else { (StatusCode::OK, "ok\n") }
}

fn readiness(state: State) -> impl IntoResponse {
    match state {
        State::Starting => (StatusCode::SERVICE_UNAVAILABLE, "warming up\n"),
        State::Ready => (StatusCode::OK, "ready\n"),
        State::Unhealthy => UNHEALTHY,
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
    let model = |model: &Arc<Model>| {
        json!({
            "name": model.spec.name(),
            "version": model.spec.version(),
            "provider": model.backend.provider.to_string(),
            "precision": model.backend.precision.to_string(),
        })
    };
    Json(pages.models.now().iter().map(model).collect())
}

/// Server-sent events: the number of the latest request, on each new request.
async fn events(
    Shared(pages): Shared<HttpState>,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, (StatusCode, &'static str)> {
    let permit = Arc::clone(&pages.pages).try_acquire_owned();
    let permit = permit.map_err(|_| (StatusCode::SERVICE_UNAVAILABLE, "too many open pages; close some\n"))?;
    let numbers = WatchStream::new(pages.recent.last()).map(move |number| {
        // Released when the page is closed.
        let _permit = &permit;
        Ok(Event::default().data(number.to_string()))
    });
    Ok(Sse::new(numbers).keep_alive(KeepAlive::default()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_local_names_and_given_names_are_own() {
        let hosts = ["graspd.example.com".to_owned()];
        for own in ["127.0.0.1:9090", "10.1.2.3", "[::1]:9090", "localhost:9090", "graspd", "GraspD.example.com:80"] {
            assert!(is_own(own, &hosts), "{own}");
        }
        for other in ["example.com", "attacker.example.com:9090", "127.0.0.1.example.com:9090", "a.b.", "[::1].a.b"] {
            assert!(!is_own(other, &hosts), "{other}");
        }
    }
}
