use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use grasp::Warning;
use grasp_proto::{Candidate, DetectParams, FieldError, Priority, pb};
use opentelemetry::Context;
use tokio::sync::watch;
use tonic::{Code, Request, Status};
use tracing::field::Empty;
use tracing::{Span, debug, info, info_span};

use crate::readiness::State;
use crate::rpc::refusal::Refusal;
use crate::serving::cubes::CubeScene;
use crate::serving::detection::{Detection, Score};
use crate::serving::engine::Engine;
use crate::serving::job::{EngineError, Reply, SessionOutput, Tensors};
use crate::serving::queue::Ticket;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::{Outcome, RecentRequests, Shown};
use crate::telemetry::subscriber::{self, REQUEST};
use crate::telemetry::timings::StageTimings;
use crate::transport::caller::Caller;
use crate::transport::deadline::{self, Deadline};
use crate::transport::request_body::unreadable_message;

/// Maximum length of a request id and a frame id, bytes. Both are echoed; the request id is also logged.
const MAX_ID: usize = 256;

/// Retry hint while the models are loaded and warmed up.
pub(super) const WARM_UP: Duration = Duration::from_secs(1);

/// Creates the [`Call`] of each request.
#[derive(Clone)]
pub(crate) struct Calls {
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    state: watch::Receiver<State>,
    ids: Arc<RequestIds>,
}

/// A request in progress, with its id, span and metrics. If it is dropped before it ends, it counts as cancelled by the
/// client, or as expired if its deadline has passed.
pub(crate) struct Call {
    pub id: String,
    pub deadline: Option<Deadline>,
    caller: Caller,
    started: Instant,
    span: Span,
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    name: String,
    version: String,
    /// `name version` of the model; empty until a model is selected.
    label: String,
    ended: bool,
}

/// What is known of a request besides its message.
#[derive(Clone)]
pub(crate) struct CallContext {
    caller: Caller,
    deadline: Option<Deadline>,
    parent: Option<Context>,
}

impl CallContext {
    pub fn of<T>(request: &Request<T>) -> Self {
        Self {
            caller: Caller::of(request.extensions()),
            deadline: deadline::of(request.extensions()),
            parent: subscriber::parent(request.metadata()),
        }
    }
}

/// A queued request: the pending results of its cubes, and what the response needs besides them.
pub(crate) struct PendingReply<T = Detection> {
    replies: Vec<Reply<T>>,
    params: DetectParams,
    /// The smallest quality of a grasp.
    threshold: f32,
    /// Time until the scenes were queued, without the fusion.
    preprocessing: Duration,
    observed: Observed,
    origin: FrameStamp,
}

/// What the fusion of a request's views showed. The default is a request with a volume.
#[derive(Default)]
pub(crate) struct Observed {
    /// The time that the fusion took.
    pub fusion: Option<Duration>,
    /// Signs that the geometry of the request is wrong.
    pub warnings: Vec<Warning>,
    /// The table that determined the workspace.
    pub table: Option<pb::FoundTable>,
    /// By which the depths of each view were multiplied; empty if they were not to be corrected.
    pub depth_factors: Vec<f64>,
}

/// Frame id and time stamp of a request's views, echoed in the response.
#[derive(Clone, Default)]
pub(crate) struct FrameStamp {
    pub frame_id: String,
    pub stamp: Option<prost_types::Timestamp>,
}

impl Calls {
    pub fn new(metrics: Arc<Metrics>, recent: Arc<RecentRequests>, state: watch::Receiver<State>) -> Self {
        Self { metrics, recent, state, ids: Arc::new(RequestIds::new()) }
    }

    pub fn state(&self) -> watch::Receiver<State> {
        self.state.clone()
    }

    /// The status that ends a stream after a message that cannot be read.
    pub fn unreadable(&self, status: Status) -> Status {
        unreadable_message(status, &self.metrics)
    }

    /// Opens a call. The second value is an error if the id is invalid or the server is still starting.
    pub fn open(&self, mut id: String, context: CallContext) -> (Call, Result<(), Refusal>) {
        let started = Instant::now();
        let mut checked = check_id("request_id", &id).map_err(Refusal::from);
        if id.is_empty() || checked.is_err() {
            id = self.ids.next();
        }
        // During the drain, requests on open connections are still answered; streams stop reading on their own.
        if checked.is_ok() && *self.state.borrow() == State::Starting {
            checked = Err(Refusal::Starting(WARM_UP));
        }
        let CallContext { caller, deadline, parent } = context;
        let span = info_span!(
            REQUEST,
            otel.kind = "server",
            otel.status_code = Empty,
            request_id = id,
            model = Empty,
            queue = Empty,
            preprocessing = Empty,
            fusion = Empty,
            inference = Empty,
            evaluation = Empty,
            postprocessing = Empty,
            total = Empty,
        );
        subscriber::set_parent(&span, parent);
        let call = Call {
            id,
            deadline,
            caller,
            started,
            span,
            metrics: Arc::clone(&self.metrics),
            recent: Arc::clone(&self.recent),
            name: String::new(),
            version: String::new(),
            label: String::new(),
            ended: false,
        };
        (call, checked)
    }
}

impl FrameStamp {
    pub fn checked(
        field: &'static str,
        frame_id: String,
        stamp: Option<prost_types::Timestamp>,
    ) -> Result<Self, Refusal> {
        check_id(field, &frame_id)?;
        Ok(Self { frame_id, stamp })
    }
}

fn check_id(field: &'static str, id: &str) -> Result<(), FieldError> {
    if id.len() <= MAX_ID {
        return Ok(());
    }
    Err(FieldError::new(field, format_args!("{} bytes long", id.len()), format_args!("must be at most {MAX_ID}")))
}

impl Call {
    /// The request's place in a queue.
    pub fn ticket(&self, priority: Priority) -> Ticket {
        Ticket { caller: self.caller, priority, deadline: self.deadline.map(|Deadline(deadline)| deadline) }
    }

    /// Records the model that processes the request.
    pub fn set_model(&mut self, engine: &Engine) {
        self.label.clone_from(&engine.label);
        engine.source.name().clone_into(&mut self.name);
        engine.source.version().clone_into(&mut self.version);
        self.span.record("model", &engine.label);
    }

    /// Queues the scenes of a request for grasp detection.
    pub fn submit(
        &self,
        engine: &Engine,
        scenes: Vec<CubeScene>,
        params: DetectParams,
        origin: FrameStamp,
        observed: Observed,
    ) -> Result<PendingReply, Refusal> {
        engine.check_cubes(scenes.len())?;
        let ticket = self.ticket(params.priority);
        self.queue(engine, scenes, params, origin, observed, |scenes| engine.detect(scenes, ticket, &self.span))
    }

    /// Queues a scene whose candidates are to be scored.
    pub fn submit_candidates(
        &self,
        engine: &Engine,
        scene: CubeScene,
        candidates: &[Candidate],
        origin: FrameStamp,
        observed: Observed,
    ) -> Result<PendingReply<Vec<Score>>, Refusal> {
        let params = scene.params.clone();
        let ticket = self.ticket(params.priority);
        self.queue(engine, vec![scene], params, origin, observed, |scenes| {
            engine.score(scenes, candidates, ticket, &self.span)
        })
    }

    /// Checks the table in the scenes and queues them with `push`.
    fn queue<T>(
        &self,
        engine: &Engine,
        scenes: Vec<CubeScene>,
        params: DetectParams,
        origin: FrameStamp,
        mut observed: Observed,
        push: impl FnOnce(Vec<CubeScene>) -> Result<Vec<Reply<T>>, EngineError>,
    ) -> Result<PendingReply<T>, Refusal> {
        observed.warnings.extend(params.table.and_then(|expected| table_warning(&scenes, expected)));
        let preprocessing = self.started.elapsed().saturating_sub(observed.fusion.unwrap_or_default());
        let threshold = params.decode_params(engine.source.decode_params()).threshold;
        Ok(PendingReply { replies: push(scenes)?, params, threshold, preprocessing, observed, origin })
    }

    /// Waits for the session's result, and records the outcome in the log and the metrics.
    pub async fn finish(mut self, pending: Result<PendingReply, Refusal>) -> Result<pb::DetectGraspsResponse, Refusal> {
        let outcome = match pending {
            Ok(pending) => self.reply(pending).await,
            Err(refusal) => Err(refusal),
        };
        self.concluded(outcome)
    }

    /// Waits for the maps of each volume, and records the outcome. The timings are those of the slowest volume.
    pub async fn maps(mut self, replies: Vec<Reply<Tensors>>) -> Result<(Vec<Tensors>, StageTimings), Refusal> {
        let preprocessing = self.started.elapsed();
        let mut maps = Vec::with_capacity(replies.len());
        let mut timings = StageTimings { preprocessing, ..StageTimings::default() };
        for reply in replies {
            let SessionOutput { value, queue, inference, postprocessing, .. } = match reply.wait(self.deadline).await {
                Ok(output) => output,
                Err(error) => return Err(self.end(error.into())),
            };
            maps.push(value);
            if queue + inference >= timings.queue + timings.inference {
                timings = StageTimings { queue, inference, postprocessing, ..timings };
            }
        }
        timings.total = self.started.elapsed();
        self.succeeded(&timings, 0);
        self.recent.add(self.id.clone(), self.label.clone(), Outcome::Inferred(timings));
        self.ended = true;
        Ok((maps, timings))
    }

    /// Ends a call that needs no model, and records the outcome.
    pub fn finish_without_model<T>(mut self, outcome: Result<T, Refusal>) -> Result<T, Refusal> {
        let value = match outcome {
            Ok(value) => value,
            Err(refusal) => return Err(self.end(refusal)),
        };
        self.metrics.ended(&self.label, Code::Ok);
        self.span.in_scope(|| debug!("request succeeded"));
        self.ended = true;
        Ok(value)
    }

    /// Ends the call with its outcome. A success is recorded already.
    fn concluded<T>(mut self, outcome: Result<T, Refusal>) -> Result<T, Refusal> {
        match outcome {
            Ok(response) => {
                self.ended = true;
                Ok(response)
            }
            Err(refusal) => Err(self.end(refusal)),
        }
    }

    /// Ends the call with a refusal.
    pub fn end(mut self, refusal: Refusal) -> Refusal {
        self.refused(&refusal);
        self.ended = true;
        refusal
    }

    pub fn span(&self) -> &Span {
        &self.span
    }

    /// Waits for the session's scores, and records the outcome in the log and the metrics.
    pub async fn finish_scores(
        mut self,
        pending: Result<PendingReply<Vec<Score>>, Refusal>,
    ) -> Result<pb::ScoreGraspsResponse, Refusal> {
        let outcome = match pending {
            Ok(pending) => self.scores(pending).await,
            Err(refusal) => Err(refusal),
        };
        self.concluded(outcome)
    }

    async fn scores(&mut self, pending: PendingReply<Vec<Score>>) -> Result<pb::ScoreGraspsResponse, Refusal> {
        let PendingReply { replies, preprocessing, observed, origin, .. } = pending;
        let Observed { fusion, warnings, table, depth_factors } = observed;
        let (values, stages) = all(replies, self.deadline).await?;
        let total = self.started.elapsed();
        let timings = StageTimings { preprocessing, fusion, total, ..stages };
        self.succeeded(&timings, 0);
        let warnings = self.warned(&warnings);
        self.recent.add(self.id.clone(), self.label.clone(), Outcome::Scored(timings));
        Ok(pb::ScoreGraspsResponse {
            request_id: self.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            scores: values.iter().flatten().map(Into::into).collect(),
            model: std::mem::take(&mut self.name),
            version: std::mem::take(&mut self.version),
            latency: Some((&timings).into()),
            warnings,
            table,
            depth_factors,
        })
    }

    async fn reply(&mut self, pending: PendingReply) -> Result<pb::DetectGraspsResponse, Refusal> {
        let PendingReply { replies, params, threshold, preprocessing, observed, origin } = pending;
        let Observed { fusion, warnings, table, depth_factors } = observed;
        let (cubes, stages) = all(replies, self.deadline).await?;
        let Detection { grasps: found, dropped, over_limit, volumes } = Detection::merged(cubes, &params, threshold);

        let grasps: Vec<_> = found
            .iter()
            .map(|detected| {
                let [pose, pregrasp, retreat] = params.poses(&detected.grasp.pose).map(|pose| Some((&pose).into()));
                pb::Grasp {
                    pose,
                    width: detected.grasp.width,
                    quality: detected.grasp.quality,
                    pregrasp,
                    retreat,
                    collides: detected.collides,
                    object: detected.object.map(u32::from),
                    open_width: detected.open_width,
                }
            })
            .collect();
        // Fits: there is at most one grasp per voxel.
        let over_limit = over_limit as u32;
        let dropped = (params.explain || grasps.is_empty()).then(|| pb::Dropped { over_limit, ..(&dropped).into() });

        let finger_depth = params.hand.map_or(grasp::FINGER_DEPTH, |hand| hand.depth);
        let total = self.started.elapsed();
        let timings = StageTimings { preprocessing, fusion, total, ..stages };
        self.succeeded(&timings, grasps.len());
        let warnings = self.warned(&warnings);
        let messages = warnings.iter().map(|warning| warning.message.clone()).collect();
        let shown = Shown::new(timings, volumes, found, finger_depth, messages);
        self.recent.add(self.id.clone(), self.label.clone(), Outcome::Detected(Box::new(shown)));
        Ok(pb::DetectGraspsResponse {
            request_id: self.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            grasps,
            model: std::mem::take(&mut self.name),
            version: std::mem::take(&mut self.version),
            latency: Some((&timings).into()),
            dropped,
            warnings,
            table,
            depth_factors,
        })
    }

    /// The warnings of the reply, which are logged and counted.
    fn warned(&self, warnings: &[Warning]) -> Vec<pb::GeometryWarning> {
        let warnings: Vec<pb::GeometryWarning> = warnings.iter().map(Into::into).collect();
        for warning in &warnings {
            self.metrics.warned(&self.label, warning.code());
            self.span.in_scope(|| debug!(code = warning.code().as_str_name(), "{}", warning.message));
        }
        warnings
    }

    fn succeeded(&self, timings: &StageTimings, grasps: usize) {
        timings.record(&self.span);
        subscriber::stages(&self.span, timings);
        self.metrics.succeeded(&self.label, timings, grasps);
        self.span.in_scope(|| debug!(grasps, "request succeeded"));
    }

    fn refused(&self, refusal: &Refusal) {
        self.metrics.ended(&self.label, refusal.code());
        if refusal.code() == Code::Internal {
            self.span.record("otel.status_code", "ERROR");
        }
        let outcome = Outcome::Refused { code: refusal.code(), message: refusal.to_string() };
        self.recent.add(self.id.clone(), self.label.clone(), outcome);
        self.span.in_scope(|| info!(code = ?refusal.code(), %refusal, "refused"));
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if !self.ended {
            let expired = self.deadline.is_some_and(Deadline::has_passed);
            let (code, reason) = if expired {
                (Code::DeadlineExceeded, "the deadline has passed")
            } else {
                (Code::Cancelled, "cancelled by the client")
            };
            self.metrics.ended(&self.label, code);
            self.span.in_scope(|| info!(?code, "{reason}"));
        }
    }
}

/// Waits for the results of all cubes. The timings of the sessions are those from the first cube to the last: the cubes
/// are computed in parallel, and one after another.
async fn all<T>(replies: Vec<Reply<T>>, deadline: Option<Deadline>) -> Result<(Vec<T>, StageTimings), EngineError> {
    let mut values = Vec::with_capacity(replies.len());
    // When the first cube was taken from the queue, and the last one had passed each stage.
    let mut taken = Duration::MAX;
    let (mut inferred, mut evaluated, mut decoded) = (Duration::ZERO, None, Duration::ZERO);
    for reply in replies {
        let SessionOutput { value, queue, inference, evaluation, postprocessing } = reply.wait(deadline).await?;
        values.push(value);
        taken = taken.min(queue);
        inferred = inferred.max(queue + inference);
        evaluated = evaluated.max(evaluation.map(|evaluation| queue + inference + evaluation));
        decoded = decoded.max(queue + inference + evaluation.unwrap_or_default() + postprocessing);
    }
    let stages = StageTimings {
        queue: taken,
        inference: inferred.saturating_sub(taken),
        evaluation: evaluated.map(|evaluated| evaluated.saturating_sub(inferred)),
        postprocessing: decoded.saturating_sub(evaluated.unwrap_or(inferred)),
        ..StageTimings::default()
    };
    Ok((values, stages))
}

/// The warning about the table, unless it is as expected in one of the cubes.
fn table_warning(scenes: &[CubeScene], expected: f64) -> Option<Warning> {
    let mut warnings = scenes.iter().map(|scene| Warning::of_table(&scene.scene.volume, expected));
    let first = warnings.next()??;
    warnings.all(|warning| warning.is_some()).then_some(first)
}

/// Ids for requests without one: a random number of the process, then a counter.
struct RequestIds {
    process: u32,
    next: AtomicU64,
}

impl RequestIds {
    fn new() -> Self {
        // The standard library's hashers have random seeds, so no dependency for random numbers is needed.
        Self { process: RandomState::new().hash_one(0) as u32, next: AtomicU64::new(1) }
    }

    fn next(&self) -> String {
        format!("{:08x}-{}", self.process, self.next.fetch_add(1, Ordering::Relaxed))
    }
}
