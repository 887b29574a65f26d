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

/// Where the process is in its life. Health, readiness and the service all read this one value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// Warming up the sessions.
    Starting,
    /// Every session has answered once.
    Ready,
    /// Told to stop: answers what it has taken, takes nothing more.
    Draining,
}

/// The one who may change the [`State`].
pub(crate) struct Readiness(watch::Sender<State>);

impl Readiness {
    pub fn starting() -> Self {
        Self(watch::Sender::new(State::Starting))
    }

    pub fn subscribe(&self) -> watch::Receiver<State> {
        self.0.subscribe()
    }

    pub fn ready(&self) {
        self.0.send_replace(State::Ready);
    }

    /// The last state: it is not told without the sender being dropped, which ends whatever watches.
    pub fn drain(self) {
        self.0.send_replace(State::Draining);
    }
}

/// Returns once the state is [`State::Draining`].
pub(crate) async fn draining(mut state: watch::Receiver<State>) {
    // An error means that the sender is gone, which leaves nobody to serve for either.
    let _ = state.wait_for(|&state| state == State::Draining).await;
}

/// grpc.health.v1 for the server as a whole (``) and for the services it has.
pub(crate) struct Health(pub watch::Receiver<State>);

#[tonic::async_trait]
impl health_server::Health for Health {
    async fn check(&self, request: Request<HealthCheckRequest>) -> Result<Response<HealthCheckResponse>, Status> {
        let service = request.into_inner().service;
        if !is_known(&service) {
            return Err(Status::not_found(format!("no service `{service}`; there is `{SERVICE_NAME}`")));
        }
        Ok(Response::new(response(serving_status(*self.0.borrow()))))
    }

    type WatchStream = BoxStream<HealthCheckResponse>;

    async fn watch(&self, request: Request<HealthCheckRequest>) -> Result<Response<Self::WatchStream>, Status> {
        // As the protocol has it, an unknown service is no error here: it could come up later.
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
        State::Starting | State::Draining => ServingStatus::NotServing,
    }
}

fn response(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse { status: status.into() }
}
