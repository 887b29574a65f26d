use std::time::Duration;

use grasp::{RequestError, Volume};
use grasp_proto::pb;
use grasp_proto::pb::detect_grasps_stream_response::Outcome;
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use grasp_proto::pb::recording::{Answer, Request};
use nalgebra::Isometry3;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, timeout, timeout_at};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::access::{Bearer, has_timed_out, is_transient};
use crate::address;
use crate::{
    Access, AnyView, Candidate, CloudView, DepthView, Detection, Error, Observation, Options, Retry, Scores, Workspace,
};

/// Flow-control window, bytes. HTTP/2's default of 64 KiB stalls concurrent large replies.
const WINDOW: u32 = 4 << 20;

/// Time limit of a connection attempt, and of its TLS handshake. By default a host that does not answer blocks for
/// minutes.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// Interval of the pings during calls, and the time within which the server must answer one. They detect a server that
/// disappears without closing the connection. The Python client has the same values.
const KEEPALIVE: Duration = Duration::from_secs(30);
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// Polling interval of `wait_ready`.
const POLL: Duration = Duration::from_millis(50);

/// A connection to graspd. Clones share the connection; calls may run concurrently.
#[derive(Clone, Debug)]
pub struct Client {
    channel: Channel,
    bearer: Bearer,
    retry: Retry,
    /// Time limit of calls whose options have none.
    timeout: Option<Duration>,
}

/// The server's health status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// Ready for requests.
    Serving,
    /// Warming up or shutting down, or all sessions of a model hang or fail.
    NotServing,
}

impl Client {
    /// Connects to `address`, such as `127.0.0.1:50051`, `http://robot:50051` or `unix:/run/graspd.sock`.
    ///
    /// # Errors
    /// [`Error::Connect`] when the server cannot be reached.
    pub async fn connect(address: impl Into<String>) -> Result<Self, Error> {
        Self::connect_with(address, Access::default()).await
    }

    /// Connects with TLS, a token, retries or a time limit of the calls.
    ///
    /// # Errors
    /// [`Error::Connect`] when the server cannot be reached or the TLS handshake fails.
    pub async fn connect_with(address: impl Into<String>, access: Access) -> Result<Self, Error> {
        let address = address.into();
        let tls = access.tls(&address);
        let uri = match address::uri(&address, tls.is_some()) {
            Ok(uri) => uri,
            Err(reason) => return Err(Error::Connect { address, reason }),
        };
        let connect = async || {
            let mut endpoint = Endpoint::from_shared(uri)?;
            if let Some(tls) = tls {
                endpoint = endpoint.tls_config(tls.timeout(CONNECT_TIMEOUT))?;
            }
            endpoint
                .initial_stream_window_size(WINDOW)
                .initial_connection_window_size(WINDOW)
                .connect_timeout(CONNECT_TIMEOUT)
                .http2_keep_alive_interval(KEEPALIVE)
                .keep_alive_timeout(KEEPALIVE_TIMEOUT)
                .connect()
                .await
        };
        let channel = connect().await.map_err(|error| Error::connect(address, &error))?;
        Ok(Self { channel, bearer: Bearer(access.token), retry: access.retry, timeout: access.timeout })
    }

    /// Connects to a server that may still be starting, and returns when it is ready.
    ///
    /// # Errors
    /// [`Error::NotReady`] with the last failure, if the server is not ready within `timeout`.
    pub async fn wait_ready(address: impl Into<String>, timeout: Duration) -> Result<Self, Error> {
        Self::wait_ready_with(address, Access::default(), timeout).await
    }

    /// Like [`wait_ready`](Self::wait_ready), with TLS, a token, retries or a time limit of the calls.
    ///
    /// # Errors
    /// [`Error::NotReady`] with the last failure, if the server is not ready within `timeout`.
    pub async fn wait_ready_with(address: impl Into<String>, access: Access, timeout: Duration) -> Result<Self, Error> {
        let address = address.into();
        let deadline = Instant::now() + timeout;
        loop {
            let attempt = async {
                let client = Self::connect_with(address.clone(), access.clone()).await?;
                Ok::<_, Error>((client.health().await?, client))
            };
            let last = match timeout_at(deadline, attempt).await {
                Ok(Ok((Health::Serving, client))) => return Ok(client),
                Ok(Ok((Health::NotServing, _))) => "its health status is NOT_SERVING".to_owned(),
                Ok(Err(error)) => error.to_string(),
                Err(_) => "no answer".to_owned(),
            };
            if Instant::now() >= deadline {
                return Err(Error::NotReady { address, timeout, last });
            }
            sleep(POLL).await;
        }
    }

    /// Detects grasps in a volume. Transient failures are retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt; [`Error::Reply`] for an invalid reply.
    pub async fn detect(&self, volume: &Volume, options: Options) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.request(volume);
        self.call(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps(request).await,
        )
        .await?
        .try_into()
    }

    /// Detects grasps in depth images. The server fuses them into `workspace`. Transient failures are retried according
    /// to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt; [`Error::Reply`] for an invalid reply.
    pub async fn detect_from_depth(
        &self,
        views: &[DepthView],
        workspace: &Workspace,
        options: Options,
    ) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.depth_request(views, workspace);
        self.call(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps_from_depth(request).await,
        )
        .await?
        .try_into()
    }

    /// Detects grasps in point clouds, one per camera. The server fuses them into `workspace`. Transient failures are
    /// retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt; [`Error::Reply`] for an invalid reply.
    pub async fn detect_from_cloud(
        &self,
        views: &[CloudView],
        workspace: &Workspace,
        options: Options,
    ) -> Result<Detection, Error> {
        let timeout = options.timeout;
        let message = options.cloud_request(views, workspace);
        self.call(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.detect_grasps_from_cloud(request).await,
        )
        .await?
        .try_into()
    }

    /// Scores the caller's grasps in an observation: `candidates` are `T_frame_grasp`, in the convention of the
    /// options. Their widths are unknown; [`score_candidates`](Self::score_candidates) takes widths, too. Transient
    /// failures are retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt.
    pub async fn score(
        &self,
        observation: Observation<'_>,
        candidates: &[Isometry3<f64>],
        options: Options,
    ) -> Result<Scores, Error> {
        let candidates: Vec<Candidate> = candidates.iter().copied().map(Candidate::from).collect();
        self.score_candidates(observation, &candidates, options).await
    }

    /// Scores the caller's grasps in an observation. With a width the server also checks it against the opening of the
    /// hand. Transient failures are retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt.
    pub async fn score_candidates(
        &self,
        observation: Observation<'_>,
        candidates: &[Candidate],
        options: Options,
    ) -> Result<Scores, Error> {
        let timeout = options.timeout;
        let message = options.score_request(observation, candidates);
        let response = self.call(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.score_grasps(request).await,
        );
        Ok(response.await?.into())
    }

    /// Finds the table in a view, and the workspace over what stands on it. Of `workspace` only the size, the extent
    /// and the gravity of `find_table` are used; of `options` only `request_id`, `frame_id`, `stamp` and `timeout`.
    /// `table_height` is the height of the table above the bottom of the workspace, metres, from 0 to 0.3; `None`:
    /// 0.05. A depth image needs [`Extrinsics::FrameFromCamera`](crate::Extrinsics::FrameFromCamera). Transient
    /// failures are retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt, also if the view shows no table; [`Error::Reply`] for an
    /// invalid reply.
    pub async fn find_table(
        &self,
        view: AnyView<'_>,
        workspace: &Workspace,
        table_height: Option<f64>,
        options: Options,
    ) -> Result<pb::FoundTable, Error> {
        let timeout = options.timeout;
        let message = options.table_request(view, workspace, table_height);
        let response = self.call(
            timeout,
            || (self.grasps(), message.clone()),
            async |(mut grasps, request)| grasps.find_table(request).await,
        );
        response.await?.table.ok_or_else(|| RequestError::invalid("table", "absent", "must be given").into())
    }

    /// Sends a recorded request again. `model` replaces its model; the version is dropped with it.
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt.
    pub async fn replay(&self, mut request: Request, model: Option<&str>) -> Result<Answer, Error> {
        if let Some(model) = model {
            let options = options_of(&mut request);
            model.clone_into(&mut options.model);
            options.version.clear();
        }
        let service = || self.grasps();
        Ok(match request {
            Request::Volume(message) => Answer::Grasps(
                self.call(
                    None,
                    || (service(), message.clone()),
                    async |(mut grasps, request)| grasps.detect_grasps(request).await,
                )
                .await?,
            ),
            Request::Depth(message) => Answer::Grasps(
                self.call(
                    None,
                    || (service(), message.clone()),
                    async |(mut grasps, request)| grasps.detect_grasps_from_depth(request).await,
                )
                .await?,
            ),
            Request::Cloud(message) => Answer::Grasps(
                self.call(
                    None,
                    || (service(), message.clone()),
                    async |(mut grasps, request)| grasps.detect_grasps_from_cloud(request).await,
                )
                .await?,
            ),
            Request::Score(message) => Answer::Scores(
                self.call(
                    None,
                    || (service(), message.clone()),
                    async |(mut grasps, request)| grasps.score_grasps(request).await,
                )
                .await?,
            ),
        })
    }

    /// Opens a tracked volume: the server keeps it and adds the views of a moving camera to it.
    ///
    /// # Errors
    /// [`Error::Refused`] when the server's limit of tracked volumes is reached.
    pub async fn track(&self, workspace: Workspace) -> Result<Tracking, Error> {
        let (requests, waiting) = mpsc::channel(1);
        let replies = self.grasps().track_grasps(ReceiverStream::new(waiting)).await?.into_inner();
        Ok(Tracking { requests, replies, unanswered: 0, workspace: Some(workspace), half_life: None })
    }

    /// Opens a tracked volume for a scene that moves: in each voxel the weight of a measurement halves after
    /// `half_life` further measurements, and with each one that contradicts it. 10 suits most scenes.
    ///
    /// # Errors
    /// [`Error::Refused`] when the server's limit of tracked volumes is reached.
    pub async fn track_moving(&self, workspace: Workspace, half_life: f64) -> Result<Tracking, Error> {
        Ok(Tracking { half_life: Some(half_life), ..self.track(workspace).await? })
    }

    /// Detects grasps in each volume of a stream. The results come in the order of the volumes, one per volume. A
    /// refused volume does not end the stream.
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

    /// The models that the server serves; the default model is first. Transient failures are retried according to
    /// [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt.
    pub async fn list_models(&self) -> Result<Vec<pb::Model>, Error> {
        let response = self.call(
            None,
            || (self.grasps(), pb::ListModelsRequest {}),
            async |(mut grasps, request)| grasps.list_models(request).await,
        );
        Ok(response.await?.models)
    }

    /// The server's health. Transient failures are retried according to [`Retry`].
    ///
    /// # Errors
    /// [`Error::Refused`] with the status of the last attempt.
    pub async fn health(&self) -> Result<Health, Error> {
        let response = self.call(
            None,
            || (HealthClient::new(self.channel.clone()), HealthCheckRequest::default()),
            async |(mut health, request)| health.check(request).await,
        );
        Ok(match response.await?.status() {
            ServingStatus::Serving => Health::Serving,
            ServingStatus::NotServing | ServingStatus::Unknown | ServingStatus::ServiceUnknown => Health::NotServing,
        })
    }

    /// Calls the server and retries according to [`Retry`]. Without a `limit` that of the connection applies.
    async fn call<S, M, R>(
        &self,
        limit: Option<Duration>,
        message: impl Fn() -> (S, M),
        call: impl AsyncFn((S, tonic::Request<M>)) -> Result<tonic::Response<R>, Status>,
    ) -> Result<R, Error> {
        let limit = limit.or(self.timeout);
        let mut attempts = 0;
        loop {
            let (service, message) = message();
            let mut request = tonic::Request::new(message);
            if let Some(limit) = limit {
                request.set_timeout(limit);
            }
            let answer = call((service, request));
            let outcome = match limit {
                // tonic's own limit does not include the time that it takes to connect again.
                Some(limit) => timeout(limit, answer).await.unwrap_or_else(|_| Err(expired(limit))),
                None => answer.await,
            };
            let status = match (outcome, limit) {
                (Ok(response), _) => return Ok(response.into_inner()),
                (Err(status), Some(limit)) if has_timed_out(&status) => expired(limit),
                (Err(status), _) => status,
            };
            attempts += 1;
            let is_transient = is_transient(&status);
            let error = Error::from(status);
            match self.retry.pause(attempts, error.retry_after()) {
                Some(pause) if is_transient => sleep(pause).await,
                _ => return Err(error),
            }
        }
    }

    fn grasps(&self) -> GraspServiceClient<InterceptedService<Channel, Bearer>> {
        // A low threshold can return tens of thousands of grasps.
        let service = GraspServiceClient::with_interceptor(self.channel.clone(), self.bearer.clone());
        service.max_decoding_message_size(usize::MAX)
    }
}

/// A tracked volume. The server deletes the volume when this is dropped.
#[derive(Debug)]
pub struct Tracking {
    requests: mpsc::Sender<pb::TrackGraspsRequest>,
    replies: Streaming<pb::DetectGraspsStreamResponse>,
    /// Requests without a reply yet: those of cancelled calls.
    unanswered: usize,
    /// `None` once the server has accepted it.
    workspace: Option<Workspace>,
    /// Half-life of the measurements, views.
    half_life: Option<f64>,
}

impl Tracking {
    /// Adds views to the volume and detects grasps in everything observed so far. Calls are not retried. If the
    /// returned future is dropped before it is ready, the views may have been added, and the next call waits for both
    /// replies.
    ///
    /// # Errors
    /// [`Error::Refused`]. An invalid view does not end the tracking. If [`Error::views_added`], retry without the
    /// views.
    pub async fn add(&mut self, views: &[DepthView], options: Options) -> Result<Detection, Error> {
        while self.unanswered > 0 {
            // The result of a cancelled call.
            let _ = self.reply().await?;
        }
        let request = options.track_request(views, self.workspace.as_ref(), self.half_life);
        // If the server has closed the stream, its last reply holds the reason.
        if let Ok(place) = self.requests.reserve().await {
            place.send(request);
            self.unanswered += 1;
        }
        self.reply().await?
    }

    /// The next reply; the outer error ends the stream.
    async fn reply(&mut self) -> Result<Result<Detection, Error>, Error> {
        let reply = self.replies.message().await?;
        let reply = reply.ok_or_else(|| Status::unavailable("the server closed the stream; start tracking again"))?;
        self.unanswered = self.unanswered.saturating_sub(1);
        let detection = outcome(reply);
        // Sending the workspace again would start another volume.
        if detection.as_ref().map_or_else(Error::views_added, |_| true) {
            self.workspace = None;
        }
        Ok(detection)
    }
}

/// The status of an attempt whose time limit has passed. It has no source, so it is not retried.
fn expired(limit: Duration) -> Status {
    Status::deadline_exceeded(format!("no reply within {limit:?}; raise the time limit, or check the server's load"))
}

/// The options of a request, which are created if they are absent.
fn options_of(request: &mut Request) -> &mut pb::Options {
    let options = match request {
        Request::Volume(request) => &mut request.options,
        Request::Depth(request) => &mut request.options,
        Request::Cloud(request) => &mut request.options,
        Request::Score(request) => &mut request.options,
    };
    options.get_or_insert_default()
}

fn outcome(response: pb::DetectGraspsStreamResponse) -> Result<Detection, Error> {
    let pb::DetectGraspsStreamResponse { request_id, outcome } = response;
    let error: Error = match outcome {
        Some(Outcome::Response(response)) => return response.try_into(),
        Some(Outcome::Error(error)) => error.into(),
        None => Status::internal("the server's reply has neither `response` nor `error`").into(),
    };
    Err(error.of_request(request_id))
}
