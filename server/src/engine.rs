use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::{DecodeError, DecodeParams, Decoded, Volume, decode};
use grasp_models::{Backend, Entry, Network, Options, RuntimeError};
use nalgebra::Isometry3;
use prometheus::{Histogram, IntGauge};
use thiserror::Error;
use tokio::sync::oneshot;
use tracing::{Span, error, info};

use crate::deadline::Deadline;
use crate::metrics::Metrics;
use crate::queue::{Batching, Full, Place, Queue};

/// One model: its queue, and what is said of it. The sessions that take from the queue end when the engine is dropped.
pub(crate) struct Engine {
    pub entry: Entry,
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
#[error("the model `{model}` has {waiting} requests waiting, no more are taken; come back in {retry_after:?}")]
pub(crate) struct Overloaded {
    model: String,
    waiting: usize,
    /// When a place in the queue should be free again.
    pub retry_after: Duration,
}

/// What a session made of a volume.
pub(crate) struct Answer {
    pub decoded: Decoded,
    pub queue: Duration,
    pub inference: Duration,
    pub postprocessing: Duration,
}

/// Why a session could not answer.
#[derive(Clone, Debug, Error)]
pub(crate) enum EngineError {
    #[error(transparent)]
    Run(#[from] RuntimeError),
    #[error("the model's output is unusable: {0}")]
    Decode(#[from] DecodeError),
    #[error("the session panicked: {0}")]
    Panic(String),
    #[error("the session is gone")]
    Gone,
    #[error("the deadline has passed before a session was free")]
    Expired,
}

/// What a session's answer comes by. Who drops it has gone, and the volume is not looked at any more.
pub(crate) struct Reply {
    answer: oneshot::Receiver<Result<Answer, EngineError>>,
    /// None if there is no session to wait for.
    _place: Option<Place<Job>>,
}

impl Reply {
    /// Waits for it, but no longer than anybody waits for the reply.
    pub async fn wait(self, deadline: Option<Deadline>) -> Result<Answer, EngineError> {
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
    volume: Volume,
    params: DecodeParams,
    deadline: Option<Deadline>,
    span: Span,
    submitted: Instant,
    reply: oneshot::Sender<Result<Answer, EngineError>>,
}

/// How long the last answer took: when the next place in the queue will be free.
struct Pace(AtomicU64);

impl Engine {
    /// Loads the model's sessions, has each of them answer once, and starts them behind its queue.
    pub fn start(entry: Entry, serving: &Serving, metrics: &Metrics, sessions: &Sessions) -> anyhow::Result<Self> {
        let Serving { workers, options, capacity, batching } = *serving;
        let label = format!("{} {}", entry.metadata.name, entry.metadata.version);
        let started = Instant::now();
        let mut networks = Network::load_several(&entry, &options, workers)?;
        let mut pace = Duration::ZERO;
        for network in &mut networks {
            pace = warm_up(network).with_context(|| format!("the model {label} cannot answer"))?;
        }
        let backend = networks[0].backend();
        let Gauges { waiting, batch } = metrics.gauges(&label);
        let queue = Arc::new(Queue::new(workers, capacity, waiting));
        // From here on it closes its queue when it goes, which is what ends the sessions that have been started.
        let engine = Self { entry, label, backend, queue, pace: Arc::new(Pace::new(pace)) };
        for (worker, network) in networks.into_iter().enumerate() {
            let (queue, pace) = (Arc::clone(&engine.queue), Arc::clone(&engine.pace));
            let session = Session { network, queue, batching, batch: batch.clone(), pace };
            sessions.spawn(format!("{} {worker}", engine.entry.metadata.name), session).with_context(|| {
                format!("cannot start thread {worker} of {workers} for the model {}; lower --workers", engine.label)
            })?;
        }
        let (Backend { provider, precision }, threads, took) = (backend, options.threads, started.elapsed());
        info!(model = engine.label, sha256 = engine.entry.sha256, %provider, %precision, workers, threads, ?took, "loaded");
        Ok(engine)
    }

    /// Queues a volume, or refuses at once.
    pub fn submit(
        &self,
        volume: Volume,
        params: DecodeParams,
        deadline: Option<Deadline>,
        span: Span,
    ) -> Result<Reply, Overloaded> {
        let (reply, answer) = oneshot::channel();
        match self.queue.push(Job { volume, params, deadline, span, submitted: Instant::now(), reply }) {
            Ok(place) => Ok(Reply { answer, _place: Some(place) }),
            // The job has been dropped, which the reply says.
            Err(Full::Closed) => Ok(Reply { answer, _place: None }),
            Err(Full::Waiting(waiting)) => {
                Err(Overloaded { model: self.entry.metadata.name.clone(), waiting, retry_after: self.pace.get() })
            }
        }
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

    /// Waits for the sessions to end, which they do once their engine is dropped.
    pub fn join(&self) {
        let threads = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        for thread in threads {
            // A session catches its panics, and one that did not has nothing left to be waited for.
            let _ = thread.join();
        }
    }
}

/// A thread's own network and its end of the queue.
struct Session {
    network: Network,
    queue: Arc<Queue<Job>>,
    batching: Batching,
    batch: Histogram,
    pace: Arc<Pace>,
}

impl Session {
    fn run(mut self) {
        while let Some(mut jobs) = self.queue.take(self.batching) {
            let now = Instant::now();
            let expired = |job: &mut Job| job.deadline.is_some_and(|Deadline(deadline)| deadline <= now);
            for job in jobs.extract_if(.., expired) {
                // The caller's own timer may have been faster.
                let _ = job.reply.send(Err(EngineError::Expired));
            }
            // Whoever has gone has left the queue, but for those who went this very moment.
            jobs.retain(|job| !job.reply.is_closed());
            if jobs.is_empty() {
                self.queue.free();
            } else {
                self.answer(jobs, now);
            }
        }
    }

    /// Runs the network over the batch, then decodes and answers one after the other.
    fn answer(&mut self, jobs: Vec<Job>, taken: Instant) {
        self.batch.observe(jobs.len() as f64);
        let volumes: Vec<&Volume> = jobs.iter().map(|job| &job.volume).collect();
        let network = &mut self.network;
        let output = caught(|| Ok(network.infer(&volumes)?));
        let inference = taken.elapsed();
        // A place in the queue is free as often as a volume is done.
        self.pace.set(inference / u32::try_from(jobs.len()).unwrap_or(u32::MAX));
        self.queue.free();
        for (index, Job { volume, params, span, submitted, reply, .. }) in jobs.into_iter().enumerate() {
            let started = Instant::now();
            let decoded = match &output {
                Ok(output) => caught(|| Ok(decode(&volume, &output.maps(index), &params)?)),
                Err(error) => Err(error.clone()),
            };
            if let Err(error) = &decoded {
                span.in_scope(|| error!(%error, "the session failed"));
            }
            let queue = taken.duration_since(submitted);
            let postprocessing = started.elapsed();
            // The caller may have gone meanwhile, which is counted on their side.
            let _ = reply.send(decoded.map(|decoded| Answer { decoded, queue, inference, postprocessing }));
        }
    }
}

/// Has a network answer once, and says how long that took: the first inference allocates and tunes, no caller should
/// wait for that.
fn warm_up(network: &mut Network) -> Result<Duration, EngineError> {
    let metadata = network.metadata();
    let values = vec![0.5; metadata.resolution.pow(3)];
    let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
    let params = metadata.decode_params();
    let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a surface");
    let started = Instant::now();
    caught(|| {
        let output = network.infer(&[&volume])?;
        decode(&volume, &output.maps(0), &params)?;
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
