use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use grasp_proto::FILE_DESCRIPTOR_SET;
use grasp_proto::oip::grpc_inference_service_server::GrpcInferenceServiceServer;
use grasp_proto::pb::grasp_service_server::GraspServiceServer;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tonic::body::Body;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Server, ServerTlsConfig};
use tonic_health::pb::health_server::HealthServer;
use tower::util::{MapRequestLayer, MapResponseLayer};

use crate::readiness::{Health, State, draining};
use crate::rpc::grasp_service::GraspRpc;
use crate::rpc::inference_service::InferenceRpc;
use crate::telemetry::metrics::Metrics;
use crate::transport::request_body::{Limits, RequestBody};
use crate::transport::response_buffer::outgoing;
use crate::transport::tokens::Tokens;
use crate::transport::{connections, deadline, request_body, tokens};

/// HTTP/2's default of 64 KiB holds a quarter of a 40³ volume: the client would wait for us four times per request.
const STREAM_WINDOW: u32 = 4 << 20;
/// For several volumes in flight on one connection.
const CONNECTION_WINDOW: u32 = 16 << 20;
/// A volume in one frame instead of sixteen.
const MAX_FRAME: u32 = 1 << 20;
/// Clients that vanished without a word are noticed.
const KEEPALIVE: Duration = Duration::from_secs(30);

/// Calls that one connection may have open at a time: far more than queues take, few enough to bound what they hold.
const MAX_STREAMS: u32 = 256;

/// Who may connect and what is taken.
pub(crate) struct GrpcConfig {
    /// TLS, where it is spoken.
    pub tls: Option<ServerTlsConfig>,
    /// The tokens that are taken, where one is needed.
    pub tokens: Option<Arc<Tokens>>,
    /// The most connections.
    pub connections: usize,
    pub limits: Limits,
}

/// Serves until the state is draining and every request that was taken is answered.
pub(crate) async fn serve(
    listener: TcpListener,
    entrance: GrpcConfig,
    service: GraspRpc,
    inference: InferenceRpc,
    metrics: Arc<Metrics>,
    state: watch::Receiver<State>,
) -> anyhow::Result<()> {
    let GrpcConfig { tls, tokens, connections, limits } = entrance;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    // The limit is kept by the intake, which counts what it refuses.
    let grasps = GraspServiceServer::new(service).max_decoding_message_size(usize::MAX);
    let inference = GrpcInferenceServiceServer::new(inference).max_decoding_message_size(usize::MAX);
    let guard = tokens::guard(tokens, Arc::clone(&metrics));
    let incoming = connections::accept(listener, metrics.connections(connections, limits.stall));
    let counted = Arc::clone(&metrics);
    let outgoing = MapResponseLayer::new(move |response| outgoing(request_body::unreadable(response, &counted)));
    let intake = MapRequestLayer::new(move |request: http::Request<Body>| {
        let (mut parts, body) = request.into_parts();
        let deadline = deadline::read(&parts.headers);
        if let Some(deadline) = deadline {
            parts.extensions.insert(deadline);
        }
        let body = RequestBody::new(parts.uri.path(), body, deadline, limits, Arc::clone(&metrics));
        http::Request::from_parts(parts, Body::new(body))
    });
    let mut server = Server::builder();
    if let Some(tls) = tls {
        server = server
            .tls_config(tls.timeout(limits.stall))
            .context("the certificate, its key or the clients' CA cannot be used")?;
    }
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
        // Whoever watches over this process has no token.
        .add_service(HealthServer::new(Health(state.clone())))
        .add_service(InterceptedService::new(reflection().build_v1()?, guard.clone()))
        .add_service(InterceptedService::new(reflection().build_v1alpha()?, guard))
        .serve_with_incoming_shutdown(incoming, draining(state))
        .await?;
    Ok(())
}
