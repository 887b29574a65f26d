//! A call: one request from start to end, in log, metrics, trace, recordings and the list of recent requests.

use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use grasp::{Code, Priority, RequestError};
use grasp_engine::{Caller, Model, RequestMetadata};
use grasp_perception::Warning;
use grasp_proto::{check_id, pb};
use opentelemetry::Context;
use tokio::sync::watch;
use tonic::{Request, Status};
use tracing::field::Empty;
use tracing::{Span, debug, error, error_span, info};

use crate::api::status::{self, status};
use crate::readiness::State;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::{Outcome, RecentRequests};
use crate::telemetry::recorder::Recording;
use crate::telemetry::subscriber::{self, REQUEST};
use crate::transport::caller;
use crate::transport::deadline::{self, Deadline};
use crate::transport::request_body::unreadable_message;
use crate::transport::tokens::Tokens;

/// Retry hint while the models are loaded and warmed up.
const WARM_UP: Duration = Duration::from_secs(1);

/// Runs requests as calls.
#[derive(Clone)]
pub(crate) struct Calls {
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    state: watch::Receiver<State>,
    /// None if requests need no token.
    tokens: Option<Arc<Tokens>>,
    ids: Arc<RequestIds>,
}

/// Metadata of a request, or of the stream that it belongs to.
#[derive(Clone)]
pub(crate) struct CallContext {
    /// The field with the request's id.
    id_field: &'static str,
    caller: Caller,
    deadline: Option<Deadline>,
    parent: Option<Context>,
}

impl CallContext {
    pub fn new<T>(request: &Request<T>) -> Self {
        Self {
            id_field: "request_id",
            caller: caller::of(request.extensions()),
            deadline: deadline::of(request.extensions()),
            parent: subscriber::parent(request.metadata()),
        }
    }

    /// Who sent the request.
    pub fn caller(&self) -> Caller {
        self.caller
    }

    /// The context of a request whose id is in another field.
    pub fn with_id_field(self, id_field: &'static str) -> Self {
        Self { id_field, ..self }
    }
}

/// The answer to a request.
pub(crate) struct Answer<T> {
    pub request_id: String,
    pub outcome: Result<T, RequestError>,
}

impl<T> Answer<T> {
    /// The answer of a method without a stream.
    pub fn into_response(self) -> Result<tonic::Response<T>, Status> {
        let Self { request_id, outcome } = self;
        outcome.map(tonic::Response::new).map_err(|error| status(&error, &request_id))
    }
}

impl Calls {
    pub fn new(
        metrics: Arc<Metrics>,
        recent: Arc<RecentRequests>,
        state: watch::Receiver<State>,
        tokens: Option<Arc<Tokens>>,
    ) -> Self {
        Self { metrics, recent, state, tokens, ids: Arc::new(RequestIds::new()) }
    }

    pub fn state(&self) -> watch::Receiver<State> {
        self.state.clone()
    }

    /// Refuses a request that needs the list of models while the server is still starting.
    pub fn check_started(&self) -> Result<(), RequestError> {
        if *self.state.borrow() != State::Starting {
            return Ok(());
        }
        let message = format!("the server is warming up; retry after {WARM_UP:?}");
        Err(RequestError::new(Code::Unavailable, message).after(WARM_UP))
    }

    /// The status that ends a stream after a message that cannot be read.
    pub fn unreadable(&self, status: Status) -> Status {
        unreadable_message(status, &self.metrics)
    }

    /// Runs a request from start to end. `work` returns the response and, if a model has computed it, what the page
    /// shows of it. If the returned future is dropped before it ends, the request counts as cancelled by the client, or
    /// as expired if its deadline has passed.
    pub async fn run<T>(
        &self,
        id: String,
        context: CallContext,
        recording: Recording<T>,
        work: impl AsyncFnOnce(&mut Call) -> Result<(T, Option<Outcome>), RequestError>,
    ) -> Answer<T> {
        let (mut call, checked) = self.open(id, context);
        let outcome = match checked {
            Ok(()) => work(&mut call).await,
            Err(error) => Err(error),
        };
        let request_id = call.id.clone();
        let outcome = match outcome {
            Ok((response, shown)) => {
                call.succeed(shown);
                Ok(response)
            }
            Err(error) => Err(call.fail(error)),
        };
        recording.answered(&outcome);
        Answer { request_id, outcome }
    }

    /// The status of a stream that is refused or ended. The error is logged and counted.
    pub fn refuse(&self, error: RequestError, context: CallContext) -> Status {
        let (call, _) = self.open(String::new(), context);
        let id = call.id.clone();
        status(&call.fail(error), &id)
    }

    /// Opens a call. The second value is an error if the id is invalid, the server is still starting, or the token of
    /// the call's stream is no longer accepted.
    fn open(&self, mut id: String, context: CallContext) -> (Call, Result<(), RequestError>) {
        let CallContext { id_field, caller, deadline, parent } = context;
        let mut checked = check_id(id_field, &id);
        if id.is_empty() || checked.is_err() {
            id = self.ids.next();
        }
        // During the drain, requests on open connections are still answered; streams stop reading on their own.
        checked = checked.and_then(|()| self.check_started());
        // The token of a stream was checked when the stream was opened.
        if checked.is_ok() && self.tokens.as_ref().is_some_and(|tokens| !tokens.accept(&caller)) {
            let message = "the token of the stream is no longer accepted; open a new stream with a valid one";
            checked = Err(RequestError::new(Code::Unauthenticated, message));
        }
        // At the level error, so that its fields are in the log lines of every level.
        let span = error_span!(
            REQUEST,
            otel.kind = "server",
            otel.status_code = Empty,
            request_id = id,
            model = Empty,
            queue = Empty,
            preprocessing = Empty,
            fusion = Empty,
            inference = Empty,
            evaluation = Empty,
            postprocessing = Empty,
            total = Empty,
        );
        subscriber::set_parent(&span, parent);
        let call = Call {
            id,
            deadline: deadline.map(|Deadline(deadline)| deadline),
            caller,
            started: Instant::now(),
            span,
            metrics: Arc::clone(&self.metrics),
            recent: Arc::clone(&self.recent),
            model: None,
            has_ended: false,
        };
        (call, checked)
    }
}

/// A request in progress, with its id, span and model.
pub(crate) struct Call {
    pub id: String,
    pub deadline: Option<Instant>,
    caller: Caller,
    started: Instant,
    span: Span,
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    /// None until a model is selected.
    model: Option<Arc<Model>>,
    has_ended: bool,
}

impl Call {
    /// Who sent the request, and when it must be answered.
    pub fn metadata(&self, priority: Priority) -> RequestMetadata {
        RequestMetadata { caller: self.caller, priority, deadline: self.deadline }
    }

    /// Records the model that processes the request.
    pub fn set_model(&mut self, model: &Arc<Model>) {
        self.span.record("model", &model.label);
        self.model = Some(Arc::clone(model));
    }

    /// `name version` of the model; empty until a model is selected.
    fn label(&self) -> &str {
        self.model.as_ref().map_or("", |model| &model.label)
    }

    /// Time since the call was opened.
    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }

    pub fn span(&self) -> &Span {
        &self.span
    }

    /// The warnings of the reply, which are logged and counted.
    pub fn warn(&self, warnings: &[Warning]) -> Vec<pb::GeometryWarning> {
        let warnings: Vec<pb::GeometryWarning> = warnings.iter().map(Into::into).collect();
        for warning in &warnings {
            self.metrics.warned(self.label(), warning.code());
            self.span.in_scope(|| debug!(code = warning.code().as_str_name(), "{}", warning.message));
        }
        warnings
    }

    /// Ends the call with a success. `outcome` is None if no model has computed it.
    fn succeed(&mut self, outcome: Option<Outcome>) {
        self.has_ended = true;
        let Some((outcome, timings)) = outcome.and_then(|outcome| outcome.timings().map(|timings| (outcome, timings)))
        else {
            self.metrics.ended(self.label(), tonic::Code::Ok);
            return self.span.in_scope(|| debug!("request succeeded"));
        };
        for (stage, seconds) in timings.stages() {
            self.span.record(stage, seconds);
        }
        subscriber::stages(&self.span, &timings);
        let grasps = outcome.grasps();
        self.metrics.succeeded(self.label(), &timings, grasps);
        if let Some(model) = &self.model {
            model.statistics.succeeded(&timings);
        }
        self.span.in_scope(|| debug!(grasps, "request succeeded"));
        self.recent.add(self.id.clone(), self.label().to_owned(), outcome);
    }

    /// Ends the call with an error.
    fn fail(mut self, error: RequestError) -> RequestError {
        self.count(status::code(&error));
        if error.code == Code::Internal {
            self.span.record("otel.status_code", "ERROR");
        }
        let outcome = Outcome::Refused { code: status::code(&error), message: error.message.clone() };
        self.recent.add(self.id.clone(), self.label().to_owned(), outcome);
        self.span.in_scope(|| match error.code {
            code @ Code::Internal => error!(?code, refusal = %error, "refused"),
            code => info!(?code, refusal = %error, "refused"),
        });
        error
    }

    /// Counts a call that ends without a result.
    fn count(&mut self, code: tonic::Code) {
        self.has_ended = true;
        self.metrics.ended(self.label(), code);
        if let Some(model) = &self.model {
            model.statistics.failed();
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if self.has_ended {
            return;
        }
        let (code, reason) = if self.deadline.is_some_and(|deadline| deadline <= Instant::now()) {
            (tonic::Code::DeadlineExceeded, "the deadline has passed")
        } else {
            (tonic::Code::Cancelled, "cancelled by the client")
        };
        self.count(code);
        self.span.in_scope(|| info!(?code, "{reason}"));
    }
}

/// Ids for requests without one: a random number of the process, then a counter.
struct RequestIds {
    process: u32,
    next: AtomicU64,
}

impl RequestIds {
    fn new() -> Self {
        // The standard library's hashers have random seeds, so no dependency for random numbers is needed.
        Self { process: RandomState::new().hash_one(0) as u32, next: AtomicU64::new(1) }
    }

    fn next(&self) -> String {
        format!("{:08x}-{}", self.process, self.next.fetch_add(1, Ordering::Relaxed))
    }
}
