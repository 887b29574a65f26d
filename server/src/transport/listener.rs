use std::sync::Arc;
use std::time::Duration;

use grasp_proto::FILE_DESCRIPTOR_SET;
use grasp_proto::oip::grpc_inference_service_server::GrpcInferenceServiceServer;
use grasp_proto::pb::grasp_service_server::GraspServiceServer;
use tokio::sync::watch;
use tonic::body::Body;
use tonic::codec::CompressionEncoding;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Server;
use tonic_health::pb::health_server::HealthServer;
use tower::util::{MapRequestLayer, MapResponseLayer};

use crate::api::grasp::GraspApi;
use crate::api::inference::InferenceApi;
use crate::readiness::{Health, State, draining};
use crate::telemetry::metrics::Metrics;
use crate::transport::address::Listener;
use crate::transport::connections::Peer;
use crate::transport::receive_budget::ReceiveBudget;
use crate::transport::request_body::{Limits, RequestBody};
use crate::transport::response_buffer::keep_permit;
use crate::transport::tls::Tls;
use crate::transport::tokens::Tokens;
use crate::transport::{connections, deadline, request_body, tokens};

/// HTTP/2's default of 64 KiB is a quarter of a 40³ volume: the client would wait for a window update four times per
/// request. Only what the server does not read stays in a window: requests without a stream are read at once, within
/// the [`ReceiveBudget`]; streams are not read while their replies are unread, so their number and that time are
/// limited ([`OpenStreams`](crate::open_streams::OpenStreams)).
const STREAM_WINDOW: u32 = 1 << 20;
/// Several volumes in flight on one connection.
const CONNECTION_WINDOW: u32 = 4 << 20;
/// One frame per 40³ volume instead of sixteen.
const MAX_FRAME: u32 = 1 << 20;
/// Interval of keep-alive pings, which detect clients that disappeared without closing the connection.
const KEEPALIVE: Duration = Duration::from_secs(30);

/// Maximum number of concurrent calls per connection: more than a queue holds by default, and a bound on their memory.
const MAX_STREAMS: u32 = 256;

/// Settings of the gRPC listener.
pub(crate) struct GrpcConfig {
    /// None for plaintext.
    pub tls: Option<Tls>,
    /// None if requests need no token.
    pub tokens: Option<Arc<Tokens>>,
    /// Maximum number of open connections.
    pub connections: usize,
    /// Time after which a connection accepts no further calls; None without a limit.
    pub connection_age: Option<Duration>,
    /// The messages that are being received.
    pub budget: Arc<ReceiveBudget>,
    pub limits: Limits,
}

/// Serves until the state is draining and all accepted requests are finished.
pub(crate) async fn serve(
    listener: Listener,
    config: GrpcConfig,
    service: GraspApi,
    inference: InferenceApi,
    metrics: Arc<Metrics>,
    state: watch::Receiver<State>,
) -> anyhow::Result<()> {
    let GrpcConfig { tls, tokens, connections, connection_age, budget, limits } = config;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    // `RequestBody` enforces the limit on messages as they are sent; this limit is for decompressed ones.
    let grasps = GraspServiceServer::new(service).max_decoding_message_size(limits.message_bytes);
    let inference = GrpcInferenceServiceServer::new(inference).max_decoding_message_size(limits.message_bytes);
    let grasps = grasps.accept_compressed(CompressionEncoding::Gzip).accept_compressed(CompressionEncoding::Zstd);
    let inference = inference.accept_compressed(CompressionEncoding::Gzip).accept_compressed(CompressionEncoding::Zstd);
    let guard = tokens::guard(tokens, Arc::clone(&metrics));
    let limit = metrics.connections("grpc", connections);
    let incoming = connections::accept(listener, tls.map(|tls| tls.grpc), limit, limits.stall, Arc::clone(&budget));
    let (counted, drain) = (Arc::clone(&metrics), state.clone());
    let outgoing =
        MapResponseLayer::new(move |response| keep_permit(request_body::unreadable(response, &counted), limits));
    let intake = MapRequestLayer::new(move |request: http::Request<Body>| {
        let (mut parts, body) = request.into_parts();
        let deadline = deadline::read(&parts.headers);
        if let Some(deadline) = deadline {
            parts.extensions.insert(deadline);
        }
        // Every request belongs to a connection.
        let share =
            Peer::from_extensions(&parts.extensions).map_or_else(|| budget.of_peer(None), |peer| peer.share.clone());
        let body =
            RequestBody::new(parts.uri.path(), body, deadline, limits, share, Arc::clone(&metrics), drain.clone());
        http::Request::from_parts(parts, Body::new(body))
    });
    let server = Server::builder();
    // Open calls are not ended at this age, because there is no grace period.
    let server = connection_age.into_iter().fold(server, Server::max_connection_age);
    server
        .layer(intake)
        .layer(outgoing)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_frame_size(MAX_FRAME)
        .max_concurrent_streams(MAX_STREAMS)
        .http2_keepalive_interval(Some(KEEPALIVE))
        .add_service(InterceptedService::new(grasps, guard.clone()))
        .add_service(InterceptedService::new(inference, guard.clone()))
        // Without the guard: probes have no token.
        .add_service(HealthServer::new(Health(state.clone())))
        .add_service(InterceptedService::new(reflection().build_v1()?, guard.clone()))
        .add_service(InterceptedService::new(reflection().build_v1alpha()?, guard))
        .serve_with_incoming_shutdown(incoming, draining(state))
        .await?;
    Ok(())
}
