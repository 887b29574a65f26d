//! Session threads: each owns a planner, takes jobs from its model's queue, and sends the results.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use grasp::{Code, DecodeParams, RequestError, Volume};
use grasp_models::batch_sizes;
use grasp_planner::{Inference, Loaded, NetworkPlanner, PlanParams, Planner};
use nalgebra::Isometry3;
use tracing::{Span, error};

use crate::detection::{Detection, Scores};
use crate::job::{Job, Sender, SessionOutput, Task, Tensors, failed, has_passed};
use crate::observer::ModelObserver;
use crate::scheduler::{Batching, Scheduler};
use crate::service_time::ServiceTime;
use crate::session_health::SessionHealth;
use crate::timings::Statistics;

/// The state of a session thread.
pub(crate) struct Session {
    pub planner: Loaded,
    /// Decoding parameters for requests without their own.
    pub defaults: DecodeParams,
    pub scheduler: Arc<Scheduler<Job>>,
    pub batching: Batching,
    pub observer: Arc<dyn ModelObserver>,
    pub statistics: Arc<Statistics>,
    pub health: Arc<SessionHealth>,
    pub service_time: Arc<ServiceTime>,
    /// Receives the time of one volume in the warm-up.
    pub warmed_up: mpsc::SyncSender<Result<Duration, RequestError>>,
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
    health: &'a SessionHealth,
    /// None when the session counts as idle again.
    scheduler: Option<&'a Scheduler<Job>>,
    /// Whether a scene succeeded; None if none of them succeeded or failed.
    succeeded: Option<bool>,
}

impl Batch<'_> {
    /// Counts the time of the batch although its result is not sent, if it is longer than expected: otherwise the
    /// expected time would never grow if all jobs expire. The time of an inference that hung is not counted, because it
    /// is not typical.
    fn note_delay(&self) {
        let time = self.taken.elapsed();
        if time > self.service_time.get().long && !self.health.is_hanging() {
            self.service_time.add(time, self.scenes);
        }
    }

    /// Counts the outcome of a scene. Requests that expired are not counted: the session did not fail.
    fn note_outcome(&mut self, error: Option<&RequestError>) {
        match error {
            None => self.succeeded = Some(true),
            Some(error) if error.code == Code::Internal => _ = self.succeeded.get_or_insert(false),
            Some(_) => {}
        }
    }

    fn free(&mut self) {
        if let Some(scheduler) = self.scheduler.take() {
            scheduler.free();
        }
    }
}

impl Drop for Batch<'_> {
    fn drop(&mut self) {
        self.free();
        if let Some(succeeded) = self.succeeded {
            self.health.computed(succeeded);
        }
    }
}

impl Session {
    /// Warms the planner up, and serves the queue until it is closed. Both on this thread, because a CUDA graph belongs
    /// to the thread that has recorded it.
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
        while let Some(mut jobs) = self.scheduler.take(batching) {
            let now = Instant::now();
            // While other jobs wait, a job that would end after its deadline is dropped before its inference.
            let long = self.service_time.get().long;
            let until = if self.scheduler.waiting() > 0 { now + long } else { now };
            let expired = |job: &mut Job| job.deadline.is_some_and(|deadline| deadline <= until);
            for job in jobs.extract_if(.., expired) {
                job.task.fail(if has_passed(job.deadline) {
                    RequestError::expired()
                } else {
                    let message = format!("deadline too short: the inference takes about {long:.0?}");
                    RequestError::new(Code::DeadlineExceeded, message)
                });
            }
            // Cancelled jobs leave the queue on their own, except those that are cancelled while they are taken.
            jobs.retain(|job| !job.task.is_closed());
            if jobs.is_empty() {
                self.scheduler.free();
                continue;
            }
            self.observer.batch(jobs.len());
            self.statistics.batch(jobs.len());
            let Self { planner, defaults, scheduler, health, service_time, .. } = &mut self;
            let _ended = health.begin(&jobs);
            let scenes = u32::try_from(jobs.len()).unwrap_or(u32::MAX);
            let batch = Batch {
                taken: now,
                inference: Duration::ZERO,
                scenes,
                service_time,
                health,
                scheduler: Some(scheduler),
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
    let mut output = caught(|| network.infer(&volumes).map_err(failed));
    batch.inference = started.elapsed();
    for (index, Job { scene, task, deadline, span, submitted }) in jobs.into_iter().enumerate() {
        if task.is_closed() || has_passed(deadline) {
            // Skips the decoding, so that the other jobs of the batch finish earlier.
            batch.note_delay();
            batch.free();
            task.fail(RequestError::expired());
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
                        let is_wanted = || !reply.is_closed() && !has_passed(deadline);
                        let decode = params.decode_params(defaults, scene.region);
                        let params = PlanParams { decode, table: params.table };
                        Ok(output.decode(index, &scene, &params, &is_wanted)?)
                    })
                });
                let detection = || Ok(Detection::new(decoded?, scene.volume, &params));
                send_result(reply, span, submitted, &mut batch, started, output.evaluation(), detection);
            }
            Task::Scores(params, candidates, reply) => {
                let decode = params.decode_params(defaults, scene.region);
                let poses: Vec<_> = candidates.iter().map(|candidate| candidate.pose).collect();
                let plan = PlanParams { decode, table: params.table };
                let qualities = span.in_scope(|| caught(|| Ok(output.score(index, &scene.volume, &poses, &plan)?)));
                let scores = || Ok(Scores::new(&candidates, qualities?, &scene, &params, decode.threshold));
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
            let is_wanted = || !reply.is_closed() && !has_passed(deadline);
            let decoded = span.in_scope(|| {
                caught(|| {
                    let params =
                        PlanParams { decode: params.decode_params(defaults, scene.region), table: params.table };
                    Ok(planner.plan(&scene, &params, &is_wanted)?)
                })
            });
            batch.inference = started.elapsed();
            let detection = || Ok(Detection::new(decoded?, scene.volume, &params));
            send_result(reply, span, submitted, &mut batch, Instant::now(), None, detection);
        }
        Task::Maps(_) | Task::Scores(..) => {
            batch.free();
            task.fail(RequestError::new(
                Code::Internal,
                "the planner has no network, which ModelInfer and ScoreGrasps require",
            ));
        }
    }
}

/// Ends the post-processing, which began at `started` and contains the evaluation, and sends its result. The job's part
/// of the span ends before that: otherwise a server that stops after the reply could lose the span.
fn send_result<T: Send + 'static>(
    reply: Sender<T>,
    span: Span,
    submitted: Instant,
    batch: &mut Batch<'_>,
    started: Instant,
    evaluation: Option<Duration>,
    postprocess: impl FnOnce() -> Result<T, RequestError>,
) {
    let result = span.in_scope(|| {
        caught(postprocess).inspect_err(|error| {
            // Expired requests are logged by their call.
            if error.code == Code::Internal {
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
fn warm_up(network: &mut NetworkPlanner, max_batch: usize) -> Result<Duration, RequestError> {
    let metadata = network.network().metadata();
    let values = vec![0.5; metadata.resolution.pow(3)];
    let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
    let resolution = metadata.resolution;
    let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a valid value");
    caught(|| {
        for size in batch_sizes(max_batch) {
            let output = network.infer(&vec![&volume; size]).map_err(failed)?;
            (0..size).try_for_each(|index| output.maps(index).check(resolution)).map_err(failed)?;
        }
        let started = Instant::now();
        network.infer(&[&volume]).map_err(failed)?;
        Ok(started.elapsed())
    })
}

/// Converts a panic to an error, so that the session thread continues. A panic cannot corrupt the network's buffers for
/// later batches: each inference overwrites them.
fn caught<T>(work: impl FnOnce() -> Result<T, RequestError>) -> Result<T, RequestError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Err(RequestError::new(Code::Internal, format!("the session panicked: {}", text.unwrap_or("no message"))))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error_with_its_message() {
        let message = |work: fn() -> Result<(), RequestError>| caught(work).unwrap_err().to_string();
        assert_eq!(message(|| panic!("index {} of {}", 5, 4)), "the session panicked: index 5 of 4");
        assert_eq!(message(|| panic!("plain")), "the session panicked: plain");
        assert_eq!(message(|| std::panic::panic_any(7)), "the session panicked: no message");
        assert!(caught(|| Ok(())).is_ok());
    }
}
