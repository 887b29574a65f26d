use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::Volume;
use grasp_models::{Backend, Options};
use grasp_planner::{Scene, Source};
use grasp_proto::{Candidate, FieldError};
use prometheus::IntCounter;
use thiserror::Error;
use tracing::{Span, info};

use super::cubes::CubeScene;
use super::detection::{Detection, Score};
use super::job::{EngineError, Job, Reply, Sender, Task, Tensors};
use super::queue::{Batching, Queue, Refused, Ticket};
use super::retries::Retries;
use super::session::{ServiceTime, Session};
use super::session_threads::{Running, SessionThreads};
use crate::telemetry::metrics::{Metrics, ModelLabels, QueueMetrics, RefusalCounters};
use crate::transport::deadline::Deadline;

/// One model with its queue. Its session threads end when the engine is dropped.
pub(crate) struct Engine {
    pub source: Source,
    /// `name version`, used in the log and the metrics.
    pub label: String,
    pub backend: Backend,
    workers: usize,
    queue: Arc<Queue<Job>>,
    /// One per session.
    running: Vec<Arc<Running>>,
    service_time: Arc<ServiceTime>,
    retries: Retries,
    refused: RefusalCounters,
    /// Accepted scenes by priority.
    queued: [IntCounter; 2],
}

/// Settings that all engines share.
#[derive(Clone, Copy)]
pub(crate) struct Serving {
    /// Sessions per model.
    pub workers: usize,
    pub options: Options,
    /// Queue length, requests.
    pub capacity: usize,
    pub batching: Batching,
}

/// A request was refused because the server has too many.
#[derive(Clone, Debug, Error)]
#[error("{reason}; retry after {retry_after:?}")]
pub(crate) struct Overloaded {
    reason: String,
    /// Estimated time until a slot is free.
    pub retry_after: Duration,
}

impl Engine {
    /// Loads and warms up the sessions, and starts their threads.
    pub fn start(
        source: Source,
        serving: &Serving,
        metrics: &Metrics,
        sessions: &SessionThreads,
    ) -> anyhow::Result<Self> {
        let Serving { workers, options, capacity, batching } = *serving;
        let label = format!("{} {}", source.name(), source.version());
        let started = Instant::now();
        let (planners, backend) = source.load(&options, workers)?;
        let QueueMetrics { waiting, batch, refused, queued, hanging } = metrics.queue(&label);
        let queue = Arc::new(Queue::new(workers, capacity, waiting));
        // Created before the threads, so that an early return drops it, which closes the queue and ends started
        // threads.
        let service_time = Arc::new(ServiceTime::new(Duration::ZERO));
        let retries = Retries::default();
        let running: Vec<_> = planners.iter().map(|_| Arc::new(Running::new(hanging.clone()))).collect();
        let engine = Self { source, label, backend, workers, queue, running, service_time, retries, refused, queued };
        for (worker, planner) in planners.into_iter().enumerate() {
            let (queue, service_time) = (Arc::clone(&engine.queue), Arc::clone(&engine.service_time));
            let defaults = engine.source.decode_params();
            let (running, batch) = (Arc::clone(&engine.running[worker]), batch.clone());
            let (warmed_up, warm_up) = mpsc::sync_channel(1);
            let session = Session { planner, defaults, queue, batching, batch, running, service_time, warmed_up };
            let name = format!("{} {worker}", engine.source.name());
            sessions.spawn(name, session, &engine.running, worker).with_context(|| {
                format!("cannot start thread {worker} of {workers} for the model {}; lower --workers", engine.label)
            })?;
            // One session after another, because others must not allocate memory while one records its CUDA graphs.
            let time = warm_up.recv().map_err(|_| EngineError::Panic("the session ended".to_owned())).flatten();
            let failed = || format!("the warm-up inference of the model {} failed", engine.label);
            engine.service_time.start_with(time.with_context(failed)?);
        }
        let (Backend { provider, precision, cuda_graph }, threads, duration) =
            (backend, options.threads, started.elapsed());
        info!(
            model = engine.label,
            sha256 = engine.source.sha256(),
            %provider,
            %precision,
            cuda_graph,
            workers,
            threads,
            took = ?duration,
            "model loaded"
        );
        Ok(engine)
    }

    /// Queues the scenes of a request for grasp detection. Refuses all of them immediately if the queue is full.
    pub fn detect(
        &self,
        scenes: Vec<CubeScene>,
        ticket: Ticket,
        span: &Span,
    ) -> Result<Vec<Reply<Detection>>, EngineError> {
        let scenes = scenes.into_iter().map(|CubeScene { scene, params }| (scene, Box::new(params)));
        self.push(scenes, Task::Grasps, ticket, span)
    }

    /// Queues the scenes of a request, whose candidates are to be scored. Refuses all of them immediately if the queue is
    /// full.
    pub fn score(
        &self,
        scenes: Vec<CubeScene>,
        candidates: &[Candidate],
        ticket: Ticket,
        span: &Span,
    ) -> Result<Vec<Reply<Vec<Score>>>, EngineError> {
        let scenes = scenes.into_iter().map(|CubeScene { scene, params }| (scene, Box::new(params)));
        self.push(scenes, |params, sender| Task::Scores(params, candidates.to_vec(), sender), ticket, span)
    }

    /// Queues the volumes of a request for the network's raw output. Refuses all of them immediately if the queue is full.
    pub fn maps(&self, volumes: Vec<Volume>, ticket: Ticket, span: &Span) -> Result<Vec<Reply<Tensors>>, EngineError> {
        let scenes = volumes.into_iter().map(|volume| (Scene { volume, points: None }, ()));
        self.push(scenes, |(), sender| Task::Maps(sender), ticket, span)
    }

    /// The labels of the served model in the metrics.
    pub fn labels(&self) -> ModelLabels {
        let Backend { provider, precision, .. } = self.backend;
        ModelLabels([self.label.clone(), provider.to_string(), precision.to_string(), self.source.sha256().to_owned()])
    }

    /// Whether a session neither hangs in an inference nor fails each one.
    pub fn is_able(&self) -> bool {
        self.running.iter().any(|session| session.is_able())
    }

    /// Whether every session hangs in an inference.
    fn is_hanging(&self) -> bool {
        self.running.iter().all(|session| session.is_hanging())
    }

    /// When the latest inference ended, milliseconds since 1970; 0 if there was none.
    pub fn latest_inference(&self) -> u64 {
        self.running.iter().map(|session| session.latest()).max().unwrap_or(0)
    }

    /// Queue length, requests.
    pub fn capacity(&self) -> usize {
        self.queue.capacity()
    }

    /// Checks that the cubes of one workspace fit into an empty queue.
    pub fn check_cubes(&self, cubes: usize) -> Result<(), FieldError> {
        let places = self.capacity() + self.workers;
        if cubes <= places {
            return Ok(());
        }
        let value = format_args!("a workspace of {cubes} cubes with objects");
        let needed = format_args!("must have at most {places}, the places of the model's queue (--queue)");
        Err(FieldError::new("workspace.extent", value, needed))
    }

    /// Refuses a request with this number of scenes that the queue would refuse now, before the caller converts and fuses
    /// data.
    pub fn check_capacity(&self, scenes: usize, ticket: Ticket) -> Result<(), EngineError> {
        if self.is_hanging() {
            return Err(EngineError::NoSession);
        }
        let checked = self.queue.check(scenes, ticket, self.service_time.get());
        checked.map_err(|refused| self.refused(&refused, scenes).into())
    }

    /// Queues the scenes of a request. `task` says what to compute from one of them, for the receiver of its result.
    fn push<P, T: Send + 'static>(
        &self,
        scenes: impl Iterator<Item = (Scene, P)>,
        task: impl Fn(P, Sender<T>) -> Task,
        ticket: Ticket,
        span: &Span,
    ) -> Result<Vec<Reply<T>>, EngineError> {
        if self.is_hanging() {
            return Err(EngineError::NoSession);
        }
        let deadline = ticket.deadline.map(Deadline);
        let job = |(scene, params)| {
            let (sender, receiver) = Sender::new();
            let task = task(params, sender);
            (Job { scene, task, deadline, span: span.clone(), submitted: Instant::now() }, receiver)
        };
        let (jobs, receivers): (Vec<_>, Vec<_>) = scenes.map(job).unzip();
        // The queue is open: only dropping the engine closes it.
        let pushed = self.queue.push(jobs, ticket, self.service_time.get());
        let (slots, displaced) = pushed.map_err(|refused| self.refused(&refused, receivers.len()))?;
        self.queued[ticket.priority as usize].inc_by(slots.len() as u64);
        displaced.into_iter().for_each(|job| job.task.fail(self.displaced(self.queue_is_full(1)).into()));
        Ok(receivers.into_iter().zip(slots).map(|(receiver, slot)| Reply::new(receiver, slot)).collect())
    }

    /// The refusal of a request with this number of scenes.
    fn refused(&self, refused: &Refused, scenes: usize) -> Overloaded {
        match refused {
            Refused::Full => self.full(self.queue_is_full(scenes)),
            Refused::TooLate(estimate) => self.too_late(*estimate),
        }
    }

    fn queue_is_full(&self, scenes: usize) -> String {
        let (name, capacity) = (self.source.name(), self.capacity());
        match scenes {
            1 => format!("the queue of the model `{name}` is full ({capacity} requests)"),
            _ => format!("the queue of the model `{name}` has too few free places for {scenes} scenes (of {capacity})"),
        }
    }

    /// The refusal of a request for which there is no place, for this reason.
    pub fn full(&self, reason: String) -> Overloaded {
        self.refused.full.inc();
        self.overloaded(reason)
    }

    fn too_late(&self, estimate: Duration) -> Overloaded {
        self.refused.too_late.inc();
        let (name, waiting) = (self.source.name(), self.queue.waiting());
        self.overloaded(format!(
            "the deadline is earlier than the reply: {waiting} requests wait for the model `{name}`, the reply would \
             take about {estimate:.0?}"
        ))
    }

    /// The refusal of a request whose place another one has taken, because there are no others for this reason.
    pub fn displaced(&self, reason: String) -> Overloaded {
        self.refused.displaced.inc();
        self.overloaded(format!(
            "{reason}, and a request of a caller with fewer of them, or with a higher priority, has taken this one's place"
        ))
    }

    /// A refusal with a hint when to retry.
    pub fn overloaded(&self, reason: String) -> Overloaded {
        let pace = self.service_time.get().mean / u32::try_from(self.workers).unwrap_or(u32::MAX);
        let places = u32::try_from(self.capacity() + self.workers).unwrap_or(u32::MAX);
        Overloaded { reason, retry_after: self.retries.next(pace, places, Instant::now()) }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.queue.close();
    }
}
