//! The session threads of all engines. An inference that does not end loses its thread: its requests are failed. A model
//! is reported if all of its sessions hang, or fail again and again.

use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use prometheus::IntGauge;
use tokio::sync::watch;
use tracing::{error, info, warn};

use super::job::{EngineError, Fail, Job};
use super::queue::Queue;
use super::registry::ModelRegistry;
use super::session::Session;

/// The session threads of all engines, also of those that are no longer served.
#[derive(Default)]
pub(crate) struct SessionThreads(Mutex<Vec<SessionThread>>);

struct SessionThread {
    thread: JoinHandle<()>,
    queue: Arc<Queue<Job>>,
    /// Of all sessions of the queue.
    running: Vec<Arc<Running>>,
    /// Which of them is this thread's.
    index: usize,
}

/// The batch that a session is computing.
pub(super) struct Running {
    batch: Mutex<Option<Batch>>,
    /// When the latest batch ended, milliseconds since 1970.
    latest: AtomicU64,
    /// Number of the latest batches that failed, one after another.
    failures: AtomicU32,
    /// Number of the model's sessions that hang.
    hanging: IntGauge,
}

/// Failed batches, one after another, after which a session counts as failing: fewer may be due to their scenes.
const FAILURES: u32 = 10;

struct Batch {
    since: Instant,
    requests: Vec<Arc<dyn Fail>>,
    is_hanging: bool,
}

/// Ends a batch when it is dropped, also if the session panics.
struct Ended<'a>(&'a Running);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl Running {
    pub fn new(hanging: IntGauge) -> Self {
        Self { batch: Mutex::default(), latest: AtomicU64::new(0), failures: AtomicU32::new(0), hanging }
    }

    /// The batch runs until the returned value is dropped.
    pub fn begin(&self, jobs: &[Job]) -> impl Drop + use<'_> {
        let requests = jobs.iter().map(|job| job.task.reply()).collect();
        *self.batch() = Some(Batch { since: Instant::now(), requests, is_hanging: false });
        Ended(self)
    }

    fn end(&self) {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.latest.store(u64::try_from(now.as_millis()).unwrap_or(u64::MAX), Ordering::Relaxed);
        if self.batch().take().is_some_and(|batch| batch.is_hanging) {
            self.hanging.dec();
            info!("the inference that did not end has ended; its session continues");
        }
    }

    pub fn latest(&self) -> u64 {
        self.latest.load(Ordering::Relaxed)
    }

    pub fn is_hanging(&self) -> bool {
        self.batch().as_ref().is_some_and(|batch| batch.is_hanging)
    }

    /// Counts a batch that succeeded or failed.
    pub fn computed(&self, succeeded: bool) {
        let before = if succeeded {
            self.failures.swap(0, Ordering::Relaxed)
        } else {
            self.failures.fetch_add(1, Ordering::Relaxed)
        };
        match (succeeded, before + u32::from(!succeeded)) {
            (false, FAILURES) => {
                error!("{FAILURES} batches have failed, one after another; the session counts as failing")
            }
            (true, FAILURES..) => info!("the session no longer fails"),
            _ => {}
        }
    }

    /// Whether the session neither hangs nor fails each batch.
    pub fn is_able(&self) -> bool {
        !self.is_hanging() && self.failures.load(Ordering::Relaxed) < FAILURES
    }

    /// Fails the requests of a batch that takes longer than `timeout`. Returns whether the session hangs from now on.
    fn check(&self, timeout: Duration) -> bool {
        let mut batch = self.batch();
        let Some(batch) = batch.as_mut().filter(|batch| !batch.is_hanging && batch.since.elapsed() > timeout) else {
            return false;
        };
        batch.is_hanging = true;
        self.hanging.inc();
        batch.requests.drain(..).for_each(|request| request.fail(EngineError::Hanging(timeout)));
        true
    }

    fn batch(&self) -> MutexGuard<'_, Option<Batch>> {
        self.batch.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl SessionThreads {
    /// Starts the thread of a session, the one with this index among those of its queue.
    pub(super) fn spawn(
        &self,
        name: String,
        session: Session,
        running: &[Arc<Running>],
        index: usize,
    ) -> io::Result<()> {
        let queue = Arc::clone(&session.queue);
        let thread = thread::Builder::new().name(name).spawn(move || session.run())?;
        let mut threads = self.threads();
        threads.retain(|session| !session.thread.is_finished());
        threads.push(SessionThread { thread, queue, running: running.to_vec(), index });
        Ok(())
    }

    /// Watches the sessions, without end. An inference that takes longer than `timeout` hangs. `is_able` receives whether
    /// each served model has a session that neither hangs nor fails.
    pub async fn watch(
        self: Arc<Self>,
        models: Arc<ModelRegistry>,
        timeout: Option<Duration>,
        is_able: watch::Sender<bool>,
    ) {
        const LONGEST: Duration = Duration::from_secs(1);
        let pause = timeout.map_or(LONGEST, |timeout| (timeout / 10).clamp(Duration::from_millis(10), LONGEST));
        loop {
            tokio::time::sleep(pause).await;
            if let Some(timeout) = timeout {
                self.check(timeout);
            }
            let able = models.now().iter().all(|engine| engine.is_able());
            is_able.send_if_modified(|before| std::mem::replace(before, able) != able);
        }
    }

    fn check(&self, timeout: Duration) {
        for SessionThread { thread, queue, running, index } in self.threads().iter() {
            if running[*index].check(timeout) {
                error!(
                    session = thread.thread().name(),
                    ?timeout,
                    "an inference takes longer than --inference-timeout; its requests have failed, and its session \
                     thread is lost until it ends"
                );
            }
            // No session is left for the waiting requests.
            if running.iter().all(|session| session.is_hanging()) {
                queue.take_all().into_iter().for_each(|job| job.task.fail(EngineError::NoSession));
            }
        }
    }

    /// Waits for the session threads to end, not after `until`. A session ends when its engine is dropped and its queue
    /// is empty.
    pub fn join(&self, until: Instant) {
        let threads = std::mem::take(&mut *self.threads());
        for SessionThread { thread, .. } in threads {
            while !thread.is_finished() && Instant::now() < until {
                thread::sleep(Duration::from_millis(1));
            }
            if !thread.is_finished() {
                warn!(session = thread.thread().name(), "session thread still running at shutdown");
                continue;
            }
            // Fails only after a panic, which ended the thread.
            let _ = thread.join();
        }
    }

    fn threads(&self) -> MutexGuard<'_, Vec<SessionThread>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
