//! A job: one scene on its way through the queue and a session, and its result.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp::DecodeError;
use grasp_models::RuntimeError;
use grasp_planner::{PlanError, Scene};
use grasp_proto::{Candidate, DetectParams};
use thiserror::Error;
use tokio::sync::oneshot;
use tracing::Span;

use super::detection::{Detection, Score};
use super::engine::Overloaded;
use super::queue::QueueSlot;
use crate::transport::deadline::Deadline;

/// A session's result for one scene, with its timings.
pub(crate) struct SessionOutput<T> {
    pub value: T,
    pub queue: Duration,
    pub inference: Duration,
    /// None for models without an evaluator.
    pub evaluation: Option<Duration>,
    pub postprocessing: Duration,
}

/// A network's [`OUTPUTS`](grasp_models::OUTPUTS), as bytes: f32, little-endian.
pub(crate) struct Tensors(pub [Vec<u8>; 3]);

/// Why a session returned no result.
#[derive(Clone, Debug, Error)]
pub(crate) enum EngineError {
    #[error(transparent)]
    Run(#[from] RuntimeError),
    #[error(transparent)]
    Decode(#[from] DecodeError),
    #[error("the session panicked: {0}")]
    Panic(String),
    #[error("the planner has no network, which ModelInfer and ScoreGrasps require")]
    NoNetwork,
    #[error("the session thread has ended")]
    SessionEnded,
    #[error("the deadline passed before the request was finished")]
    Expired,
    #[error("the inference takes about {0:.0?}, longer than the time that is left until the deadline")]
    NoTimeLeft(Duration),
    #[error("the inference takes longer than {0:?} (--inference-timeout)")]
    Hanging(Duration),
    #[error("all sessions of the model hang in an inference; retry on another replica")]
    NoSession,
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
}

impl From<PlanError> for EngineError {
    fn from(error: PlanError) -> Self {
        match error {
            PlanError::Run(error) => error.into(),
            PlanError::Decode(error) => error.into(),
            // Planning is cancelled when the deadline passes or the client cancels; the latter receives no response.
            PlanError::Cancelled => Self::Expired,
        }
    }
}

/// The pending result of a queued scene. Dropping it removes the scene from the queue.
pub(crate) struct Reply<T> {
    receiver: Receiver<T>,
    _slot: QueueSlot<Job>,
}

/// Sends the result of a scene, once. It is shared with the watch for inferences that do not end.
pub(super) struct Sender<T>(Arc<Mutex<Option<oneshot::Sender<Outcome<T>>>>>);

type Receiver<T> = oneshot::Receiver<Outcome<T>>;

type Outcome<T> = Result<SessionOutput<T>, EngineError>;

/// A pending request that can be failed.
pub(super) trait Fail: Send + Sync {
    /// Sends an error, unless a result was sent.
    fn fail(&self, error: EngineError);
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
    fn fail(&self, error: EngineError) {
        self.send(Err(error));
    }
}

impl<T> Reply<T> {
    pub(super) fn new(receiver: Receiver<T>, slot: QueueSlot<Job>) -> Self {
        Self { receiver, _slot: slot }
    }

    /// Waits for the result until the deadline.
    pub async fn wait(self, deadline: Option<Deadline>) -> Result<SessionOutput<T>, EngineError> {
        let Self { receiver, _slot } = self;
        let result = match deadline {
            None => receiver.await,
            Some(Deadline(deadline)) => {
                let result = tokio::time::timeout_at(deadline.into(), receiver).await;
                result.map_err(|_| EngineError::Expired)?
            }
        };
        // The sender is dropped without a result if the session thread has ended.
        result.unwrap_or(Err(EngineError::SessionEnded))
    }
}

pub(super) struct Job {
    pub scene: Scene,
    pub task: Task,
    pub deadline: Option<Deadline>,
    pub span: Span,
    pub submitted: Instant,
}

/// What a session computes from a scene.
pub(super) enum Task {
    Grasps(Box<DetectParams>, Sender<Detection>),
    Scores(Box<DetectParams>, Vec<Candidate>, Sender<Vec<Score>>),
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
    pub fn fail(self, error: EngineError) {
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
