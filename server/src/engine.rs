use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::{DecodeError, DecodeParams, Decoded, Volume, decode};
use grasp_models::{Backend, Entry, Network, Options, RuntimeError};
use nalgebra::Isometry3;
use prometheus::IntGauge;
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tracing::{Span, error, info};

/// One model: its queue, and what is said of it. The sessions that take from the queue end when the engine is dropped.
pub(crate) struct Engine {
    pub entry: Entry,
    /// `name version`, as the log and the metrics have it.
    pub label: String,
    /// What runs it.
    pub backend: Backend,
    queue: SyncSender<Job>,
    /// One for each request that may run or wait. Counting the queue alone would refuse a request for which a session
    /// is free but has not woken up yet.
    places: Arc<Semaphore>,
    capacity: usize,
    waiting: IntGauge,
    pace: Arc<Pace>,
}

/// The threads of every engine's sessions.
pub(crate) struct Sessions {
    threads: Vec<JoinHandle<()>>,
    warm: mpsc::Receiver<Result<(), EngineError>>,
    /// Held for the sessions that are still to be started.
    report: mpsc::Sender<Result<(), EngineError>>,
}

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
#[derive(Debug, Error)]
pub(crate) enum EngineError {
    #[error(transparent)]
    Run(#[from] RuntimeError),
    #[error("the model's output is unusable: {0}")]
    Decode(#[from] DecodeError),
    #[error("the session panicked: {0}")]
    Panic(String),
    #[error("the session is gone")]
    Gone,
}

pub(crate) type Reply = oneshot::Receiver<Result<Answer, EngineError>>;

struct Job {
    volume: Volume,
    params: DecodeParams,
    span: Span,
    submitted: Instant,
    place: OwnedSemaphorePermit,
    reply: oneshot::Sender<Result<Answer, EngineError>>,
}

/// How long the last answer took: when the next place in the queue will be free.
struct Pace(AtomicU64);

impl Engine {
    /// Loads `workers` sessions and starts them behind a queue of `capacity`.
    pub fn start(
        entry: Entry,
        workers: usize,
        options: &Options,
        capacity: usize,
        waiting: impl FnOnce(&str) -> IntGauge,
        sessions: &mut Sessions,
    ) -> anyhow::Result<Self> {
        let label = format!("{} {}", entry.metadata.name, entry.metadata.version);
        let waiting = waiting(&label);
        let pace = Arc::new(Pace(AtomicU64::new(0)));
        let places = capacity + workers;
        let (queue, jobs) = sync_channel(places);
        let places = Arc::new(Semaphore::new(places));
        let jobs = Arc::new(Mutex::new(jobs));
        // The first finds out what can run the model; the others are run by the same.
        let first = Network::load(&entry.path, options)?;
        let (backend, threads) = (first.backend(), options.threads);
        let mut loaded = Some(first);
        for worker in 0..workers {
            let session = Session {
                network: loaded.take().map_or_else(|| Network::load_with(&entry.path, backend, threads), Ok)?,
                jobs: Arc::clone(&jobs),
                waiting: waiting.clone(),
                pace: Arc::clone(&pace),
            };
            sessions.spawn(format!("{} {worker}", entry.metadata.name), session).with_context(|| {
                format!("cannot start thread {worker} of {workers} for the model {label}; lower --workers")
            })?;
        }
        let Backend { provider, precision } = backend;
        info!(model = label, sha256 = entry.sha256, %provider, %precision, workers, threads, "loaded");
        Ok(Self { entry, label, backend, queue, places, capacity, waiting, pace })
    }

    /// Queues a volume, or refuses at once. A caller that drops the reply has gone: its job is skipped.
    pub fn submit(&self, volume: Volume, params: DecodeParams, span: Span) -> Result<Reply, Overloaded> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| Overloaded {
            model: self.entry.metadata.name.clone(),
            waiting: self.capacity,
            retry_after: self.pace.get(),
        })?;
        let (reply, answer) = oneshot::channel();
        // Before the session can take it, or the gauge could fall below 0.
        self.waiting.inc();
        let job = Job { volume, params, span, submitted: Instant::now(), place, reply };
        if self.queue.try_send(job).is_err() {
            // Who has a place has room in the queue, so the sessions are gone: the reply says so, for the job is dropped.
            self.waiting.dec();
        }
        Ok(answer)
    }
}

impl Sessions {
    pub fn none() -> Self {
        let (report, warm) = mpsc::channel(1);
        Self { threads: Vec::new(), warm, report }
    }

    fn spawn(&mut self, name: String, session: Session) -> io::Result<()> {
        let report = self.report.clone();
        self.threads.push(thread::Builder::new().name(name).spawn(move || session.run(&report))?);
        Ok(())
    }

    /// Waits until every session has answered once.
    pub async fn warm(&mut self) -> Result<(), EngineError> {
        for _ in &self.threads {
            // `self` holds a sender, so there is always one to wait for.
            if let Some(report) = self.warm.recv().await {
                report?;
            }
        }
        Ok(())
    }

    /// Waits for the sessions to end, which they do once their engine is dropped.
    pub fn join(self) {
        let Self { threads, warm, report: _ } = self;
        // Nobody listens any more: a session that has still to report that it is warm must not wait for it.
        drop(warm);
        for thread in threads {
            // A session catches its panics, and one that did not has nothing left to be waited for.
            let _ = thread.join();
        }
    }
}

/// A thread's own network and its end of the queue.
struct Session {
    network: Network,
    jobs: Arc<Mutex<Receiver<Job>>>,
    waiting: IntGauge,
    pace: Arc<Pace>,
}

impl Session {
    fn run(mut self, report: &mpsc::Sender<Result<(), EngineError>>) {
        // Nobody to report to: the server is stopping already, and the queue says so next.
        let _ = report.blocking_send(self.warm_up());
        while let Some(job) = self.next() {
            let Job { volume, params, span, submitted, place, reply } = job;
            if reply.is_closed() {
                continue;
            }
            let queue = submitted.elapsed();
            let answer = span.in_scope(|| self.answer(&volume, &params, queue));
            // First the place, so that whoever got this answer finds room for the next request.
            drop(place);
            // The caller may have gone meanwhile, which is counted on their side.
            let _ = reply.send(answer);
        }
    }

    fn next(&self) -> Option<Job> {
        // Whoever holds the lock is the one that waits. A panic cannot have left the receiver half changed.
        let job = self.jobs.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()?;
        self.waiting.dec();
        Some(job)
    }

    fn answer(&mut self, volume: &Volume, params: &DecodeParams, queue: Duration) -> Result<Answer, EngineError> {
        let started = Instant::now();
        let network = &mut self.network;
        let answer = caught(|| {
            let output = network.infer(&[volume])?;
            let inference = started.elapsed();
            let decoded = decode(volume, &output.maps(0), params)?;
            Ok(Answer { decoded, queue, inference, postprocessing: started.elapsed() - inference })
        });
        self.pace.set(started.elapsed());
        if let Err(error) = &answer {
            error!(%error, "the session failed");
        }
        answer
    }

    /// The first inference allocates and tunes; no caller should wait for that.
    fn warm_up(&mut self) -> Result<(), EngineError> {
        let metadata = self.network.metadata();
        let values = vec![0.5; metadata.resolution.pow(3)];
        let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
        let params = metadata.decode_params();
        let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a surface");
        self.answer(&volume, &params, Duration::ZERO).map(drop)
    }
}

impl Pace {
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
