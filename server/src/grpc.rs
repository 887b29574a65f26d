use std::time::Duration;

use grasp_proto::FILE_DESCRIPTOR_SET;
use grasp_proto::pb::grasp_service_server::GraspServiceServer;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;
use tonic_health::pb::health_server::HealthServer;

use crate::deadline;
use crate::health::{Health, State, draining};
use crate::service::Grasps;

/// HTTP/2's default of 64 KiB holds a quarter of a 40³ volume: the client would wait for us four times per request.
const STREAM_WINDOW: u32 = 4 << 20;
/// For several volumes in flight on one connection.
const CONNECTION_WINDOW: u32 = 16 << 20;
/// A volume in one frame instead of sixteen.
const MAX_FRAME: u32 = 1 << 20;
/// Clients that vanished without a word are noticed.
const KEEPALIVE: Duration = Duration::from_secs(30);

/// Serves until the state is draining and every request that was taken is answered.
pub(crate) async fn serve(
    listener: TcpListener,
    max_message_bytes: usize,
    service: Grasps,
    state: watch::Receiver<State>,
) -> anyhow::Result<()> {
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let grasps = GraspServiceServer::new(service).max_decoding_message_size(max_message_bytes);
    Server::builder()
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_frame_size(MAX_FRAME)
        .http2_keepalive_interval(Some(KEEPALIVE))
        .add_service(InterceptedService::new(grasps, deadline::note))
        .add_service(HealthServer::new(Health(state.clone())))
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?)
        .serve_with_incoming_shutdown(incoming(listener), draining(state))
        .await?;
    Ok(())
}

/// The connections. `Server::tcp_nodelay` does nothing for a listener that was bound before; without TCP_NODELAY a
/// reply of several packets waits 40 ms for the client to acknowledge the first.
fn incoming(listener: TcpListener) -> TcpIncoming {
    TcpIncoming::from(listener).with_nodelay(Some(true))
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpStream;
    use tokio_stream::StreamExt;

    use super::*;

    #[tokio::test]
    async fn connections_do_not_wait_to_fill_packets() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let _client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let connection = incoming(listener).next().await.unwrap().unwrap();
        assert!(connection.nodelay().unwrap());
    }
}
