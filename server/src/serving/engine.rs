use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::{DecodeError, Dropped, Grasp, Volume};
use grasp_models::{Backend, Options, RuntimeError};
use grasp_planner::{Loaded, PlanError, Scene, Source};
use grasp_proto::DetectParams;
use prometheus::{Histogram, IntGauge};
use thiserror::Error;
use tokio::sync::oneshot;
use tracing::{Span, info, warn};

use super::session::{Session, warm_up};
use crate::serving::queue::{Batching, Full, Queue, QueueSlot};
use crate::telemetry::metrics::Metrics;
use crate::transport::deadline::Deadline;

/// One planner: its queue, and what is said of it. The sessions that take from the queue end when the engine is dropped.
pub(crate) struct Engine {
    pub source: Source,
    /// `name version`, as the log and the metrics have it.
    pub label: String,
    /// What runs it.
    pub backend: Backend,
    queue: Arc<Queue<Job>>,
    service_time: Arc<ServiceTime>,
}

/// How a model's requests are served.
#[derive(Clone, Copy)]
pub(crate) struct Serving {
    /// Sessions.
    pub workers: usize,
    /// How each runs the model.
    pub options: Options,
    /// Requests that may wait.
    pub capacity: usize,
    /// How many a session takes at once.
    pub batching: Batching,
}

/// What is measured of a model's queue.
pub(crate) struct Gauges {
    /// Requests that wait.
    pub waiting: IntGauge,
    /// Volumes in a batch.
    pub batch: Histogram,
}

/// The threads of every engine's sessions.
#[derive(Default)]
pub(crate) struct SessionThreads(Mutex<Vec<JoinHandle<()>>>);

/// Why a volume was not taken.
#[derive(Debug, Error)]
#[error("{what}, no more are taken; come back in {retry_after:?}")]
pub(crate) struct Overloaded {
    /// What there is as much of as may be.
    what: String,
    /// When a place in the queue should be free again.
    pub retry_after: Duration,
}

/// What a session made of a scene.
pub(crate) struct SessionOutput<T> {
    pub made: T,
    pub queue: Duration,
    pub inference: Duration,
    pub postprocessing: Duration,
}

/// The grasps in a scene.
pub(crate) struct Detection {
    /// Best first, as many as were asked for.
    pub grasps: Vec<Grasp>,
    /// Whether the hand would meet something at each of them, where that was asked.
    pub collides: Option<Vec<bool>>,
    /// Why there are no others.
    pub dropped: Dropped,
    /// How many more there are.
    pub over_limit: usize,
    /// What was looked at.
    pub volume: Volume,
}

/// A network's [`OUTPUTS`](grasp_models::OUTPUTS), as bytes: f32, little-endian.
pub(crate) struct Tensors(pub [Vec<u8>; 3]);

/// Why a session could not answer.
#[derive(Clone, Debug, Error)]
pub(crate) enum EngineError {
    #[error(transparent)]
    Run(#[from] RuntimeError),
    #[error(transparent)]
    Decode(#[from] DecodeError),
    #[error("the session panicked: {0}")]
    Panic(String),
    #[error("this planner has no network whose output could be told")]
    NoNetwork,
    #[error("the session is gone")]
    Gone,
    #[error("the deadline has passed before the answer was ready")]
    Expired,
}

impl From<PlanError> for EngineError {
    fn from(error: PlanError) -> Self {
        match error {
            PlanError::Run(error) => error.into(),
            PlanError::Decode(error) => error.into(),
            // A session asks for as long as the deadline has not passed and the caller waits.
            PlanError::Cancelled => Self::Expired,
        }
    }
}

/// What a session's answer comes by. Who drops it has gone, and the volume is not looked at any more.
pub(crate) struct Reply<T> {
    answer: Receiver<T>,
    _slot: QueueSlot<Job>,
}

pub(super) type Sender<T> = oneshot::Sender<Result<SessionOutput<T>, EngineError>>;
type Receiver<T> = oneshot::Receiver<Result<SessionOutput<T>, EngineError>>;

impl<T> Reply<T> {
    /// Waits for it, but no longer than anybody waits for the reply.
    pub async fn wait(self, deadline: Option<Deadline>) -> Result<SessionOutput<T>, EngineError> {
        let Self { answer, _slot } = self;
        let answer = match deadline {
            None => answer.await,
            Some(Deadline(deadline)) => {
                let waited = tokio::time::timeout_at(deadline.into(), answer).await;
                waited.map_err(|_| EngineError::Expired)?
            }
        };
        // A session that is gone drops what it had: that is told, too.
        answer.unwrap_or(Err(EngineError::Gone))
    }
}

pub(super) struct Job {
    pub scene: Scene,
    pub task: Task,
    pub deadline: Option<Deadline>,
    pub span: Span,
    pub submitted: Instant,
}

/// What is to be made of a scene.
pub(super) enum Task {
    Grasps(Box<DetectParams>, Sender<Detection>),
    /// The network's own output.
    Maps(Sender<Tensors>),
}

impl Task {
    pub fn is_closed(&self) -> bool {
        match self {
            Self::Grasps(_, reply) => reply.is_closed(),
            Self::Maps(reply) => reply.is_closed(),
        }
    }

    /// Whoever asked may have gone meanwhile, which is counted on their side.
    pub fn fail(self, error: EngineError) {
        match self {
            Self::Grasps(_, reply) => drop(reply.send(Err(error))),
            Self::Maps(reply) => drop(reply.send(Err(error))),
        }
    }
}

/// How long the last answer took: when the next place in the queue will be free.
pub(super) struct ServiceTime(AtomicU64);

impl Engine {
    /// Loads the planner's sessions, has each of them answer once, and starts them behind its queue.
    pub fn start(
        source: Source,
        serving: &Serving,
        metrics: &Metrics,
        sessions: &SessionThreads,
    ) -> anyhow::Result<Self> {
        let Serving { workers, options, capacity, batching } = *serving;
        let label = format!("{} {}", source.name(), source.version());
        let started = Instant::now();
        let (mut planners, backend) = source.load(&options, workers)?;
        let mut service_time = Duration::ZERO;
        for planner in &mut planners {
            if let Loaded::Network(network) = planner {
                service_time =
                    warm_up(network, batching.max).with_context(|| format!("the model {label} cannot answer"))?;
            }
        }
        let Gauges { waiting, batch } = metrics.gauges(&label);
        let queue = Arc::new(Queue::new(workers, capacity, waiting));
        // From here on it closes its queue when it goes, which is what ends the sessions that have been started.
        let engine = Self { source, label, backend, queue, service_time: Arc::new(ServiceTime::new(service_time)) };
        for (worker, planner) in planners.into_iter().enumerate() {
            let (queue, service_time) = (Arc::clone(&engine.queue), Arc::clone(&engine.service_time));
            let own = engine.source.decode_params();
            let session = Session { planner, own, queue, batching, batch: batch.clone(), service_time };
            sessions.spawn(format!("{} {worker}", engine.source.name()), session).with_context(|| {
                format!("cannot start thread {worker} of {workers} for the model {}; lower --workers", engine.label)
            })?;
        }
        let (Backend { provider, precision }, threads, took) = (backend, options.threads, started.elapsed());
        info!(model = engine.label, sha256 = engine.source.sha256(), %provider, %precision, workers, threads, ?took, "loaded");
        Ok(engine)
    }

    /// Queues a scene to look for grasps in it, or refuses at once.
    pub fn detect(
        &self,
        scene: Scene,
        params: DetectParams,
        deadline: Option<Deadline>,
        span: Span,
    ) -> Result<Reply<Detection>, Overloaded> {
        let (reply, answer) = oneshot::channel();
        let slot = self.push(scene, Task::Grasps(Box::new(params), reply), deadline, span)?;
        Ok(Reply { answer, _slot: slot })
    }

    /// Queues a volume to have a network's own output, or refuses at once.
    pub fn maps(&self, volume: Volume, deadline: Option<Deadline>, span: Span) -> Result<Reply<Tensors>, Overloaded> {
        let (reply, answer) = oneshot::channel();
        let slot = self.push(Scene { volume, points: None }, Task::Maps(reply), deadline, span)?;
        Ok(Reply { answer, _slot: slot })
    }

    /// The most scenes that wait.
    pub fn capacity(&self) -> usize {
        self.queue.capacity()
    }

    /// Refuses where there is no place at this moment, so that nothing is prepared in vain.
    pub fn check_place(&self) -> Result<(), Overloaded> {
        if self.queue.is_full() { Err(self.full()) } else { Ok(()) }
    }

    fn push(
        &self,
        scene: Scene,
        task: Task,
        deadline: Option<Deadline>,
        span: Span,
    ) -> Result<QueueSlot<Job>, Overloaded> {
        // The queue is closed only when the engine goes.
        let job = Job { scene, task, deadline, span, submitted: Instant::now() };
        self.queue.push(job).map_err(|Full| self.full())
    }

    fn full(&self) -> Overloaded {
        self.overloaded(format!("the model `{}` has {} requests waiting", self.source.name(), self.capacity()))
    }

    /// Refuses what there is no place for, here or on the way: when there may be one, its service_time says.
    pub fn overloaded(&self, what: String) -> Overloaded {
        Overloaded { what, retry_after: self.service_time.get() }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.queue.close();
    }
}

impl SessionThreads {
    fn spawn(&self, name: String, session: Session) -> io::Result<()> {
        let thread = thread::Builder::new().name(name).spawn(move || session.run())?;
        let mut threads = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        threads.retain(|thread| !thread.is_finished());
        threads.push(thread);
        Ok(())
    }

    /// Waits for the sessions to end, which they do once their engine is dropped and they have answered what they have, but
    /// no longer than this.
    pub fn join(&self, patience: Duration) {
        let until = Instant::now() + patience;
        let threads = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        for thread in threads {
            while !thread.is_finished() && Instant::now() < until {
                thread::sleep(Duration::from_millis(1));
            }
            if !thread.is_finished() {
                warn!(session = thread.thread().name(), "is still computing, and left behind");
                continue;
            }
            // A session catches its panics, and one that did not has nothing left to be waited for.
            let _ = thread.join();
        }
    }
}

impl ServiceTime {
    fn new(duration: Duration) -> Self {
        let service_time = Self(AtomicU64::new(0));
        service_time.set(duration);
        service_time
    }

    pub fn set(&self, duration: Duration) {
        self.0.store(duration.as_micros().try_into().unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// At least a millisecond, the unit in which clients are told.
    fn get(&self) -> Duration {
        Duration::from_micros(self.0.load(Ordering::Relaxed)).max(Duration::from_millis(1))
    }
}
