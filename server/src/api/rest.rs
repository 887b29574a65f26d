//! HTTP/1.1 for clients without gRPC: grasps in depth images as JSON, and the Open Inference Protocol: the requests of
//! `api::inference` with tensors as JSON or binary (Triton's extension).

mod body;
mod detect;
mod tensors;

use std::sync::Arc;
use std::time::{Duration, Instant};

use ::grasp::on_a_line;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Request, State};
use axum::http::header::{CONTENT_TYPE, ORIGIN, RETRY_AFTER};
use axum::http::request::Parts;
use axum::http::{Extensions, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use grasp_proto::oip;
use grasp_proto::oip::grpc_inference_service_server::GrpcInferenceService;
use grasp_proto::pb::grasp_service_server::GraspService;
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, watch};
use tokio::time::timeout_at;
use tonic::metadata::MetadataMap;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::api::grasp::GraspApi;
use crate::api::inference::InferenceApi;
use crate::readiness;
use crate::telemetry::metrics::Metrics;
use crate::transport::deadline::{self, Deadline};
use crate::transport::http_connections::{self, HttpConfig};
use crate::transport::request_body::Limits;
use crate::transport::response_buffer::keep_permit;
use crate::transport::tokens::Tokens;
use body::{discard, read};
use tensors::{HEADER_LENGTH, InferRequest, Parameters, response};

/// Time after which a request for inference or grasps expires, unless its header `grpc-timeout` has another.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Retry hint if too many requests wait for their conversion, which takes milliseconds.
const CONVERSIONS_WAIT: Duration = Duration::from_secs(1);

/// State shared by the handlers.
#[derive(Clone)]
pub(crate) struct Rest {
    pub grasps: GraspApi,
    pub inference: InferenceApi,
    /// None if requests need no token.
    pub tokens: Option<Arc<Tokens>>,
    pub limits: Limits,
    pub metrics: Arc<Metrics>,
    /// One permit per CPU. A request holds one while its tensors are converted, because parsed JSON needs much more
    /// memory than its text.
    pub conversions: Arc<Semaphore>,
    /// One permit for each request that may wait for a conversion.
    pub waiting: Arc<Semaphore>,
}

/// Serves until the state is draining and all accepted requests are finished.
pub(crate) async fn serve(
    listener: TcpListener,
    rest: Rest,
    config: HttpConfig,
    state: watch::Receiver<readiness::State>,
) {
    let mut app = Router::new()
        .route("/v1/detect", post(detect))
        .route("/v2", get(server_metadata))
        .route("/v2/models/stats", get(all_statistics))
        .route("/v2/repository/index", post(repository_index))
        .route("/v2/repository/models/{model}/load", post(load))
        .route("/v2/repository/models/{model}/unload", post(unload));
    for model in ["/v2/models/{model}", "/v2/models/{model}/versions/{version}"] {
        app = app
            .route(model, get(model_metadata))
            .route(&format!("{model}/ready"), get(model_ready))
            .route(&format!("{model}/config"), get(model_config))
            .route(&format!("{model}/stats"), get(model_statistics))
            .route(&format!("{model}/infer"), post(infer));
    }
    let app = app
        .layer(from_fn_with_state(rest.clone(), check_access))
        // Probes have no token.
        .route("/v2/health/live", get(server_live))
        .route("/v2/health/ready", get(server_ready))
        .fallback(no_such_path)
        .method_not_allowed_fallback(no_such_method)
        .with_state(rest);
    http_connections::serve(listener, config, app, state).await;
}

async fn no_such_path(uri: Uri) -> Response {
    let error = format!("the path `{}` is not served; see docs/api.md for those that are", on_a_line(uri.path()));
    (StatusCode::NOT_FOUND, Json(json!({ "error": error }))).into_response()
}

async fn no_such_method(method: Method, uri: Uri) -> Response {
    let error = format!("the path `{}` does not accept {method}", on_a_line(uri.path()));
    (StatusCode::METHOD_NOT_ALLOWED, Json(json!({ "error": error }))).into_response()
}

/// An error as an HTTP response.
struct Refused(Status);

type Reply<T = Json<Value>> = Result<T, Refused>;

impl From<Status> for Refused {
    fn from(status: Status) -> Self {
        Self(status)
    }
}

impl IntoResponse for Refused {
    fn into_response(self) -> Response {
        let Self(status) = self;
        let mut response = (http_status(status.code()), Json(json!({ "error": status.message() }))).into_response();
        if let Some(after) = status.get_details_retry_info().and_then(|info| info.retry_delay) {
            // Whole seconds (RFC 9110, section 10.2.3).
            let seconds = after.as_secs() + u64::from(after.subsec_nanos() > 0);
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

fn http_status(code: Code) -> StatusCode {
    match code {
        Code::InvalidArgument => StatusCode::BAD_REQUEST,
        Code::Unauthenticated => StatusCode::UNAUTHORIZED,
        Code::PermissionDenied => StatusCode::FORBIDDEN,
        Code::NotFound => StatusCode::NOT_FOUND,
        Code::FailedPrecondition | Code::Aborted => StatusCode::CONFLICT,
        Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
        Code::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
        Code::DeadlineExceeded | Code::Cancelled => StatusCode::REQUEST_TIMEOUT,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

/// Refuses requests without a token, and those of web pages: any page could send them through a browser that can reach
/// this server.
async fn check_access(State(rest): State<Rest>, mut request: Request, next: Next) -> Reply<Response> {
    let headers = request.headers();
    let checked = match &rest.tokens {
        _ if headers.contains_key(ORIGIN) => Err(Status::permission_denied("requests of web pages are not accepted")),
        Some(tokens) => tokens.check(&MetadataMap::from_headers(headers.clone())).map(Some),
        None => Ok(None),
    };
    match checked {
        Ok(caller) => {
            if let Some(caller) = caller {
                request.extensions_mut().insert(caller);
            }
            Ok(next.run(request).await)
        }
        Err(status) => {
            rest.metrics.ended("", status.code());
            let (parts, body) = request.into_parts();
            discard(body, &parts, rest.limits).await;
            Err(status.into())
        }
    }
}

/// The gRPC request with a message, and the caller and the trace of an HTTP request.
fn grpc<T>(parts: Parts, message: T) -> tonic::Request<T> {
    tonic::Request::from_parts(MetadataMap::from_headers(parts.headers), parts.extensions, message)
}

/// The name and version in a path; without a version the newest.
#[derive(serde::Deserialize)]
struct Model {
    model: String,
    #[serde(default)]
    version: String,
}

async fn server_live(State(rest): State<Rest>) -> Reply<StatusCode> {
    let live = rest.inference.server_live(tonic::Request::new(oip::ServerLiveRequest {})).await?;
    Ok(ready_status(live.into_inner().live))
}

async fn server_ready(State(rest): State<Rest>) -> Reply<StatusCode> {
    let ready = rest.inference.server_ready(tonic::Request::new(oip::ServerReadyRequest {})).await?;
    Ok(ready_status(ready.into_inner().ready))
}

fn ready_status(is_ready: bool) -> StatusCode {
    if is_ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }
}

async fn server_metadata(State(rest): State<Rest>) -> Reply {
    let metadata = rest.inference.server_metadata(tonic::Request::new(oip::ServerMetadataRequest {})).await?;
    let oip::ServerMetadataResponse { name, version, extensions } = metadata.into_inner();
    Ok(Json(json!({ "name": name, "version": version, "extensions": extensions })))
}

async fn model_ready(State(rest): State<Rest>, Path(Model { model, version }): Path<Model>) -> Reply<StatusCode> {
    let request = tonic::Request::new(oip::ModelReadyRequest { name: model, version });
    Ok(ready_status(rest.inference.model_ready(request).await?.into_inner().ready))
}

async fn model_metadata(State(rest): State<Rest>, Path(Model { model, version }): Path<Model>) -> Reply {
    let request = tonic::Request::new(oip::ModelMetadataRequest { name: model, version });
    let metadata = rest.inference.model_metadata(request).await?.into_inner();
    let oip::ModelMetadataResponse { name, versions, platform, inputs, outputs } = metadata;
    let tensors = |tensors: Vec<oip::model_metadata_response::TensorMetadata>| -> Vec<Value> {
        let tensors = tensors.into_iter();
        tensors
            .map(|tensor| json!({ "name": tensor.name, "datatype": tensor.datatype, "shape": tensor.shape }))
            .collect()
    };
    Ok(Json(json!({
        "name": name,
        "versions": versions,
        "platform": platform,
        "inputs": tensors(inputs),
        "outputs": tensors(outputs),
    })))
}

async fn model_config(State(rest): State<Rest>, Path(Model { model, version }): Path<Model>) -> Reply {
    let request = tonic::Request::new(oip::ModelConfigRequest { name: model, version });
    let config = rest.inference.model_config(request).await?.into_inner().config.unwrap_or_default();
    let tensor = |name: &str, data_type: oip::DataType, dims: &[i64]| json!({ "name": name, "data_type": data_type.as_str_name(), "dims": dims });
    let inputs = config.input.iter().map(|input| tensor(&input.name, input.data_type(), &input.dims));
    let outputs = config.output.iter().map(|output| tensor(&output.name, output.data_type(), &output.dims));
    Ok(Json(json!({
        "name": config.name,
        "platform": config.platform,
        "backend": config.backend,
        "max_batch_size": config.max_batch_size,
        "input": inputs.collect::<Vec<_>>(),
        "output": outputs.collect::<Vec<_>>(),
    })))
}

async fn model_statistics(state: State<Rest>, Path(Model { model, version }): Path<Model>) -> Reply {
    statistics(state, model, version).await
}

async fn all_statistics(state: State<Rest>) -> Reply {
    statistics(state, String::new(), String::new()).await
}

async fn statistics(State(rest): State<Rest>, name: String, version: String) -> Reply {
    let request = tonic::Request::new(oip::ModelStatisticsRequest { name, version });
    let statistics = rest.inference.model_statistics(request).await?.into_inner();
    let duration = |duration: Option<oip::StatisticDuration>| {
        let oip::StatisticDuration { count, ns } = duration.unwrap_or_default();
        json!({ "count": count, "ns": ns })
    };
    let models = statistics.model_stats.into_iter().map(|model| {
        let stages = model.inference_stats.unwrap_or_default();
        json!({
            "name": model.name,
            "version": model.version,
            "last_inference": model.last_inference,
            "inference_count": model.inference_count,
            "execution_count": model.execution_count,
            "inference_stats": {
                "success": duration(stages.success),
                "fail": duration(stages.fail),
                "queue": duration(stages.queue),
                "compute_input": duration(stages.compute_input),
                "compute_infer": duration(stages.compute_infer),
                "compute_output": duration(stages.compute_output),
            },
        })
    });
    Ok(Json(json!({ "model_stats": models.collect::<Vec<_>>() })))
}

/// Detects grasps in depth images.
async fn detect(State(rest): State<Rest>, request: Request) -> Reply<Response> {
    let (parts, deadline, message) = rest.receive(request, |body| detect::request(body)).await?;
    let (_, reply, extensions) = rest.grasps.detect_grasps_from_depth(grpc(parts, message)).await?.into_parts();
    let bytes = rest.convert(deadline, move || detect::response(&reply)).await??;
    Ok(rest.reply(extensions, "application/json", bytes))
}

async fn infer(
    State(rest): State<Rest>,
    Path(Model { model, version }): Path<Model>,
    request: Request,
) -> Reply<Response> {
    let header_length = request.headers().get(HEADER_LENGTH).cloned();
    let parse = move |body: &Bytes| InferRequest::parse(body, header_length.as_ref());
    let (parts, deadline, parsed) = rest.receive(request, parse).await?;
    let (message, binary) = parsed.into_message(model, version);
    let (_, message, extensions) = rest.inference.model_infer(grpc(parts, message)).await?.into_parts();
    let (content_type, header_length, bytes) = rest.convert(deadline, move || response(message, &binary)).await?;
    let mut response = rest.reply(extensions, content_type, bytes);
    if let Some(length) = header_length {
        response.headers_mut().insert(HEADER_LENGTH, HeaderValue::from(length));
    }
    Ok(response)
}

impl Rest {
    /// Reads the body of a request and parses it.
    async fn receive<T: Send + 'static>(
        &self,
        request: Request,
        parse: impl FnOnce(&Bytes) -> Result<T, Status> + Send + 'static,
    ) -> Result<(Parts, Deadline, T), Status> {
        let (mut parts, body) = request.into_parts();
        let deadline = deadline::read(&parts.headers).unwrap_or_else(|| Deadline(Instant::now() + TIMEOUT));
        parts.extensions.insert(deadline);
        let parsed = async {
            let body = read(body, &parts, self.limits).await?;
            let parse = move || {
                // The whole body, so that it is dropped when it is parsed, and no longer counts as being received.
                let body = body;
                parse(&body.bytes)
            };
            self.convert(deadline, parse).await?
        };
        let parsed = parsed.await.inspect_err(|status| self.metrics.ended("", status.code()))?;
        Ok((parts, deadline, parsed))
    }

    /// The response to a call.
    fn reply(&self, extensions: Extensions, content_type: &'static str, bytes: Vec<u8>) -> Response {
        let mut response = http::Response::new(tonic::body::Body::new(Body::from(bytes)));
        *response.extensions_mut() = extensions;
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
        keep_permit(response, self.limits).map(Body::new)
    }

    /// Runs a conversion on a thread for blocking tasks: megabytes of JSON would block those of the async runtime. A
    /// bounded number of requests wait for it, at most until their deadline.
    async fn convert<T: Send + 'static>(
        &self,
        deadline: Deadline,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Status> {
        let waiting = Arc::clone(&self.waiting).try_acquire_owned();
        let waiting = waiting.map_err(|_| {
            let message = "too many requests wait for their conversion; retry later";
            let details = ErrorDetails::with_retry_info(Some(CONVERSIONS_WAIT));
            Status::with_error_details(Code::ResourceExhausted, message, details)
        })?;
        let permit = timeout_at(deadline.0.into(), Arc::clone(&self.conversions).acquire_owned()).await;
        let permit = permit.map_err(|_| Status::deadline_exceeded("the deadline passed before the conversion"))?;
        drop(waiting);
        let done = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            work()
        });
        done.await.map_err(|panic| Status::internal(format!("the conversion panicked: {panic}")))
    }
}

/// The body of a request to the model repository.
#[derive(Default, serde::Deserialize)]
struct RepositoryRequest {
    #[serde(default)]
    ready: bool,
    #[serde(default)]
    parameters: Parameters,
}

impl RepositoryRequest {
    /// Reads a body, which may be empty.
    async fn read(rest: &Rest, request: Request) -> Reply<(Parts, Self)> {
        let (parts, body) = request.into_parts();
        let body = read(body, &parts, rest.limits).await?;
        if body.bytes.is_empty() {
            return Ok((parts, Self::default()));
        }
        let request = serde_json::from_slice(&body.bytes);
        let request = request.map_err(|error| Status::invalid_argument(format!("the body is not valid: {error}")))?;
        Ok((parts, request))
    }
}

async fn repository_index(State(rest): State<Rest>, request: Request) -> Reply {
    let (parts, RepositoryRequest { ready, .. }) = RepositoryRequest::read(&rest, request).await?;
    let message = oip::RepositoryIndexRequest { repository_name: String::new(), ready };
    let index = rest.inference.repository_index(grpc(parts, message)).await?.into_inner();
    let models = index.models.into_iter();
    let models = models.map(
        |model| json!({ "name": model.name, "version": model.version, "state": model.state, "reason": model.reason }),
    );
    Ok(Json(models.collect()))
}

async fn load(State(rest): State<Rest>, Path(Model { model, .. }): Path<Model>, request: Request) -> Reply {
    let (parts, RepositoryRequest { parameters, .. }) = RepositoryRequest::read(&rest, request).await?;
    let parameters = parameters.for_repository();
    let message = oip::RepositoryModelLoadRequest { repository_name: String::new(), model_name: model, parameters };
    rest.inference.repository_model_load(grpc(parts, message)).await?;
    Ok(Json(json!({})))
}

async fn unload(State(rest): State<Rest>, Path(Model { model, .. }): Path<Model>, request: Request) -> Reply {
    let (parts, RepositoryRequest { parameters, .. }) = RepositoryRequest::read(&rest, request).await?;
    let parameters = parameters.for_repository();
    let message = oip::RepositoryModelUnloadRequest { repository_name: String::new(), model_name: model, parameters };
    rest.inference.repository_model_unload(grpc(parts, message)).await?;
    Ok(Json(json!({})))
}
