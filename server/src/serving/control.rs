//! Requests of clients to load and unload models.

use std::time::Duration;

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

use crate::serving::refusal::Refusal;

/// Sends requests to the task that watches the model folder.
#[derive(Clone)]
pub(crate) struct ModelControl {
    commands: mpsc::Sender<Command>,
    /// Whether clients may load and unload models.
    is_allowed: bool,
}

pub(crate) enum Change {
    /// Reads the model folder again and serves the model.
    Load,
    /// No longer serves the model, until it is loaded again.
    Unload,
}

/// A request to change a served model.
pub(super) struct Command {
    pub name: String,
    pub change: Change,
    pub done: oneshot::Sender<Result<(), Refusal>>,
}

/// Requests that wait for the one before them.
const WAITING: usize = 8;

/// Retry hint if too many requests wait: loading and warming up a model takes seconds.
const LOADING: Duration = Duration::from_secs(5);

impl ModelControl {
    pub(super) fn new(is_allowed: bool) -> (Self, mpsc::Receiver<Command>) {
        let (commands, receiver) = mpsc::channel(WAITING);
        (Self { commands, is_allowed }, receiver)
    }

    /// Changes a model, and waits until it is loaded or no longer served.
    pub async fn change(&self, name: String, change: Change) -> Result<(), Refusal> {
        if !self.is_allowed {
            return Err(Refusal::NoModelControl);
        }
        let (done, outcome) = oneshot::channel();
        self.commands.try_send(Command { name, change, done }).map_err(|error| match error {
            TrySendError::Full(_) => Refusal::ManyChanges(WAITING, LOADING),
            TrySendError::Closed(_) => Refusal::Draining,
        })?;
        // The folder's task ends only with the server.
        outcome.await.unwrap_or(Err(Refusal::Draining))
    }
}
