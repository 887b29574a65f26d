//! Session threads: each owns a planner, takes jobs from its model's queue, and sends the results.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Volume};
use grasp_models::batch_sizes;
use grasp_planner::{Inference, Loaded, NetworkPlanner, PlanParams, Planner};
use nalgebra::Isometry3;
use prometheus::Histogram;
use tracing::{Span, error};

use super::detection::{Detection, Score};
use super::job::{EngineError, Job, Sender, SessionOutput, Task, Tensors};
use super::queue::{Batching, Queue, Service};
use super::session_threads::Running;
use crate::transport::deadline::Deadline;

/// The state of a session thread.
pub(super) struct Session {
    pub planner: Loaded,
    /// Decoding parameters for requests without their own.
    pub defaults: DecodeParams,
    pub queue: Arc<Queue<Job>>,
    pub batching: Batching,
    pub batch: Histogram,
    pub running: Arc<Running>,
    pub service_time: Arc<ServiceTime>,
    /// For the time of one volume in the warm-up.
    pub warmed_up: mpsc::SyncSender<Result<Duration, EngineError>>,
}

/// Mean times of a scene and of a batch, in which the latest batches count most.
pub(super) struct ServiceTime(Mutex<Times>);

struct Times {
    /// The time of a batch divided by its number of scenes: how fast the queue advances.
    scene: Mean,
    /// How long a scene takes, because it is done with its batch.
    batch: Mean,
}

/// A mean, the mean deviation from it, and the number of the values.
#[derive(Clone, Copy)]
struct Mean {
    seconds: f64,
    deviation: f64,
    values: f64,
}

/// Number of values that the mean of the service time remembers.
const MEMORY: f64 = 8.0;

impl Mean {
    /// Adds a value. The first replaces the initial one.
    fn add(&mut self, seconds: f64) {
        self.values = (self.values + 1.0).min(MEMORY);
        let difference = seconds - self.seconds;
        // The difference from the initial value is no deviation.
        if self.values > 1.0 {
            self.deviation += (difference.abs() - self.deviation) / self.values;
        }
        self.seconds += difference / self.values;
    }
}

/// A batch that a session computes. The session counts as busy in its queue until it sends its first result, so that a
/// client that has received one finds a slot for its next request.
struct Batch<'a> {
    /// When the session took it from the queue.
    taken: Instant,
    /// How long its inference took.
    inference: Duration,
    /// Its number of scenes.
    scenes: u32,
    service_time: &'a ServiceTime,
    running: &'a Running,
    /// None when the session counts as idle again.
    queue: Option<&'a Queue<Job>>,
    /// Whether a scene succeeded; None if none of them succeeded or failed.
    succeeded: Option<bool>,
}

impl Batch<'_> {
    /// Counts the time of the batch although its result is not sent, if it is longer than expected: otherwise the
    /// expectation would not change if all jobs of the batches expire. The time of an inference that hung is not typical.
    fn note_delay(&self) {
        let time = self.taken.elapsed();
        if time > self.service_time.get().long && !self.running.is_hanging() {
            self.service_time.add(time, self.scenes);
        }
    }

    /// Counts the outcome of a scene. That of a request that has expired or cannot be decoded is not the session's.
    fn note_outcome(&mut self, error: Option<&EngineError>) {
        match error {
            None => self.succeeded = Some(true),
            Some(EngineError::Run(_) | EngineError::Panic(_)) => _ = self.succeeded.get_or_insert(false),
            Some(_) => {}
        }
    }

    fn free(&mut self) {
        if let Some(queue) = self.queue.take() {
            queue.free();
        }
    }
}

impl Drop for Batch<'_> {
    fn drop(&mut self) {
        self.free();
        if let Some(succeeded) = self.succeeded {
            self.running.computed(succeeded);
        }
    }
}

impl ServiceTime {
    /// The time of one scene in a batch of its own.
    pub fn new(duration: Duration) -> Self {
        let mean = Mean { seconds: duration.as_secs_f64(), deviation: 0.0, values: 0.0 };
        Self(Mutex::new(Times { scene: mean, batch: mean }))
    }

    /// Replaces the initial time.
    pub fn start_with(&self, duration: Duration) {
        let Self(times) = Self::new(duration);
        *self.times() = times.into_inner().unwrap_or_else(PoisonError::into_inner);
    }

    /// Adds the time of a batch.
    pub fn add(&self, duration: Duration, scenes: u32) {
        let mut times = self.times();
        times.scene.add(duration.as_secs_f64() / f64::from(scenes));
        times.batch.add(duration.as_secs_f64());
    }

    /// The mean is at least one millisecond, the unit of the retry hint. Two mean deviations above that of a batch are,
    /// for a normal distribution, exceeded by one in twenty.
    pub fn get(&self) -> Service {
        let Times { scene, batch } = *self.times();
        let mean = Duration::from_secs_f64(scene.seconds).max(Duration::from_millis(1));
        Service { mean, long: mean.max(Duration::from_secs_f64(batch.seconds + 2.0 * batch.deviation)) }
    }

    fn times(&self) -> MutexGuard<'_, Times> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Session {
    /// Warms the planner up, and serves the queue until it is closed. Both on this thread, because a CUDA graph belongs to
    /// the thread that has recorded it.
    pub fn run(mut self) {
        let warmed_up = match &mut self.planner {
            Loaded::Network(network) => warm_up(network, self.batching.max),
            Loaded::Single(_) => Ok(Duration::ZERO),
        };
        let failed = warmed_up.is_err();
        // If the receiver is gone, starting the model has failed, and the queue is closed.
        let _ = self.warmed_up.send(warmed_up);
        if failed {
            return;
        }
        let single = Batching { max: 1, delay: Duration::ZERO };
        let batching = if matches!(self.planner, Loaded::Single(_)) { single } else { self.batching };
        while let Some(mut jobs) = self.queue.take(batching) {
            let now = Instant::now();
            // While others wait, a job that would end after its deadline is dropped before its inference.
            let long = self.service_time.get().long;
            let until = if self.queue.waiting() > 0 { now + long } else { now };
            let expired = |job: &mut Job| job.deadline.is_some_and(|Deadline(deadline)| deadline <= until);
            for job in jobs.extract_if(.., expired) {
                let has_passed = job.deadline.is_some_and(Deadline::has_passed);
                job.task.fail(if has_passed { EngineError::Expired } else { EngineError::NoTimeLeft(long) });
            }
            // Cancelled jobs leave the queue on their own, except those that are cancelled while they are taken.
            jobs.retain(|job| !job.task.is_closed());
            if jobs.is_empty() {
                self.queue.free();
                continue;
            }
            self.batch.observe(jobs.len() as f64);
            let Self { planner, defaults, queue, running, service_time, .. } = &mut self;
            let _ended = running.begin(&jobs);
            let scenes = u32::try_from(jobs.len()).unwrap_or(u32::MAX);
            let batch = Batch {
                taken: now,
                inference: Duration::ZERO,
                scenes,
                service_time,
                running,
                queue: Some(queue),
                succeeded: None,
            };
            match planner {
                Loaded::Network(network) => infer(network, *defaults, jobs, batch),
                Loaded::Single(planner) => {
                    if let Some(job) = jobs.pop() {
                        plan(planner.as_mut(), *defaults, job, batch);
                    }
                }
            }
        }
    }
}

/// Runs the network on a batch, then decodes or returns each output.
fn infer(network: &mut NetworkPlanner, defaults: DecodeParams, jobs: Vec<Job>, mut batch: Batch<'_>) {
    let started = Instant::now();
    let volumes: Vec<&Volume> = jobs.iter().map(|job| &job.scene.volume).collect();
    let mut output = caught(|| Ok(network.infer(&volumes)?));
    batch.inference = started.elapsed();
    for (index, Job { scene, task, deadline, span, submitted }) in jobs.into_iter().enumerate() {
        if task.is_closed() || deadline.is_some_and(Deadline::has_passed) {
            // Skips the decoding, so that the other jobs of the batch finish earlier.
            batch.note_delay();
            batch.free();
            task.fail(EngineError::Expired);
            continue;
        }
        let output = match &mut output {
            Ok(output) => output,
            Err(error) => {
                span.in_scope(|| error!(%error, "the session failed"));
                drop(span);
                batch.free();
                batch.note_outcome(Some(error));
                task.fail(error.clone());
                continue;
            }
        };
        let started = Instant::now();
        match task {
            Task::Grasps(params, reply) => {
                let decoded = span.in_scope(|| {
                    caught(|| {
                        let is_wanted = || !reply.is_closed() && !deadline.is_some_and(Deadline::has_passed);
                        Ok(output.decode(index, &scene.volume, &params.decode_params(defaults), &is_wanted)?)
                    })
                });
                let detection = || Ok(Detection::of(decoded?, scene.volume, &params));
                send_result(reply, span, submitted, &mut batch, started, output.evaluation(), detection);
            }
            Task::Scores(params, candidates, reply) => {
                let decode = params.decode_params(defaults);
                let poses: Vec<_> = candidates.iter().map(|candidate| candidate.pose).collect();
                let qualities = span.in_scope(|| caught(|| Ok(output.score(index, &scene.volume, &poses, &decode)?)));
                let scores = || Ok(Score::of(&candidates, qualities?, &scene.volume, &params, decode.threshold));
                send_result(reply, span, submitted, &mut batch, started, output.evaluation(), scores);
            }
            Task::Maps(reply) => {
                send_result(reply, span, submitted, &mut batch, started, None, || Ok(tensors(output, index)))
            }
        }
    }
}

/// Runs a planner without a network on a scene.
fn plan(planner: &mut dyn Planner, defaults: DecodeParams, job: Job, mut batch: Batch<'_>) {
    let Job { scene, task, deadline, span, submitted } = job;
    match task {
        Task::Grasps(params, reply) => {
            let started = Instant::now();
            let keep_going = || !reply.is_closed() && !deadline.is_some_and(Deadline::has_passed);
            let decoded = span.in_scope(|| {
                caught(|| {
                    let params = PlanParams { decode: params.decode_params(defaults), table: params.table };
                    Ok(planner.plan(&scene, &params, &keep_going)?)
                })
            });
            batch.inference = started.elapsed();
            let detection = || Ok(Detection::of(decoded?, scene.volume, &params));
            send_result(reply, span, submitted, &mut batch, Instant::now(), None, detection);
        }
        Task::Maps(_) | Task::Scores(..) => {
            batch.free();
            task.fail(EngineError::NoNetwork);
        }
    }
}

/// Ends the post-processing, which began at `started` and contains the evaluation, and sends its result. The job's part
/// of the span ends before: otherwise a server that stops after the reply could lose the span.
fn send_result<T: Send + 'static>(
    reply: Sender<T>,
    span: Span,
    submitted: Instant,
    batch: &mut Batch<'_>,
    started: Instant,
    evaluation: Option<Duration>,
    postprocess: impl FnOnce() -> Result<T, EngineError>,
) {
    let result = span.in_scope(|| {
        caught(postprocess).inspect_err(|error| {
            // Expired requests are logged by their call.
            if !matches!(error, EngineError::Expired) {
                error!(%error, "the session failed");
            }
        })
    });
    drop(span);
    let Batch { taken, inference, scenes, service_time, .. } = *batch;
    // The time including decoding. Set before the reply, so that the next refusal already has it. The time of
    // a request that was cancelled, or failed because its inference hung, says nothing about the next one.
    if !reply.is_closed() {
        service_time.add(taken.elapsed(), scenes);
    }
    let queue = taken.duration_since(submitted);
    let postprocessing = started.elapsed().saturating_sub(evaluation.unwrap_or_default());
    batch.free();
    batch.note_outcome(result.as_ref().err());
    reply.send(result.map(|value| SessionOutput { value, queue, inference, evaluation, postprocessing }));
}

fn tensors(output: &Inference, index: usize) -> Tensors {
    let maps = output.maps(index);
    Tensors(
        [maps.quality, maps.rotation, maps.width].map(|map| map.iter().flat_map(|value| value.to_le_bytes()).collect()),
    )
}

/// Runs the network once for each batch size, because the first inference of a size allocates memory and tunes kernels.
/// Returns the time of one volume.
fn warm_up(network: &mut NetworkPlanner, max_batch: usize) -> Result<Duration, EngineError> {
    let metadata = network.network().metadata();
    let values = vec![0.5; metadata.resolution.pow(3)];
    let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
    let resolution = metadata.resolution;
    let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a valid value");
    caught(|| {
        for size in batch_sizes(max_batch) {
            let output = network.infer(&vec![&volume; size])?;
            (0..size).try_for_each(|index| output.maps(index).check(resolution))?;
        }
        let started = Instant::now();
        network.infer(&[&volume])?;
        Ok(started.elapsed())
    })
}

/// Converts a panic to an error, so that the session thread continues. A panic cannot corrupt the network's buffers for
/// later batches: each inference overwrites them.
fn caught<T>(work: impl FnOnce() -> Result<T, EngineError>) -> Result<T, EngineError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Err(EngineError::Panic(text.unwrap_or("no message").to_owned()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_takes_as_long_as_its_batch() {
        let times = ServiceTime::new(Duration::from_millis(5));
        assert_eq!(times.get(), Service { mean: Duration::from_millis(5), long: Duration::from_millis(5) });
        (0..20).for_each(|_| times.add(Duration::from_millis(800), 8));
        let Service { mean, long } = times.get();
        assert_eq!((mean.as_millis(), long.as_millis()), (100, 800));
    }

    #[test]
    fn a_panic_becomes_an_error_with_its_message() {
        let message = |work: fn() -> Result<(), EngineError>| caught(work).unwrap_err().to_string();
        assert_eq!(message(|| panic!("index {} of {}", 5, 4)), "the session panicked: index 5 of 4");
        assert_eq!(message(|| panic!("plain")), "the session panicked: plain");
        assert_eq!(message(|| std::panic::panic_any(7)), "the session panicked: no message");
        assert!(caught(|| Ok(())).is_ok());
    }
}
