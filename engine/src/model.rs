use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use anyhow::Context;
use grasp::{Candidate, Code, DetectParams, RequestError, Volume};
use grasp_models::{Backend, Options};
use grasp_perception::{InputGrid, Scene};
use grasp_planner::ModelSpec;
use tracing::{Span, info};

use crate::detection::{Detection, Scores};
use crate::fair_queue::RequestMetadata;
use crate::job::{Job, Reply, Sender, Task, Tensors, failed, no_session};
use crate::observer::{ModelLabels, ModelObserver, Observer, Refusal};
use crate::retry_hints::RetryHints;
use crate::scheduler::{Batching, Refused, Scheduler};
use crate::service_time::ServiceTime;
use crate::session::Session;
use crate::session_health::SessionHealth;
use crate::session_threads::SessionThreads;
use crate::timings::Statistics;

/// A served model with its queue. Its session threads end when it is dropped.
pub struct Model {
    /// What is served.
    pub spec: ModelSpec,
    /// `name version`, used in the log and the metrics.
    pub label: String,
    /// What runs it.
    pub backend: Backend,
    /// The grid that it reads.
    pub input: InputGrid,
    /// Its requests so far.
    pub statistics: Arc<Statistics>,
    sessions: usize,
    scheduler: Arc<Scheduler<Job>>,
    /// One per session.
    health: Vec<Arc<SessionHealth>>,
    service_time: Arc<ServiceTime>,
    retry_hints: RetryHints,
    observer: Arc<dyn ModelObserver>,
}

/// Settings that all models share.
#[derive(Clone, Copy, Debug)]
pub struct ModelSettings {
    /// How models are loaded.
    pub options: Options,
    /// Queue length, requests.
    pub capacity: usize,
    /// How sessions form batches.
    pub batching: Batching,
}

impl Model {
    /// Loads and warms up the sessions, and starts their threads.
    pub(crate) fn start(
        spec: ModelSpec,
        settings: &ModelSettings,
        observer: &dyn Observer,
        threads: &SessionThreads,
    ) -> anyhow::Result<Self> {
        let ModelSettings { options, capacity, batching } = *settings;
        let label = format!("{} {}", spec.name(), spec.version());
        let started = Instant::now();
        let (planners, backend) = spec.load(&options)?;
        let sessions = planners.len();
        let observer = observer.model(&label);
        // Created before the threads, so that an early return drops it, which closes the queue and ends started
        // threads.
        let model = Self {
            input: spec.input(),
            spec,
            label,
            backend,
            statistics: Arc::default(),
            sessions,
            scheduler: Arc::new(Scheduler::new(sessions, capacity, Some(Arc::clone(&observer)))),
            health: planners.iter().map(|_| Arc::new(SessionHealth::new(Arc::clone(&observer)))).collect(),
            service_time: Arc::new(ServiceTime::new(Duration::ZERO)),
            retry_hints: RetryHints::default(),
            observer,
        };
        for (index, planner) in planners.into_iter().enumerate() {
            let (warmed_up, warm_up) = mpsc::sync_channel(1);
            let session = Session {
                planner,
                defaults: model.spec.decode_params(),
                scheduler: Arc::clone(&model.scheduler),
                batching,
                observer: Arc::clone(&model.observer),
                statistics: Arc::clone(&model.statistics),
                health: Arc::clone(&model.health[index]),
                service_time: Arc::clone(&model.service_time),
                warmed_up,
            };
            let name = format!("{} {index}", model.spec.name());
            threads.spawn(name, session, &model.health, index).with_context(|| {
                format!("cannot start thread {index} of {sessions} for the model {}; lower --workers", model.label)
            })?;
            // One session after another, because others must not allocate memory while one records its CUDA graphs.
            let time = warm_up.recv().map_err(|_| failed("the session ended")).flatten();
            let failed = || format!("the warm-up inference of the model {} failed", model.label);
            model.service_time.start_with(time.with_context(failed)?);
        }
        let Backend { provider, precision, cuda_graph } = backend;
        let (threads, duration) = (options.threads(), started.elapsed());
        info!(
            model = model.label,
            sha256 = model.spec.sha256(),
            %provider,
            %precision,
            cuda_graph,
            sessions,
            threads,
            took = ?duration,
            "model loaded"
        );
        Ok(model)
    }

    /// Queues the scenes of a request for grasp detection. Refuses all of them immediately if the queue is full.
    ///
    /// # Errors
    /// [`RequestError`] if the queue is full, or the reply would be too late.
    pub fn detect(
        &self,
        scenes: Vec<Scene>,
        params: &Arc<DetectParams>,
        request: RequestMetadata,
        span: &Span,
    ) -> Result<Vec<Reply<Detection>>, RequestError> {
        self.push(scenes, |sender| Task::Grasps(Arc::clone(params), sender), request, span)
    }

    /// Queues the scenes of a request whose candidates are to be scored, like [`detect`](Self::detect).
    ///
    /// # Errors
    /// [`RequestError`] if the queue is full, or the reply would be too late.
    pub fn score(
        &self,
        scenes: Vec<Scene>,
        candidates: &Arc<[Candidate]>,
        params: &Arc<DetectParams>,
        request: RequestMetadata,
        span: &Span,
    ) -> Result<Vec<Reply<Scores>>, RequestError> {
        let task = |sender| Task::Scores(Arc::clone(params), Arc::clone(candidates), sender);
        self.push(scenes, task, request, span)
    }

    /// Queues the volumes of a request for the network's raw output, like [`detect`](Self::detect).
    ///
    /// # Errors
    /// [`RequestError`] if the queue is full, or the reply would be too late.
    pub fn maps(
        &self,
        volumes: Vec<Volume>,
        request: RequestMetadata,
        span: &Span,
    ) -> Result<Vec<Reply<Tensors>>, RequestError> {
        self.push(volumes.into_iter().map(Scene::from).collect(), Task::Maps, request, span)
    }

    /// What identifies the model.
    #[must_use]
    pub fn labels(&self) -> ModelLabels {
        let Backend { provider, precision, .. } = self.backend;
        ModelLabels {
            model: self.label.clone(),
            provider: provider.to_string(),
            precision: precision.to_string(),
            sha256: self.spec.sha256().to_owned(),
        }
    }

    /// Whether a session neither hangs in an inference nor fails each one.
    #[must_use]
    pub fn is_healthy(&self) -> bool {
        self.health.iter().any(|session| session.is_healthy())
    }

    /// Whether every session hangs in an inference.
    fn is_hanging(&self) -> bool {
        self.health.iter().all(|session| session.is_hanging())
    }

    /// When the latest inference ended, milliseconds since 1970; 0 if there was none.
    #[must_use]
    pub fn latest_inference(&self) -> u64 {
        self.health.iter().map(|session| session.latest()).max().unwrap_or(0)
    }

    /// Queue length, requests.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.scheduler.capacity()
    }

    /// Checks that a volume has the voxel size that the network was trained with; another size would scale the scene.
    ///
    /// # Errors
    /// [`RequestError`] names the voxel size.
    pub fn check_voxel_size(&self, volume: &Volume) -> Result<(), RequestError> {
        let Some(network) = self.input.network else { return Ok(()) };
        let (actual, trained) = (volume.voxel_size(), network.voxel_size);
        if (actual - trained).abs() <= 1e-3 * trained {
            return Ok(());
        }
        let needed = format_args!("must be {trained} m (±0.1 %) for the model {}", self.label);
        Err(RequestError::invalid("volume.voxel_size", actual, needed))
    }

    /// Checks that the cubes of one workspace fit into an empty queue.
    ///
    /// # Errors
    /// [`RequestError`] names the extent of the workspace.
    pub fn check_cubes(&self, cubes: usize) -> Result<(), RequestError> {
        let places = self.capacity() + self.sessions;
        if cubes <= places {
            return Ok(());
        }
        let value = format_args!("a workspace of {cubes} cubes with objects");
        let needed = format_args!("must have at most {places}, the places of the model's queue (--queue)");
        Err(RequestError::invalid("workspace.extent", value, needed))
    }

    /// Refuses a request with this number of scenes that the queue would refuse now, before its data are converted and
    /// fused.
    ///
    /// # Errors
    /// [`RequestError`] if the queue is full, or the reply would be too late.
    pub fn check_capacity(&self, scenes: usize, request: RequestMetadata) -> Result<(), RequestError> {
        if self.is_hanging() {
            return Err(no_session());
        }
        let checked = self.scheduler.check(scenes, request, self.service_time.get());
        checked.map_err(|refused| self.refused(&refused, scenes))
    }

    /// Queues the scenes of a request. `task` says what to compute from one of them, for the receiver of its result.
    fn push<T: Send + 'static>(
        &self,
        scenes: Vec<Scene>,
        task: impl Fn(Sender<T>) -> Task,
        request: RequestMetadata,
        span: &Span,
    ) -> Result<Vec<Reply<T>>, RequestError> {
        if self.is_hanging() {
            return Err(no_session());
        }
        let job = |scene| {
            let (sender, receiver) = Sender::new();
            let submitted = Instant::now();
            (Job { scene, task: task(sender), deadline: request.deadline, span: span.clone(), submitted }, receiver)
        };
        let (jobs, receivers): (Vec<_>, Vec<_>) = scenes.into_iter().map(job).unzip();
        // The queue is open: only dropping the model closes it.
        let pushed = self.scheduler.push(jobs, request, self.service_time.get());
        let (slots, displaced) = pushed.map_err(|refused| self.refused(&refused, receivers.len()))?;
        self.observer.accepted(request.priority, slots.len());
        for job in displaced {
            job.task.fail(self.refuse(Refusal::Displaced, &self.queue_is_full(1)));
        }
        Ok(receivers.into_iter().zip(slots).map(|(receiver, slot)| Reply::new(receiver, slot)).collect())
    }

    /// The error for a request with this number of scenes.
    fn refused(&self, refused: &Refused, scenes: usize) -> RequestError {
        match refused {
            Refused::Full => self.refuse(Refusal::Full, &self.queue_is_full(scenes)),
            Refused::TooLate(estimate) => {
                let (name, waiting) = (self.spec.name(), self.scheduler.waiting());
                let reason = format!(
                    "deadline too short: expected wait {estimate:.0?}, with {waiting} requests waiting for the model \
                     `{name}`"
                );
                self.refuse(Refusal::Deadline, &reason)
            }
        }
    }

    fn queue_is_full(&self, scenes: usize) -> String {
        let (name, capacity) = (self.spec.name(), self.capacity());
        match scenes {
            1 => format!("the queue of the model `{name}` is full ({capacity} requests)"),
            _ => format!("the queue of the model `{name}` has too few free places for {scenes} scenes (of {capacity})"),
        }
    }

    /// Counts a refusal, and returns its error with the reason.
    pub(crate) fn refuse(&self, refusal: Refusal, reason: &str) -> RequestError {
        self.observer.refused(refusal);
        match refusal {
            Refusal::Full | Refusal::Deadline => self.overloaded(reason),
            Refusal::Displaced => self.overloaded(&format!(
                "{reason}, and this request was displaced by one with a higher priority, or from a caller with fewer \
                 requests"
            )),
        }
    }

    /// An error with a retry hint.
    #[must_use]
    pub fn overloaded(&self, reason: &str) -> RequestError {
        let pace = self.service_time.get().mean / u32::try_from(self.sessions).unwrap_or(u32::MAX);
        let places = u32::try_from(self.capacity() + self.sessions).unwrap_or(u32::MAX);
        let after = self.retry_hints.next(pace, places, Instant::now());
        RequestError::new(Code::ResourceExhausted, format!("{reason}; retry after {after:?}")).after(after)
    }
}

impl Drop for Model {
    fn drop(&mut self) {
        self.scheduler.close();
    }
}
