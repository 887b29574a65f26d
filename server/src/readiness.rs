use grasp::on_a_line;
use grasp_proto::oip::grpc_inference_service_server::SERVICE_NAME as INFERENCE;
use grasp_proto::pb::grasp_service_server::SERVICE_NAME;
use tokio::sync::watch;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::WatchStream;
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

/// Lifecycle state of the process, read by health checks, `/readyz` and the services.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// The models are being loaded and warmed up.
    Starting,
    /// Every session has completed an inference.
    Ready,
    /// All sessions of a model hang in an inference, or fail each one; the other models are served. Ends when a session
    /// recovers, otherwise only with a restart.
    Unhealthy,
    /// Shutting down: accepted requests are finished, new connections and messages are not accepted.
    Draining,
}

/// Owner of the [`State`].
pub(crate) struct Readiness(watch::Sender<State>);

impl Readiness {
    pub fn starting() -> Self {
        Self(watch::Sender::new(State::Starting))
    }

    pub fn subscribe(&self) -> watch::Receiver<State> {
        self.0.subscribe()
    }

    /// Sets the state while serving: whether every model has a session that neither hangs nor fails.
    pub fn serving(&self, is_healthy: bool) {
        self.0.send_replace(if is_healthy { State::Ready } else { State::Unhealthy });
    }

    /// Sets the last state and drops the sender, which ends all streams of [`Health::watch`].
    pub fn drain(self) {
        self.0.send_replace(State::Draining);
    }
}

/// Returns once the state is [`State::Draining`].
pub(crate) async fn draining(mut state: watch::Receiver<State>) {
    // An error means that the sender was dropped, which also ends serving.
    let _ = state.wait_for(|&state| state == State::Draining).await;
}

/// grpc.health.v1, for the server (empty name) and for each service.
pub(crate) struct Health(pub watch::Receiver<State>);

#[tonic::async_trait]
impl health_server::Health for Health {
    async fn check(&self, request: Request<HealthCheckRequest>) -> Result<Response<HealthCheckResponse>, Status> {
        let service = request.into_inner().service;
        if !is_known(&service) {
            return Err(Status::not_found(format!(
                "service `{}` not found; available: `{SERVICE_NAME}`, `{INFERENCE}`",
                on_a_line(&service)
            )));
        }
        Ok(Response::new(response(serving_status(*self.0.borrow()))))
    }

    type WatchStream = BoxStream<HealthCheckResponse>;

    async fn watch(&self, request: Request<HealthCheckRequest>) -> Result<Response<Self::WatchStream>, Status> {
        // The protocol requires SERVICE_UNKNOWN here, not an error.
        let known = is_known(&request.into_inner().service);
        let status = move |state| if known { serving_status(state) } else { ServingStatus::ServiceUnknown };
        Ok(Response::new(Box::pin(WatchStream::new(self.0.clone()).map(move |state| Ok(response(status(state)))))))
    }
}

fn is_known(service: &str) -> bool {
    ["", SERVICE_NAME, INFERENCE].contains(&service)
}

fn serving_status(state: State) -> ServingStatus {
    match state {
        State::Ready => ServingStatus::Serving,
        State::Starting | State::Unhealthy | State::Draining => ServingStatus::NotServing,
    }
}

fn response(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse { status: status.into() }
}
