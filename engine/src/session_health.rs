use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use grasp::{Code, RequestError};
use tracing::{error, info};

use crate::job::{Fail, Job};
use crate::observer::ModelObserver;

/// Whether a session hangs in an inference, or fails each one.
pub(crate) struct SessionHealth {
    /// The batch that the session is computing.
    batch: Mutex<Option<Batch>>,
    /// When the latest batch ended, milliseconds since 1970.
    latest: AtomicU64,
    /// Number of the latest batches that failed in a row.
    failures: AtomicU32,
    /// Counts the model's sessions that hang.
    observer: Arc<dyn ModelObserver>,
}

/// Number of failed batches in a row after which a session counts as failing: fewer may be due to their scenes.
const FAILURES: u32 = 10;

struct Batch {
    since: Instant,
    requests: Vec<Arc<dyn Fail>>,
    is_hanging: bool,
}

/// Ends a batch when it is dropped, also if the session panics.
struct Ended<'a>(&'a SessionHealth);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl SessionHealth {
    pub fn new(observer: Arc<dyn ModelObserver>) -> Self {
        Self { batch: Mutex::default(), latest: AtomicU64::new(0), failures: AtomicU32::new(0), observer }
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
            self.observer.hanging(-1);
            info!("stuck inference completed; session resumed");
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
    pub fn is_healthy(&self) -> bool {
        !self.is_hanging() && self.failures.load(Ordering::Relaxed) < FAILURES
    }

    /// Fails the requests of a batch that takes longer than `timeout`. Returns whether the session hangs from now on.
    pub fn check(&self, timeout: Duration) -> bool {
        let mut batch = self.batch();
        let Some(batch) = batch.as_mut().filter(|batch| !batch.is_hanging && batch.since.elapsed() > timeout) else {
            return false;
        };
        batch.is_hanging = true;
        self.observer.hanging(1);
        let message = format!("the inference takes longer than {timeout:?} (--inference-timeout)");
        let error = RequestError::new(Code::Internal, message);
        batch.requests.drain(..).for_each(|request| request.fail(error.clone()));
        true
    }

    fn batch(&self) -> MutexGuard<'_, Option<Batch>> {
        self.batch.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
