use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use grasp::Warning;
use grasp_proto::{Priority, pb};
use opentelemetry::Context;
use tokio::sync::watch;
use tonic::{Code, Request, Status};
use tracing::field::Empty;
use tracing::{Span, debug, error, error_span, info};

use crate::readiness::State;
use crate::serving::engine::Engine;
use crate::serving::frame_stamp::check_id;
use crate::serving::queue::Ticket;
use crate::serving::refusal::Refusal;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::{Outcome, RecentRequests};
use crate::telemetry::subscriber::{self, REQUEST};
use crate::telemetry::timings::StageTimings;
use crate::transport::caller::Caller;
use crate::transport::deadline::{self, Deadline};
use crate::transport::request_body::unreadable_message;
use crate::transport::tokens::Tokens;

/// Retry hint while the models are loaded and warmed up.
const WARM_UP: Duration = Duration::from_secs(1);

/// Creates the [`Call`] of each request.
#[derive(Clone)]
pub(crate) struct Calls {
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    state: watch::Receiver<State>,
    /// None if requests need no token.
    tokens: Option<Arc<Tokens>>,
    ids: Arc<RequestIds>,
}

/// A request in progress, with its id, span and metrics. If it is dropped before it ends, it counts as cancelled by the
/// client, or as expired if its deadline has passed.
pub(crate) struct Call {
    pub id: String,
    pub deadline: Option<Deadline>,
    caller: Caller,
    started: Instant,
    span: Span,
    metrics: Arc<Metrics>,
    recent: Arc<RecentRequests>,
    /// Name of the model; empty until a model is selected.
    pub name: String,
    /// Version of the model.
    pub version: String,
    /// `name version` of the model.
    label: String,
    ended: bool,
}

/// What is known of a request besides its message.
#[derive(Clone)]
pub(crate) struct CallContext {
    caller: Caller,
    deadline: Option<Deadline>,
    parent: Option<Context>,
}

impl CallContext {
    pub fn of<T>(request: &Request<T>) -> Self {
        Self {
            caller: Caller::of(request.extensions()),
            deadline: deadline::of(request.extensions()),
            parent: subscriber::parent(request.metadata()),
        }
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
    pub fn check_started(&self) -> Result<(), Refusal> {
        if *self.state.borrow() == State::Starting { Err(Refusal::Starting(WARM_UP)) } else { Ok(()) }
    }

    /// The status that ends a stream after a message that cannot be read.
    pub fn unreadable(&self, status: Status) -> Status {
        unreadable_message(status, &self.metrics)
    }

    /// Opens a call. The second value is an error if the id is invalid, the server is still starting, or the token of the
    /// call's stream is no longer accepted.
    pub fn open(&self, id: String, context: CallContext) -> (Call, Result<(), Refusal>) {
        self.open_with("request_id", id, context)
    }

    /// As [`open`](Self::open), of a request whose id is in another field.
    pub fn open_with(&self, field: &'static str, mut id: String, context: CallContext) -> (Call, Result<(), Refusal>) {
        let started = Instant::now();
        let mut checked = check_id(field, &id).map_err(Refusal::from);
        if id.is_empty() || checked.is_err() {
            id = self.ids.next();
        }
        // During the drain, requests on open connections are still answered; streams stop reading on their own.
        checked = checked.and_then(|()| self.check_started());
        let CallContext { caller, deadline, parent } = context;
        // The token of a stream was checked when the stream was opened.
        if checked.is_ok() && self.tokens.as_ref().is_some_and(|tokens| !tokens.accept(&caller)) {
            checked = Err(Refusal::TokenRemoved);
        }
        // Its fields mark the lines of the log at every level.
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
            deadline,
            caller,
            started,
            span,
            metrics: Arc::clone(&self.metrics),
            recent: Arc::clone(&self.recent),
            name: String::new(),
            version: String::new(),
            label: String::new(),
            ended: false,
        };
        (call, checked)
    }
}

impl Call {
    /// The request's place in a queue.
    pub fn ticket(&self, priority: Priority) -> Ticket {
        Ticket { caller: self.caller, priority, deadline: self.deadline.map(|Deadline(deadline)| deadline) }
    }

    /// Records the model that processes the request.
    pub fn set_model(&mut self, engine: &Engine) {
        self.label.clone_from(&engine.label);
        engine.source.name().clone_into(&mut self.name);
        engine.source.version().clone_into(&mut self.version);
        self.span.record("model", &engine.label);
    }

    /// Time since the call was opened.
    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }

    /// Records a success in the log, the metrics, the trace and the list of recent requests, and ends the call.
    pub fn succeeded(&mut self, timings: &StageTimings, grasps: usize, outcome: Outcome) {
        timings.record(&self.span);
        subscriber::stages(&self.span, timings);
        self.metrics.succeeded(&self.label, timings, grasps);
        self.span.in_scope(|| debug!(grasps, "request succeeded"));
        self.recent.add(self.id.clone(), self.label.clone(), outcome);
        self.ended = true;
    }

    /// Ends a call that needs no model, and records the outcome.
    pub fn finish_without_model<T>(mut self, outcome: Result<T, Refusal>) -> Result<T, Refusal> {
        let value = match outcome {
            Ok(value) => value,
            Err(refusal) => return Err(self.end(refusal)),
        };
        self.metrics.ended(&self.label, Code::Ok);
        self.span.in_scope(|| debug!("request succeeded"));
        self.ended = true;
        Ok(value)
    }

    /// Ends the call with a refusal.
    pub fn end(mut self, refusal: Refusal) -> Refusal {
        self.metrics.ended(&self.label, refusal.code());
        if refusal.code() == Code::Internal {
            self.span.record("otel.status_code", "ERROR");
        }
        let outcome = Outcome::Refused { code: refusal.code(), message: refusal.to_string() };
        self.recent.add(self.id.clone(), self.label.clone(), outcome);
        self.span.in_scope(|| match refusal.code() {
            Code::Internal => error!(code = ?Code::Internal, %refusal, "refused"),
            code => info!(?code, %refusal, "refused"),
        });
        self.ended = true;
        refusal
    }

    pub fn span(&self) -> &Span {
        &self.span
    }

    /// The warnings of the reply, which are logged and counted.
    pub fn warned(&self, warnings: &[Warning]) -> Vec<pb::GeometryWarning> {
        let warnings: Vec<pb::GeometryWarning> = warnings.iter().map(Into::into).collect();
        for warning in &warnings {
            self.metrics.warned(&self.label, warning.code());
            self.span.in_scope(|| debug!(code = warning.code().as_str_name(), "{}", warning.message));
        }
        warnings
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if !self.ended {
            let expired = self.deadline.is_some_and(Deadline::has_passed);
            let (code, reason) = if expired {
                (Code::DeadlineExceeded, "the deadline has passed")
            } else {
                (Code::Cancelled, "cancelled by the client")
            };
            self.metrics.ended(&self.label, code);
            self.span.in_scope(|| info!(?code, "{reason}"));
        }
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
