//! The clutter-removal benchmark: a planner's best grasp is executed repeatedly until the table is empty, no object is
//! visible, no grasp is proposed, or two grasps in a row fail.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Grasp, MAX_OPENING};
use grasp_models::Options;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::camera::{DepthNoise, Views, observe};
use crate::objects::ObjectSet;
use crate::ordered;
use crate::physics::World;
use crate::planner::{BenchPlanner, Observation, PlannerSpec};
use crate::scene::{SceneKind, generate, settle};
use crate::trial::{Outcome, execute};

/// Consecutive failures that end a round.
const MAX_FAILURES: usize = 2;

/// Scenes and cameras of a benchmark. The scenes do not depend on the planner.
#[derive(Clone, Debug)]
pub struct Benchmark {
    /// Pile or packed.
    pub kind: SceneKind,
    /// Objects of the scenes.
    pub objects: ObjectSet,
    /// Initial number of objects of a scene.
    pub count: usize,
    /// Cameras that observe the scene before each grasp.
    pub views: Views,
    /// Depth noise of the observations.
    pub noise: DepthNoise,
    /// Number of scenes.
    pub rounds: u64,
    /// Seed of the scenes.
    pub seed: u64,
}

/// Why a round ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The table is empty.
    Cleared,
    /// The cameras see no object.
    NothingSeen,
    /// The planner proposed no grasp.
    NothingProposed,
    /// Two consecutive failures.
    GaveUp,
}

/// The result of a round.
#[derive(Clone, Debug)]
pub struct Round {
    /// Objects on the table at the start.
    pub objects: usize,
    /// Executed grasps.
    pub attempts: Vec<Attempt>,
    /// Why the round ended.
    pub ending: Ending,
    /// Fusion time of each observation.
    pub fusion: Vec<Duration>,
    /// Planning time of each observation: network and post-processing, without fusion.
    pub planning: Vec<Duration>,
}

/// An executed grasp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attempt {
    /// The grasp.
    pub grasp: Grasp,
    /// Its outcome.
    pub outcome: Outcome,
    /// Distance from the grasp at which the hand closed because its approach was in contact, metres; else 0.
    pub short_by: f64,
    /// Room beside each finger of the open hand at the narrower horizontal side of the standing object nearest to the
    /// grasp, metres; below 0 if the object does not fit. `None` without an object nearby.
    pub room: Option<f64>,
}

/// Progress of a running benchmark.
pub enum Event<'a> {
    /// A grasp was executed.
    Attempt {
        /// Number of the round.
        round: u64,
        /// Number of the attempt in it.
        number: usize,
        /// The scene before the attempt.
        before: &'a World,
        /// All proposed grasps, the executed one first.
        proposals: &'a [Grasp],
        /// The executed grasp and its outcome.
        attempt: &'a Attempt,
    },
    /// A round has ended.
    Round,
}

impl Benchmark {
    /// Runs every round, on all cores. `watch` receives the events. Once `is_stopped` is set, rounds that have not ended
    /// are left out.
    ///
    /// # Errors
    /// The first error of a planner.
    pub fn run(
        &self,
        planner: &PlannerSpec,
        params: &DecodeParams,
        options: &Options,
        is_stopped: &AtomicBool,
        watch: impl Fn(Event<'_>) + Sync,
    ) -> anyhow::Result<Vec<Round>> {
        // Idle planners are reused, so that there are at most as many planners as threads.
        let idle = Mutex::new(Vec::new());
        let idle = || idle.lock().unwrap_or_else(PoisonError::into_inner);
        let run = |number| {
            if is_stopped.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let waiting = idle().pop();
            let mut planner = waiting.map_or_else(|| planner.build(params, options), Ok)?;
            let round = self.round(number, &mut planner, is_stopped, &watch);
            idle().push(planner);
            watch(Event::Round);
            round
        };
        let mut rounds = Vec::new();
        ordered::for_each(0..self.rounds, run, |_, round: anyhow::Result<Option<Round>>| {
            rounds.extend(round?);
            anyhow::Ok(())
        })?;
        Ok(rounds)
    }

    /// The scene of a round, and the random generator for the rest of the round.
    #[must_use]
    pub fn scene(&self, number: u64) -> (World, ChaCha8Rng) {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(number);
        let world = generate(self.kind, &self.objects, self.count, &mut rng);
        (world, rng)
    }

    /// Observes a scene; `None` if the cameras see no object.
    #[must_use]
    pub fn observe(&self, world: &World, rng: &mut ChaCha8Rng) -> Option<Observation> {
        Observation::new(observe(world, &self.views, self.noise, rng))
    }

    /// Runs a round; `None` if it was stopped.
    fn round(
        &self,
        number: u64,
        planner: &mut BenchPlanner,
        is_stopped: &AtomicBool,
        watch: impl Fn(Event<'_>),
    ) -> anyhow::Result<Option<Round>> {
        let (mut world, mut rng) = self.scene(number);
        let mut round = Round {
            objects: world.objects().len(),
            attempts: vec![],
            ending: Ending::Cleared,
            fusion: vec![],
            planning: vec![],
        };
        let mut failures = 0;
        while !world.objects().is_empty() {
            if is_stopped.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let Some(observation) = self.observe(&world, &mut rng) else {
                round.ending = Ending::NothingSeen;
                break;
            };
            round.fusion.push(observation.fusion);
            let start = Instant::now();
            let grasps = planner.plan(&observation, &mut rng)?;
            round.planning.push(start.elapsed());
            let Some(best) = grasps.first() else {
                round.ending = Ending::NothingProposed;
                break;
            };
            let before = world.clone();
            let (outcome, short_by) = execute(&mut world, &best.pose);
            let nearest = before.nearest(&best.pose.translation.vector.into()).map(|index| &before.objects()[index]);
            let room = nearest.map(|body| {
                let sides = body.object.visual.extents() * body.scale;
                (MAX_OPENING - sides.x.min(sides.y)) / 2.0
            });
            let attempt = Attempt { grasp: *best, outcome, short_by, room };
            watch(Event::Attempt {
                round: number,
                number: round.attempts.len(),
                before: &before,
                proposals: &grasps,
                attempt: &attempt,
            });
            round.attempts.push(attempt);
            if let Outcome::Lifted { object, .. } = outcome {
                world.remove(object);
                failures = 0;
            } else {
                failures += 1;
            }
            if failures == MAX_FAILURES {
                round.ending = Ending::GaveUp;
                break;
            }
            settle(&mut world);
        }
        Ok(Some(round))
    }
}
