//! The session threads of all models. An inference that does not end loses its thread: its requests are failed. A model
//! is reported if all of its sessions hang, or fail again and again.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use tokio::sync::watch;
use tracing::{error, warn};

use crate::job::{Job, no_session};
use crate::scheduler::Scheduler;
use crate::session::Session;
use crate::session_health::SessionHealth;

/// The session threads of all models, including those that are no longer served.
#[derive(Default)]
pub struct SessionThreads(Mutex<Vec<SessionThread>>);

struct SessionThread {
    thread: JoinHandle<()>,
    scheduler: Arc<Scheduler<Job>>,
    /// Of all sessions of the model.
    health: Vec<Arc<SessionHealth>>,
    /// Which of them is this thread's.
    index: usize,
}

impl SessionThreads {
    /// Starts the thread of a session, the one with this index among those of its model.
    pub(crate) fn spawn(
        &self,
        name: String,
        session: Session,
        health: &[Arc<SessionHealth>],
        index: usize,
    ) -> io::Result<()> {
        let scheduler = Arc::clone(&session.scheduler);
        let thread = thread::Builder::new().name(name).spawn(move || session.run())?;
        let mut threads = self.threads();
        threads.retain(|session| !session.thread.is_finished());
        threads.push(SessionThread { thread, scheduler, health: health.to_vec(), index });
        Ok(())
    }

    /// Watches the sessions; never returns. An inference that takes longer than `timeout` hangs. `healthy` receives
    /// what `is_healthy` returns: whether each served model has a session that neither hangs nor fails.
    pub async fn watch(
        self: Arc<Self>,
        is_healthy: impl Fn() -> bool,
        timeout: Option<Duration>,
        healthy: watch::Sender<bool>,
    ) {
        const LONGEST: Duration = Duration::from_secs(1);
        let pause = timeout.map_or(LONGEST, |timeout| (timeout / 10).clamp(Duration::from_millis(10), LONGEST));
        loop {
            tokio::time::sleep(pause).await;
            if let Some(timeout) = timeout {
                self.check(timeout);
            }
            let now = is_healthy();
            healthy.send_if_modified(|before| std::mem::replace(before, now) != now);
        }
    }

    fn check(&self, timeout: Duration) {
        for SessionThread { thread, scheduler, health, index } in self.threads().iter() {
            if health[*index].check(timeout) {
                error!(
                    session = thread.thread().name(),
                    ?timeout,
                    "an inference takes longer than --inference-timeout; its requests have failed, and its session \
                     thread is lost until it ends"
                );
            }
            // No session is left for the waiting requests.
            if health.iter().all(|session| session.is_hanging()) {
                scheduler.take_all().into_iter().for_each(|job| job.task.fail(no_session()));
            }
        }
    }

    /// Waits for the session threads to end, not after `until`. A session ends when its model is dropped and its queue
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
