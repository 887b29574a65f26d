//! A job: one scene on its way through the queue and a session, and its result.

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
    #[error(transparent)]
    Displaced(Overloaded),
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

pub(super) type Sender<T> = oneshot::Sender<Result<SessionOutput<T>, EngineError>>;
type Receiver<T> = oneshot::Receiver<Result<SessionOutput<T>, EngineError>>;

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

    /// Sends an error. A failed send is ignored: the call counts as cancelled by the client.
    pub fn fail(self, error: EngineError) {
        match self {
            Self::Grasps(_, reply) => drop(reply.send(Err(error))),
            Self::Scores(_, _, reply) => drop(reply.send(Err(error))),
            Self::Maps(reply) => drop(reply.send(Err(error))),
        }
    }
}
