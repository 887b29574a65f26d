use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::{DecodeError, DecodeParams, Decoded, Dropped, Grasp, Obstacles, Volume, decode};
use grasp_models::{Backend, Options, Output, RuntimeError, batch_sizes};
use grasp_planner::{Loaded, NetworkPlanner, PlanError, PlanParams, Planner, Scene, Source};
use grasp_proto::{Asked, Collision};
use nalgebra::Isometry3;
use prometheus::{Histogram, IntGauge};
use thiserror::Error;
use tokio::sync::oneshot;
use tracing::{Span, error, info, warn};

use crate::deadline::Deadline;
use crate::metrics::Metrics;
use crate::queue::{Batching, Full, Place, Queue};

/// One planner: its queue, and what is said of it. The sessions that take from the queue end when the engine is dropped.
pub(crate) struct Engine {
    pub source: Source,
    /// `name version`, as the log and the metrics have it.
    pub label: String,
    /// What runs it.
    pub backend: Backend,
    queue: Arc<Queue<Job>>,
    pace: Arc<Pace>,
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
pub(crate) struct Sessions(Mutex<Vec<JoinHandle<()>>>);

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
pub(crate) struct Answer<T> {
    pub made: T,
    pub queue: Duration,
    pub inference: Duration,
    pub postprocessing: Duration,
}

/// The grasps in a scene.
pub(crate) struct Found {
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
    _place: Place<Job>,
}

type Sender<T> = oneshot::Sender<Result<Answer<T>, EngineError>>;
type Receiver<T> = oneshot::Receiver<Result<Answer<T>, EngineError>>;

impl<T> Reply<T> {
    /// Waits for it, but no longer than anybody waits for the reply.
    pub async fn wait(self, deadline: Option<Deadline>) -> Result<Answer<T>, EngineError> {
        let Self { answer, _place } = self;
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

struct Job {
    scene: Scene,
    task: Task,
    deadline: Option<Deadline>,
    span: Span,
    submitted: Instant,
}

/// What is to be made of a scene.
enum Task {
    Grasps(Box<Asked>, Sender<Found>),
    /// The network's own output.
    Maps(Sender<Tensors>),
}

impl Task {
    fn is_closed(&self) -> bool {
        match self {
            Self::Grasps(_, reply) => reply.is_closed(),
            Self::Maps(reply) => reply.is_closed(),
        }
    }

    /// Whoever asked may have gone meanwhile, which is counted on their side.
    fn fail(self, error: EngineError) {
        match self {
            Self::Grasps(_, reply) => drop(reply.send(Err(error))),
            Self::Maps(reply) => drop(reply.send(Err(error))),
        }
    }
}

/// How long the last answer took: when the next place in the queue will be free.
struct Pace(AtomicU64);

impl Engine {
    /// Loads the planner's sessions, has each of them answer once, and starts them behind its queue.
    pub fn start(source: Source, serving: &Serving, metrics: &Metrics, sessions: &Sessions) -> anyhow::Result<Self> {
        let Serving { workers, options, capacity, batching } = *serving;
        let label = format!("{} {}", source.name(), source.version());
        let started = Instant::now();
        let (mut planners, backend) = source.load(&options, workers)?;
        let mut pace = Duration::ZERO;
        for planner in &mut planners {
            if let Loaded::Network(network) = planner {
                pace = warm_up(network, batching.max).with_context(|| format!("the model {label} cannot answer"))?;
            }
        }
        let Gauges { waiting, batch } = metrics.gauges(&label);
        let queue = Arc::new(Queue::new(workers, capacity, waiting));
        // From here on it closes its queue when it goes, which is what ends the sessions that have been started.
        let engine = Self { source, label, backend, queue, pace: Arc::new(Pace::new(pace)) };
        for (worker, planner) in planners.into_iter().enumerate() {
            let (queue, pace) = (Arc::clone(&engine.queue), Arc::clone(&engine.pace));
            let own = engine.source.decode_params();
            let session = Session { planner, own, queue, batching, batch: batch.clone(), pace };
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
        asked: Asked,
        deadline: Option<Deadline>,
        span: Span,
    ) -> Result<Reply<Found>, Overloaded> {
        let (reply, answer) = oneshot::channel();
        let place = self.push(scene, Task::Grasps(Box::new(asked), reply), deadline, span)?;
        Ok(Reply { answer, _place: place })
    }

    /// Queues a volume to have a network's own output, or refuses at once.
    pub fn maps(&self, volume: Volume, deadline: Option<Deadline>, span: Span) -> Result<Reply<Tensors>, Overloaded> {
        let (reply, answer) = oneshot::channel();
        let place = self.push(Scene { volume, points: None }, Task::Maps(reply), deadline, span)?;
        Ok(Reply { answer, _place: place })
    }

    /// The most scenes that wait.
    pub fn capacity(&self) -> usize {
        self.queue.capacity()
    }

    /// Refuses where there is no place at this moment, so that nothing is prepared in vain.
    pub fn check_place(&self) -> Result<(), Overloaded> {
        if self.queue.is_full() { Err(self.full()) } else { Ok(()) }
    }

    fn push(&self, scene: Scene, task: Task, deadline: Option<Deadline>, span: Span) -> Result<Place<Job>, Overloaded> {
        // The queue is closed only when the engine goes.
        let job = Job { scene, task, deadline, span, submitted: Instant::now() };
        self.queue.push(job).map_err(|Full| self.full())
    }

    fn full(&self) -> Overloaded {
        self.overloaded(format!("the model `{}` has {} requests waiting", self.source.name(), self.capacity()))
    }

    /// Refuses what there is no place for, here or on the way: when there may be one, its pace says.
    pub fn overloaded(&self, what: String) -> Overloaded {
        Overloaded { what, retry_after: self.pace.get() }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.queue.close();
    }
}

impl Sessions {
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

/// A thread's own planner and its end of the queue.
struct Session {
    planner: Loaded,
    /// How its grasps are chosen, unless a request says otherwise.
    own: DecodeParams,
    queue: Arc<Queue<Job>>,
    batching: Batching,
    batch: Histogram,
    pace: Arc<Pace>,
}

/// When a session took its jobs, and how long the work on all of them took.
#[derive(Clone, Copy)]
struct Taken {
    at: Instant,
    inference: Duration,
}

impl Session {
    fn run(mut self) {
        let alone = Batching { max: 1, delay: Duration::ZERO };
        let batching = if matches!(self.planner, Loaded::Single(_)) { alone } else { self.batching };
        while let Some(mut jobs) = self.queue.take(batching) {
            let now = Instant::now();
            let expired = |job: &mut Job| job.deadline.is_some_and(|Deadline(deadline)| deadline <= now);
            for job in jobs.extract_if(.., expired) {
                // The caller's own timer may have been faster.
                job.task.fail(EngineError::Expired);
            }
            // Whoever has gone has left the queue, but for those who went this very moment.
            jobs.retain(|job| !job.task.is_closed());
            if jobs.is_empty() {
                self.queue.free();
                continue;
            }
            self.batch.observe(jobs.len() as f64);
            let Self { planner, own, queue, pace, .. } = &mut self;
            let scenes = u32::try_from(jobs.len()).unwrap_or(u32::MAX);
            let done = |inference: Duration| {
                queue.free();
                Taken { at: now, inference }
            };
            match planner {
                Loaded::Network(network) => infer(network, *own, jobs, done),
                // One at a time: there is nothing to share.
                Loaded::Single(planner) => {
                    if let Some(job) = jobs.pop() {
                        plan(planner.as_mut(), *own, job, done);
                    }
                }
            }
            // A place in the queue is free as often as a scene is done, with all that belongs to it.
            pace.set(now.elapsed() / scenes);
        }
    }
}

/// Runs the network over the batch, then makes of each output what is asked for.
fn infer(network: &mut NetworkPlanner, own: DecodeParams, jobs: Vec<Job>, done: impl FnOnce(Duration) -> Taken) {
    let started = Instant::now();
    let volumes: Vec<&Volume> = jobs.iter().map(|job| &job.scene.volume).collect();
    let output = caught(|| Ok(network.infer(&volumes)?));
    let taken = done(started.elapsed());
    for (index, Job { scene, task, deadline, span, submitted }) in jobs.into_iter().enumerate() {
        let _entered = span.enter();
        if task.is_closed() || deadline.is_some_and(Deadline::has_passed) {
            // Those behind it in the batch need not wait for what nobody does.
            task.fail(EngineError::Expired);
            continue;
        }
        let output = match &output {
            Ok(output) => output,
            Err(error) => {
                error!(%error, "the session failed");
                task.fail(error.clone());
                continue;
            }
        };
        match task {
            Task::Grasps(asked, reply) => answer(reply, submitted, taken, || {
                let decoded = decode(&scene.volume, &output.maps(index), &asked.decode_params(own))?;
                Ok(found(decoded, scene.volume, &asked))
            }),
            Task::Maps(reply) => answer(reply, submitted, taken, || Ok(tensors(output, index))),
        }
    }
}

/// Has a planner without a network look at a scene.
fn plan(planner: &mut dyn Planner, own: DecodeParams, job: Job, done: impl FnOnce(Duration) -> Taken) {
    let Job { scene, task, deadline, span, submitted } = job;
    let _entered = span.enter();
    match task {
        Task::Grasps(asked, reply) => {
            let started = Instant::now();
            let wanted = || !reply.is_closed() && !deadline.is_some_and(Deadline::has_passed);
            let decoded = caught(|| {
                let params = PlanParams { decode: asked.decode_params(own), table: asked.table };
                Ok(planner.plan(&scene, &params, &wanted)?)
            });
            let taken = done(started.elapsed());
            answer(reply, submitted, taken, || Ok(found(decoded?, scene.volume, &asked)));
        }
        Task::Maps(_) => {
            done(Duration::ZERO);
            task.fail(EngineError::NoNetwork);
        }
    }
}

/// Makes something and sends it to who asked for it.
fn answer<T>(reply: Sender<T>, submitted: Instant, taken: Taken, make: impl FnOnce() -> Result<T, EngineError>) {
    let started = Instant::now();
    let made = caught(make);
    // Nobody waits for what came too late.
    if let Err(error) = &made
        && !matches!(error, EngineError::Expired)
    {
        error!(%error, "the session failed");
    }
    let Taken { at, inference } = taken;
    let (queue, postprocessing) = (at.duration_since(submitted), started.elapsed());
    // The caller may have gone meanwhile, which is counted on their side.
    let _ = reply.send(made.map(|made| Answer { made, queue, inference, postprocessing }));
}

/// As many of the grasps as were asked for, and whether the hand would meet something there.
fn found(decoded: Decoded, volume: Volume, asked: &Asked) -> Found {
    let Decoded { mut grasps, dropped } = decoded;
    let over_limit = grasps.len().saturating_sub(asked.max_grasps);
    grasps.truncate(asked.max_grasps);
    let collides = (asked.collision == Collision::Flag).then(|| {
        let obstacles = Obstacles::observed(&volume, asked.clearance());
        grasps.iter().map(|grasp| obstacles.meet(&grasp.pose)).collect()
    });
    Found { grasps, collides, dropped, over_limit, volume }
}

fn tensors(output: &Output, index: usize) -> Tensors {
    let maps = output.maps(index);
    Tensors(
        [maps.quality, maps.rotation, maps.width].map(|map| map.iter().flat_map(|value| value.to_le_bytes()).collect()),
    )
}

/// Has a network answer a batch of each size, and says how long a single volume takes: the first inference of a size
/// allocates and tunes, no caller should wait for that.
fn warm_up(network: &mut NetworkPlanner, max_batch: usize) -> Result<Duration, EngineError> {
    let metadata = network.network().metadata();
    let values = vec![0.5; metadata.resolution.pow(3)];
    let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
    let resolution = metadata.resolution;
    let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a surface");
    caught(|| {
        for size in batch_sizes(max_batch) {
            let output = network.infer(&vec![&volume; size])?;
            (0..size).try_for_each(|index| output.maps(index).check(resolution))?;
        }
        let started = Instant::now();
        network.infer(&[&volume])?;
        Ok(started.elapsed())
    })
}

impl Pace {
    fn new(duration: Duration) -> Self {
        let pace = Self(AtomicU64::new(0));
        pace.set(duration);
        pace
    }

    fn set(&self, duration: Duration) {
        self.0.store(duration.as_micros().try_into().unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// At least a millisecond, the unit in which clients are told.
    fn get(&self) -> Duration {
        Duration::from_micros(self.0.load(Ordering::Relaxed)).max(Duration::from_millis(1))
    }
}

/// Turns a panic into an error of the one request that it happened in. The network's buffers are written anew for each
/// volume, so what the panic leaves in them does no harm.
fn caught<T>(work: impl FnOnce() -> Result<T, EngineError>) -> Result<T, EngineError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Err(EngineError::Panic(text.unwrap_or("without a message").to_owned()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error_with_its_message() {
        let message = |work: fn() -> Result<(), EngineError>| caught(work).unwrap_err().to_string();
        assert_eq!(message(|| panic!("index {} of {}", 5, 4)), "the session panicked: index 5 of 4");
        assert_eq!(message(|| panic!("plain")), "the session panicked: plain");
        assert_eq!(message(|| std::panic::panic_any(7)), "the session panicked: without a message");
        assert!(caught(|| Ok(())).is_ok());
    }
}
