//! Session threads: each owns a planner, takes jobs from its model's queue, and answers them.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Decoded, Obstacles, Volume, decode};
use grasp_models::{Output, batch_sizes};
use grasp_planner::{Loaded, NetworkPlanner, PlanParams, Planner};
use grasp_proto::{Collision, DetectParams};
use nalgebra::Isometry3;
use prometheus::Histogram;
use tracing::error;

use super::engine::{Detection, EngineError, Job, Sender, ServiceTime, SessionOutput, Task, Tensors};
use super::queue::{Batching, Queue};
use crate::transport::deadline::Deadline;

/// A thread's own planner and its end of the queue.
pub(super) struct Session {
    pub planner: Loaded,
    /// How its grasps are chosen, unless a request says otherwise.
    pub own: DecodeParams,
    pub queue: Arc<Queue<Job>>,
    pub batching: Batching,
    pub batch: Histogram,
    pub service_time: Arc<ServiceTime>,
}

/// When a session took its jobs, and how long the work on all of them took.
#[derive(Clone, Copy)]
struct Taken {
    at: Instant,
    inference: Duration,
}

impl Session {
    pub fn run(mut self) {
        let alone = Batching { max: 1, delay: Duration::ZERO };
        let batching = if matches!(self.planner, Loaded::Single(_)) { alone } else { self.batching };
        while let Some(mut jobs) = self.queue.take(batching) {
            let now = Instant::now();
            let expired = |job: &mut Job| job.deadline.is_some_and(|Deadline(deadline)| deadline <= now);
            for job in jobs.extract_if(.., expired) {
                // The caller's own timer may have been faster.
                job.task.fail(EngineError::Expired);
            }
            // Whoever has gone has left the queue, but for those who went this very moment.
            jobs.retain(|job| !job.task.is_closed());
            if jobs.is_empty() {
                self.queue.free();
                continue;
            }
            self.batch.observe(jobs.len() as f64);
            let Self { planner, own, queue, service_time, .. } = &mut self;
            let scenes = u32::try_from(jobs.len()).unwrap_or(u32::MAX);
            let done = |inference: Duration| {
                queue.free();
                Taken { at: now, inference }
            };
            match planner {
                Loaded::Network(network) => infer(network, *own, jobs, done),
                // One at a time: there is nothing to share.
                Loaded::Single(planner) => {
                    if let Some(job) = jobs.pop() {
                        plan(planner.as_mut(), *own, job, done);
                    }
                }
            }
            // A place in the queue is free as often as a scene is done, with all that belongs to it.
            service_time.set(now.elapsed() / scenes);
        }
    }
}

/// Runs the network over the batch, then makes of each output what is asked for.
fn infer(network: &mut NetworkPlanner, own: DecodeParams, jobs: Vec<Job>, done: impl FnOnce(Duration) -> Taken) {
    let started = Instant::now();
    let volumes: Vec<&Volume> = jobs.iter().map(|job| &job.scene.volume).collect();
    let output = caught(|| Ok(network.infer(&volumes)?));
    let taken = done(started.elapsed());
    for (index, Job { scene, task, deadline, span, submitted }) in jobs.into_iter().enumerate() {
        let _entered = span.enter();
        if task.is_closed() || deadline.is_some_and(Deadline::has_passed) {
            // Those behind it in the batch need not wait for what nobody does.
            task.fail(EngineError::Expired);
            continue;
        }
        let output = match &output {
            Ok(output) => output,
            Err(error) => {
                error!(%error, "the session failed");
                task.fail(error.clone());
                continue;
            }
        };
        match task {
            Task::Grasps(params, reply) => answer(reply, submitted, taken, || {
                let decoded = decode(&scene.volume, &output.maps(index), &params.decode_params(own))?;
                Ok(found(decoded, scene.volume, &params))
            }),
            Task::Maps(reply) => answer(reply, submitted, taken, || Ok(tensors(output, index))),
        }
    }
}

/// Has a planner without a network look at a scene.
fn plan(planner: &mut dyn Planner, own: DecodeParams, job: Job, done: impl FnOnce(Duration) -> Taken) {
    let Job { scene, task, deadline, span, submitted } = job;
    let _entered = span.enter();
    match task {
        Task::Grasps(params, reply) => {
            let started = Instant::now();
            let wanted = || !reply.is_closed() && !deadline.is_some_and(Deadline::has_passed);
            let decoded = caught(|| {
                let params = PlanParams { decode: params.decode_params(own), table: params.table };
                Ok(planner.plan(&scene, &params, &wanted)?)
            });
            let taken = done(started.elapsed());
            answer(reply, submitted, taken, || Ok(found(decoded?, scene.volume, &params)));
        }
        Task::Maps(_) => {
            done(Duration::ZERO);
            task.fail(EngineError::NoNetwork);
        }
    }
}

/// Makes something and sends it to who asked for it.
fn answer<T>(reply: Sender<T>, submitted: Instant, taken: Taken, make: impl FnOnce() -> Result<T, EngineError>) {
    let started = Instant::now();
    let made = caught(make);
    // Nobody waits for what came too late.
    if let Err(error) = &made
        && !matches!(error, EngineError::Expired)
    {
        error!(%error, "the session failed");
    }
    let Taken { at, inference } = taken;
    let (queue, postprocessing) = (at.duration_since(submitted), started.elapsed());
    // The caller may have gone meanwhile, which is counted on their side.
    let _ = reply.send(made.map(|made| SessionOutput { made, queue, inference, postprocessing }));
}

/// As many of the grasps as were asked for, and whether the hand would meet something there.
fn found(decoded: Decoded, volume: Volume, params: &DetectParams) -> Detection {
    let Decoded { mut grasps, dropped } = decoded;
    let over_limit = grasps.len().saturating_sub(params.max_grasps);
    grasps.truncate(params.max_grasps);
    let collides = (params.collision == Collision::Flag).then(|| {
        let obstacles = Obstacles::observed(&volume, params.clearance());
        grasps.iter().map(|grasp| obstacles.meet(&grasp.pose)).collect()
    });
    Detection { grasps, collides, dropped, over_limit, volume }
}

fn tensors(output: &Output, index: usize) -> Tensors {
    let maps = output.maps(index);
    Tensors(
        [maps.quality, maps.rotation, maps.width].map(|map| map.iter().flat_map(|value| value.to_le_bytes()).collect()),
    )
}

/// Has a network answer a batch of each size, and says how long a single volume takes: the first inference of a size
/// allocates and tunes, no caller should wait for that.
pub(super) fn warm_up(network: &mut NetworkPlanner, max_batch: usize) -> Result<Duration, EngineError> {
    let metadata = network.network().metadata();
    let values = vec![0.5; metadata.resolution.pow(3)];
    let volume = Volume::new(metadata.resolution, metadata.voxel_size, Isometry3::identity(), values);
    let resolution = metadata.resolution;
    let volume = volume.expect("metadata has a positive resolution and voxel size, and 0.5 is a surface");
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

/// Turns a panic into an error of the one request that it happened in. The network's buffers are written anew for each
/// volume, so what the panic leaves in them does no harm.
fn caught<T>(work: impl FnOnce() -> Result<T, EngineError>) -> Result<T, EngineError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Err(EngineError::Panic(text.unwrap_or("without a message").to_owned()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error_with_its_message() {
        let message = |work: fn() -> Result<(), EngineError>| caught(work).unwrap_err().to_string();
        assert_eq!(message(|| panic!("index {} of {}", 5, 4)), "the session panicked: index 5 of 4");
        assert_eq!(message(|| panic!("plain")), "the session panicked: plain");
        assert_eq!(message(|| std::panic::panic_any(7)), "the session panicked: without a message");
        assert!(caught(|| Ok(())).is_ok());
    }
}
