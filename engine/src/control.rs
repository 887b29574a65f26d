//! Requests of clients to load and unload models.

use std::time::Duration;

use grasp::{Code, RequestError};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

/// Passes requests to the task that watches the model folder.
#[derive(Clone)]
pub struct ModelControl {
    commands: mpsc::Sender<Command>,
    /// Whether clients may load and unload models.
    is_allowed: bool,
}

/// What to do with a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Reads the model folder again and serves the model.
    Load,
    /// No longer serves the model, until it is loaded again.
    Unload,
}

/// A request to change a served model.
pub(crate) struct Command {
    pub name: String,
    pub change: Change,
    /// Whether a client had unloaded the model.
    pub was_unloaded: bool,
    pub done: oneshot::Sender<Result<(), RequestError>>,
}

/// Maximum number of requests that wait for the one before them.
const WAITING: usize = 8;

/// Retry hint if too many requests wait: loading and warming up a model takes seconds.
const LOADING: Duration = Duration::from_secs(5);

impl ModelControl {
    pub(crate) fn new(is_allowed: bool) -> (Self, mpsc::Receiver<Command>) {
        let (commands, receiver) = mpsc::channel(WAITING);
        (Self { commands, is_allowed }, receiver)
    }

    /// Changes a model, and waits until it is loaded or no longer served.
    ///
    /// # Errors
    /// [`RequestError`] if it is not allowed, fails, or too many requests wait.
    pub async fn change(&self, name: String, change: Change) -> Result<(), RequestError> {
        if !self.is_allowed {
            let message = "loading and unloading of models is not allowed; start the server with --allow-model-control";
            return Err(RequestError::new(Code::PermissionDenied, message));
        }
        let (done, outcome) = oneshot::channel();
        self.commands.try_send(Command { name, change, was_unloaded: false, done }).map_err(|error| match error {
            TrySendError::Full(_) => {
                let message =
                    format!("{WAITING} requests to load or unload models already wait; retry after {LOADING:?}");
                RequestError::new(Code::ResourceExhausted, message).after(LOADING)
            }
            TrySendError::Closed(_) => shutting_down(),
        })?;
        // The folder's task ends only with the server.
        outcome.await.unwrap_or_else(|_| Err(shutting_down()))
    }
}

/// The error for requests that arrive during the shutdown.
pub(crate) fn shutting_down() -> RequestError {
    RequestError::new(Code::Unavailable, "the server is shutting down; retry on another replica")
}
