use std::time::Duration;

use grasp::Volume;
use grasp_proto::pb;
use grasp_proto::pb::detect_grasps_stream_response::Outcome;
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, timeout_at};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::access::{Bearer, may_pass};
use crate::{Access, CloudView, DepthView, Detection, Error, Options, Retry, Workspace};

/// Several replies in flight on one connection must not wait for HTTP/2's windows of 64 KiB.
const WINDOW: u32 = 4 << 20;

/// How often a server that is not ready yet is asked again.
const POLL: Duration = Duration::from_millis(50);

/// A connection to graspd. Clones share it; calls may run at the same time.
#[derive(Clone, Debug)]
pub struct Client {
    channel: Channel,
    bearer: Bearer,
    retry: Retry,
}

/// What a server says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// It answers.
    Serving,
    /// It is warming up or shutting down.
    NotServing,
}

impl Client {
    /// Connects to `address`, such as `127.0.0.1:50051` or `http://robot:50051`.
    ///
    /// # Errors
    /// [`Error::Connect`] when nobody listens there.
    pub async fn connect(address: impl Into<String>) -> Result<Self, Error> {
        Self::connect_with(address, Access::default()).await
    }

    /// Connects where more than the address is needed.
    ///
    /// # Errors
    /// [`Error::Connect`] when nobody listens there, or the two do not come to terms over TLS.
    pub async fn connect_with(address: impl Into<String>, access: Access) -> Result<Self, Error> {
        let address = address.into();
        let tls = access.tls(&address);
        let scheme = if tls.is_some() { "https" } else { "http" };
        let uri = if address.contains("://") { address.clone() } else { format!("{scheme}://{address}") };
        let connect = async || {
            let mut endpoint = Endpoint::from_shared(uri)?;
            if let Some(tls) = tls {
                endpoint = endpoint.tls_config(tls)?;
            }
            endpoint.initial_stream_window_size(WINDOW).initial_connection_window_size(WINDOW).connect().await
        };
        let channel = connect().await.map_err(|source| Error::Connect { address, source })?;
        Ok(Self { channel, bearer: Bearer(access.token), retry: access.retry })
    }

    /// Connects to a server that may still be starting, and returns once it is ready.
    ///
    /// # Errors
    /// [`Error::NotReady`] with what it said last, if that takes longer than `timeout`.
    pub async fn wait_ready(address: impl Into<String>, timeout: Duration) -> Result<Self, Error> {
        let address = address.into();
        let deadline = Instant::now() + timeout;
        loop {
            let ask = async {
                let client = Self::connect(address.clone()).await?;
                Ok::<_, Error>((client.health().await?, client))
            };
            let last = match timeout_at(deadline, ask).await {
                Ok(Ok((Health::Serving, client))) => return Ok(client),
                Ok(Ok((Health::NotServing, _))) => "it says that it is not serving".to_owned(),
                Ok(Err(error)) => error.to_string(),
                Err(_) => "it does not answer".to_owned(),
            };
            if Instant::now() >= deadline {
                return Err(Error::NotReady { address, timeout, last });
            }
            sleep(POLL).await;
        }
    }

    /// Asks for the grasps in a volume, as often as [`Retry`] has it.
    ///
    /// # Errors
    /// [`Error::Refused`] with the last status.
    pub async fn detect(&self, volume: &Volume, options: Options) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.request(volume);
        self.ask(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps(request).await,
        )
        .await
    }

    /// Asks for the grasps in what depth cameras see.
    ///
    /// # Errors
    /// [`Error::Refused`] with the last status.
    pub async fn detect_from_depth(
        &self,
        views: &[DepthView],
        workspace: &Workspace,
        options: Options,
    ) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.depth_request(views, workspace);
        self.ask(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps_from_depth(request).await,
        )
        .await
    }

    /// Asks for the grasps in point clouds.
    ///
    /// # Errors
    /// [`Error::Refused`] with the last status.
    pub async fn detect_from_cloud(
        &self,
        views: &[CloudView],
        workspace: &Workspace,
        options: Options,
    ) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.cloud_request(views, workspace);
        self.ask(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps_from_cloud(request).await,
        )
        .await
    }

    /// Has the server keep a volume for a camera that moves.
    ///
    /// # Errors
    /// [`Error::Refused`] when it keeps enough already.
    pub async fn track(&self, workspace: Workspace) -> Result<Tracking, Error> {
        let (requests, waiting) = mpsc::channel(1);
        let replies = self.grasps().track_grasps(ReceiverStream::new(waiting)).await?.into_inner();
        Ok(Tracking { requests, replies, workspace: Some(workspace) })
    }

    /// Asks for the grasps in each of a stream of volumes; one answer comes for each, in their order. A volume that is
    /// refused does not end the stream.
    ///
    /// # Errors
    /// [`Error::Refused`] when the stream cannot be opened.
    pub async fn detect_stream<S>(
        &self,
        volumes: S,
    ) -> Result<impl Stream<Item = Result<Detection, Error>> + use<S>, Error>
    where
        S: Stream<Item = (Volume, Options)> + Send + 'static,
    {
        let requests = volumes.map(|(volume, options)| options.request(&volume));
        let responses = self.grasps().detect_grasps_stream(requests).await?.into_inner();
        Ok(responses.map(|response| outcome(response?)))
    }

    /// The models that the server has loaded, the default first.
    ///
    /// # Errors
    /// [`Error::Refused`] with the server's status.
    pub async fn list_models(&self) -> Result<Vec<pb::Model>, Error> {
        Ok(self.grasps().list_models(pb::ListModelsRequest {}).await?.into_inner().models)
    }

    /// Asks whether the server is ready.
    ///
    /// # Errors
    /// [`Error::Refused`] with the server's status.
    pub async fn health(&self) -> Result<Health, Error> {
        let response = HealthClient::new(self.channel.clone()).check(HealthCheckRequest::default()).await?;
        Ok(match response.into_inner().status() {
            ServingStatus::Serving => Health::Serving,
            ServingStatus::NotServing | ServingStatus::Unknown | ServingStatus::ServiceUnknown => Health::NotServing,
        })
    }

    /// Asks as often as [`Retry`] has it.
    async fn ask<S, M>(
        &self,
        timeout: Option<Duration>,
        message: impl Fn() -> (S, M),
        call: impl AsyncFn((S, tonic::Request<M>)) -> Result<tonic::Response<pb::DetectGraspsResponse>, Status>,
    ) -> Result<Detection, Error> {
        let mut attempts = 0;
        loop {
            let (service, message) = message();
            let mut request = tonic::Request::new(message);
            if let Some(timeout) = timeout {
                request.set_timeout(timeout);
            }
            let status = match call((service, request)).await {
                Ok(response) => return response.into_inner().try_into(),
                Err(status) => status,
            };
            attempts += 1;
            let may_pass = may_pass(&status);
            let error = Error::from(status);
            match self.retry.pause(attempts, error.retry_after()) {
                Some(pause) if may_pass => sleep(pause).await,
                _ => return Err(error),
            }
        }
    }

    fn grasps(&self) -> GraspServiceClient<InterceptedService<Channel, Bearer>> {
        // With a low threshold there may be tens of thousands of grasps.
        let service = GraspServiceClient::with_interceptor(self.channel.clone(), self.bearer.clone());
        service.max_decoding_message_size(usize::MAX)
    }
}

/// A volume that the server keeps for as long as this lives, and what it sees in it.
#[derive(Debug)]
pub struct Tracking {
    requests: mpsc::Sender<pb::TrackGraspsRequest>,
    replies: Streaming<pb::DetectGraspsStreamResponse>,
    /// Until it has been sent.
    workspace: Option<Workspace>,
}

impl Tracking {
    /// Adds views to the volume, and asks for the grasps in all that was seen so far.
    ///
    /// # Errors
    /// [`Error::Refused`]: what is wrong with a view does not end the tracking. With [`Code::ResourceExhausted`] the views
    /// have been added all the same: ask again without them.
    pub async fn add(&mut self, views: &[DepthView], options: Options) -> Result<Detection, Error> {
        let request = options.track_request(views, self.workspace.as_ref());
        // A server that hung up says why in its last reply.
        let _ = self.requests.send(request).await;
        let reply = self.replies.message().await?;
        let detection = outcome(reply.ok_or_else(|| Status::unavailable("the server has ended the stream"))?);
        // These two are met only after the views were added: another workspace would start another volume.
        let was_added = [Code::ResourceExhausted, Code::Internal];
        if detection.as_ref().map_or_else(|error| error.code().is_some_and(|code| was_added.contains(&code)), |_| true)
        {
            self.workspace = None;
        }
        detection
    }
}

fn outcome(response: pb::DetectGraspsStreamResponse) -> Result<Detection, Error> {
    match response.outcome {
        Some(Outcome::Response(response)) => response.try_into(),
        Some(Outcome::Error(error)) => Err(error.into()),
        None => Err(Error::Refused {
            code: Code::Internal,
            message: "a reply with neither a response nor an error".to_owned(),
            retry_after: None,
            field: None,
        }),
    }
}
