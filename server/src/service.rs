use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Volume};
use grasp_proto::pb::detect_grasps_stream_response::Outcome;
use grasp_proto::pb::grasp_service_server::GraspService;
use grasp_proto::{FieldError, pb, resolution};
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::BoxStream;
use tonic::{Code, Request, Response, Status, Streaming};
use tracing::field::Empty;
use tracing::{Span, debug, info, info_span};

use crate::deadline::Deadline;
use crate::engine::{Answer, Reply};
use crate::health::{State, draining};
use crate::metrics::Metrics;
use crate::models::{Models, check_voxel_size};
use crate::refusal::Refusal;
use crate::timings::Timings;

/// Requests of one stream that wait behind the one being answered: enough that no session waits for the next volume,
/// and few enough that a stream alone never fills a queue.
const READ_AHEAD: usize = 1;

/// Longest request id and frame id, bytes: they are echoed, and the first is logged.
const MAX_ID: usize = 256;

/// When to ask again while the sessions warm up.
const WARM_UP: Duration = Duration::from_secs(1);

/// grasp.v1.GraspService.
#[derive(Clone)]
pub(crate) struct Grasps {
    models: Arc<Models>,
    metrics: Arc<Metrics>,
    state: watch::Receiver<State>,
    ids: Arc<RequestIds>,
}

impl Grasps {
    pub fn new(models: Arc<Models>, metrics: Arc<Metrics>, state: watch::Receiver<State>) -> Self {
        Self { models, metrics, state, ids: Arc::new(RequestIds::new()) }
    }

    /// Checks a request and queues its volume. What is wrong with it comes out of [`Begun::finish`], like the answer.
    fn begin(&self, mut request: pb::DetectGraspsRequest, deadline: Option<Deadline>) -> Begun {
        let started = Instant::now();
        let mut id = std::mem::take(&mut request.request_id);
        let checked = check_id("request_id", &id);
        if id.is_empty() || checked.is_err() {
            id = self.ids.next();
        }
        let span = info_span!(
            "detect",
            request_id = id,
            model = Empty,
            queue = Empty,
            preprocessing = Empty,
            inference = Empty,
            postprocessing = Empty,
            total = Empty,
        );
        let mut call = Call {
            id,
            started,
            deadline,
            span,
            metrics: Arc::clone(&self.metrics),
            model: String::new(),
            version: String::new(),
            label: String::new(),
            ended: false,
        };
        let work = checked.map_err(Refusal::from).and_then(|()| self.submit(request, &mut call));
        Begun { call, work }
    }

    fn submit(&self, request: pb::DetectGraspsRequest, call: &mut Call) -> Result<Work, Refusal> {
        match *self.state.borrow() {
            State::Starting => return Err(Refusal::Starting(WARM_UP)),
            // What arrives on a connection that is already open is still answered; streams stop reading by themselves.
            State::Ready | State::Draining => {}
        }
        let volume = request.volume.as_ref().ok_or_else(|| FieldError::new("volume", "absent", "must be given"))?;
        check_id("volume.frame_id", &volume.frame_id)?;
        // The model before the data: nothing is converted that no model takes.
        let engine = self.models.select(&request.model, &request.version, resolution(volume)?)?;
        call.label.clone_from(&engine.label);
        call.model.clone_from(&engine.entry.metadata.name);
        call.version.clone_from(&engine.entry.metadata.version);
        call.span.record("model", &engine.label);

        let params = decode_params(&request, engine.entry.metadata.decode_params())?;
        let checked = Volume::try_from(volume)?;
        check_voxel_size(&checked, &engine)?;
        let preprocessing = call.started.elapsed();
        let reply = engine.submit(checked, params, call.deadline, call.span.clone())?;

        let pb::Volume { frame_id, stamp, .. } = request.volume.unwrap_or_default();
        let max_grasps = if request.max_grasps == 0 { usize::MAX } else { request.max_grasps as usize };
        Ok(Work { reply, preprocessing, max_grasps, explain: request.explain, frame_id, stamp })
    }
}

fn check_id(field: &'static str, id: &str) -> Result<(), FieldError> {
    if id.len() <= MAX_ID {
        return Ok(());
    }
    Err(FieldError::new(field, format_args!("{} bytes long", id.len()), format_args!("at most {MAX_ID} are taken")))
}

/// The model's own parameters, with what the request overrides.
fn decode_params(request: &pb::DetectGraspsRequest, own: DecodeParams) -> Result<DecodeParams, FieldError> {
    let probability = |field: &'static str, value: Option<f32>| match value {
        // Written so that NaN fails.
        Some(value) if !(value > 0.0 && value <= 1.0) => {
            Err(FieldError::new(field, value, "must be above 0 and at most 1"))
        }
        value => Ok(value),
    };
    let threshold = probability("threshold", request.threshold)?.unwrap_or(own.threshold);
    let force = probability("force", request.force)?.or(own.force);
    Ok(DecodeParams { threshold, force, ..own })
}

/// A request that was taken, or refused without anyone having been told yet.
struct Begun {
    call: Call,
    work: Result<Work, Refusal>,
}

/// A request on its way. Dropped before its end, it counts as cancelled by its caller, unless that one's time was up.
struct Call {
    id: String,
    started: Instant,
    deadline: Option<Deadline>,
    span: Span,
    metrics: Arc<Metrics>,
    model: String,
    version: String,
    /// The model's, empty as long as none is chosen.
    label: String,
    ended: bool,
}

/// What a request that was taken needs for its reply.
struct Work {
    reply: Reply,
    preprocessing: Duration,
    max_grasps: usize,
    explain: bool,
    frame_id: String,
    stamp: Option<prost_types::Timestamp>,
}

impl Begun {
    /// Waits for the session, and says in the log and the metrics how it went.
    async fn finish(self) -> Result<pb::DetectGraspsResponse, Refusal> {
        let Self { mut call, work } = self;
        let outcome = match work {
            Ok(work) => call.reply(work).await,
            Err(refusal) => Err(refusal),
        };
        call.ended = true;
        if let Err(refusal) = &outcome {
            call.metrics.ended(&call.label, refusal.code());
            call.span.in_scope(|| info!(code = ?refusal.code(), %refusal, "refused"));
        }
        outcome
    }
}

impl Call {
    async fn reply(&mut self, work: Work) -> Result<pb::DetectGraspsResponse, Refusal> {
        let answer = work.reply.wait(self.deadline).await?;
        let Answer { decoded, queue, inference, postprocessing } = answer;

        let sent = decoded.grasps.len().min(work.max_grasps);
        let grasps: Vec<_> = decoded.grasps[..sent].iter().map(pb::Grasp::from).collect();
        let explained = work.explain || grasps.is_empty();
        let dropped = explained.then(|| pb::Dropped {
            // At most one per voxel.
            over_limit: (decoded.grasps.len() - sent) as u32,
            ..(&decoded.dropped).into()
        });

        let total = self.started.elapsed();
        let timings = Timings { queue, preprocessing: work.preprocessing, inference, postprocessing, total };
        timings.record(&self.span);
        self.metrics.answered(&self.label, &timings, sent);
        self.span.in_scope(|| debug!(grasps = sent, "answered"));
        Ok(pb::DetectGraspsResponse {
            request_id: self.id.clone(),
            frame_id: work.frame_id,
            stamp: work.stamp,
            grasps,
            model: std::mem::take(&mut self.model),
            version: std::mem::take(&mut self.version),
            latency: Some((&timings).into()),
            dropped,
        })
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if !self.ended {
            let expired = self.deadline.is_some_and(|Deadline(deadline)| deadline <= Instant::now());
            let code = if expired { Code::DeadlineExceeded } else { Code::Cancelled };
            self.metrics.ended(&self.label, code);
            self.span.in_scope(|| info!(?code, "the caller has gone"));
        }
    }
}

#[tonic::async_trait]
impl GraspService for Grasps {
    async fn detect_grasps(
        &self,
        request: Request<pb::DetectGraspsRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let deadline = request.extensions().get().copied();
        let begun = self.begin(request.into_inner(), deadline);
        let id = begun.call.id.clone();
        begun.finish().await.map(Response::new).map_err(|refusal| refusal.status(&id))
    }

    type DetectGraspsStreamStream = BoxStream<pb::DetectGraspsStreamResponse>;

    async fn detect_grasps_stream(
        &self,
        request: Request<Streaming<pb::DetectGraspsRequest>>,
    ) -> Result<Response<Self::DetectGraspsStreamStream>, Status> {
        // The stream's, hence that of every request in it.
        let deadline = request.extensions().get().copied();
        let mut requests = request.into_inner();
        let service = self.clone();
        let (begun, calls) = mpsc::channel(READ_AHEAD);
        tokio::spawn(async move {
            // A place first, then the next message: what is read is in flight, the rest waits with the client.
            while let Ok(place) = begun.reserve().await {
                let message = tokio::select! {
                    message = requests.message() => message,
                    () = draining(service.state.clone()) => return,
                };
                match message {
                    Ok(Some(request)) => place.send(Ok(service.begin(request, deadline))),
                    Ok(None) => return,
                    // Too large, or no message at all: HTTP/2's framing is lost, so the stream ends with this status.
                    Err(status) => return place.send(Err(status)),
                }
            }
        });
        let replies = ReceiverStream::new(calls).then(async |begun: Result<Begun, Status>| {
            let begun = begun?;
            let request_id = begun.call.id.clone();
            let outcome = match begun.finish().await {
                Ok(response) => Outcome::Response(response),
                Err(refusal) => Outcome::Error(refusal.into()),
            };
            Ok(pb::DetectGraspsStreamResponse { request_id, outcome: Some(outcome) })
        });
        Ok(Response::new(Box::pin(replies)))
    }

    async fn list_models(&self, _: Request<pb::ListModelsRequest>) -> Result<Response<pb::ListModelsResponse>, Status> {
        Ok(Response::new((&*self.models).into()))
    }
}

/// Ids for requests that bring none: the process's own number, then a counter.
struct RequestIds {
    process: u32,
    next: AtomicU64,
}

impl RequestIds {
    fn new() -> Self {
        // The standard library's hashers are seeded by the system: randomness without another dependency.
        Self { process: RandomState::new().hash_one(0) as u32, next: AtomicU64::new(1) }
    }

    fn next(&self) -> String {
        format!("{:08x}-{}", self.process, self.next.fetch_add(1, Ordering::Relaxed))
    }
}
