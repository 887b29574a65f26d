//! A job: one scene on its way through the queue and a session, and its result.

use std::fmt::Display;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp::{Candidate, Code, DetectParams, RequestError};
use grasp_perception::Scene;
use tokio::sync::oneshot;
use tracing::Span;

use crate::detection::{Detection, Scores};
use crate::scheduler::Slot;

/// A session's result for one scene, with its timings.
pub struct SessionOutput<T> {
    /// The result.
    pub value: T,
    /// Time in the queue.
    pub queue: Duration,
    /// Time of the network.
    pub inference: Duration,
    /// Time of the evaluator; None for models without one.
    pub evaluation: Option<Duration>,
    /// Time of the decoding.
    pub postprocessing: Duration,
}

/// A network's [`OUTPUTS`](grasp_models::OUTPUTS), as bytes: f32, little-endian.
pub struct Tensors(pub [Vec<u8>; 3]);

/// An error of the model or of its runtime.
pub(crate) fn failed(error: impl Display) -> RequestError {
    RequestError::new(Code::Internal, error.to_string())
}

/// The error for requests to a model all of whose sessions hang.
pub(crate) fn no_session() -> RequestError {
    let message = "all sessions of the model hang in an inference; retry on another replica";
    RequestError::new(Code::Unavailable, message)
}

/// Whether a deadline has passed.
pub(crate) fn has_passed(deadline: Option<Instant>) -> bool {
    deadline.is_some_and(|deadline| deadline <= Instant::now())
}

/// The pending result of a queued scene. Dropping it removes the scene from the queue.
pub struct Reply<T> {
    receiver: Receiver<T>,
    _slot: Slot<Job>,
}

/// Sends the result of a scene, once. It is shared with the watch for inferences that do not end.
pub(crate) struct Sender<T>(Arc<Mutex<Option<oneshot::Sender<Outcome<T>>>>>);

type Receiver<T> = oneshot::Receiver<Outcome<T>>;

type Outcome<T> = Result<SessionOutput<T>, RequestError>;

/// A pending request that can be failed.
pub(crate) trait Fail: Send + Sync {
    /// Sends an error, unless a result was sent.
    fn fail(&self, error: RequestError);
}

impl<T: Send + 'static> Sender<T> {
    pub fn new() -> (Self, Receiver<T>) {
        let (sender, receiver) = oneshot::channel();
        (Self(Arc::new(Mutex::new(Some(sender)))), receiver)
    }

    /// Whether the result is no longer needed.
    pub fn is_closed(&self) -> bool {
        self.sender().as_ref().is_none_or(oneshot::Sender::is_closed)
    }

    /// A failed send is ignored: the call counts as cancelled by the client.
    pub fn send(&self, result: Outcome<T>) {
        if let Some(sender) = self.sender().take() {
            let _ = sender.send(result);
        }
    }

    fn sender(&self) -> MutexGuard<'_, Option<oneshot::Sender<Outcome<T>>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn shared(&self) -> Arc<dyn Fail> {
        Arc::new(Self(Arc::clone(&self.0)))
    }
}

impl<T: Send + 'static> Fail for Sender<T> {
    fn fail(&self, error: RequestError) {
        self.send(Err(error));
    }
}

impl<T> Reply<T> {
    pub(crate) fn new(receiver: Receiver<T>, slot: Slot<Job>) -> Self {
        Self { receiver, _slot: slot }
    }

    /// Waits for the result until the deadline.
    ///
    /// # Errors
    /// [`RequestError`] if the session fails, or the deadline passes.
    pub async fn wait(self, deadline: Option<Instant>) -> Result<SessionOutput<T>, RequestError> {
        let Self { receiver, _slot } = self;
        let result = match deadline {
            None => receiver.await,
            Some(deadline) => {
                let result = tokio::time::timeout_at(deadline.into(), receiver).await;
                result.map_err(|_| RequestError::expired())?
            }
        };
        // The sender is dropped without a result if the session thread has ended.
        result.unwrap_or_else(|_| Err(failed("the session thread has ended")))
    }
}

pub(crate) struct Job {
    pub scene: Scene,
    pub task: Task,
    pub deadline: Option<Instant>,
    pub span: Span,
    pub submitted: Instant,
}

/// What a session computes from a scene.
pub(crate) enum Task {
    Grasps(Arc<DetectParams>, Sender<Detection>),
    Scores(Arc<DetectParams>, Arc<[Candidate]>, Sender<Scores>),
    /// The network's raw output.
    Maps(Sender<Tensors>),
}

impl Task {
    pub fn is_closed(&self) -> bool {
        match self {
            Self::Grasps(_, reply) => reply.is_closed(),
            Self::Scores(_, _, reply) => reply.is_closed(),
            Self::Maps(reply) => reply.is_closed(),
        }
    }

    /// Sends an error.
    pub fn fail(self, error: RequestError) {
        self.reply().fail(error);
    }

    /// The pending request.
    pub fn reply(&self) -> Arc<dyn Fail> {
        match self {
            Self::Grasps(_, reply) => reply.shared(),
            Self::Scores(_, _, reply) => reply.shared(),
            Self::Maps(reply) => reply.shared(),
        }
    }
}
