//! The clutter-removal benchmark: grasp after grasp until a table is empty, or nothing works any more.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use grasp::DecodeParams;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;

use crate::camera::{Views, observe};
use crate::objects::ObjectSet;
use crate::physics::World;
use crate::planner::{Observation, Planner, PlannerSpec};
use crate::scene::{SceneKind, generate, settle};
use crate::trial::{Outcome, execute};

/// Failures in a row after which a round ends.
const MAX_FAILURES: usize = 2;

/// Scenes and cameras of a benchmark; the same scenes whatever the planner.
#[derive(Clone, Debug)]
pub struct Benchmark {
    /// Pile or packed.
    pub kind: SceneKind,
    /// What the scenes are made of.
    pub objects: ObjectSet,
    /// Objects a scene starts with.
    pub count: usize,
    /// Where the scene is looked at from before each grasp.
    pub views: Views,
    /// Share of the observations whose depth carries noise.
    pub noise: f64,
    /// Number of scenes.
    pub rounds: u64,
    /// Seed of the scenes.
    pub seed: u64,
}

/// Why a round ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// The table is empty.
    Cleared,
    /// The cameras see nothing.
    NothingSeen,
    /// The planner proposed nothing.
    NothingProposed,
    /// Two failures in a row.
    GaveUp,
}

/// One scene, cleared or not.
#[derive(Clone, Debug)]
pub struct Round {
    /// Objects on the table at first.
    pub objects: usize,
    /// What became of each grasp.
    pub attempts: Vec<Outcome>,
    /// Why it ended.
    pub ending: Ending,
    /// Time of each planning: network and post-processing, without fusion.
    pub planning: Vec<Duration>,
}

/// The benchmark's figures over all rounds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Rounds played.
    pub rounds: usize,
    /// Objects that stood on the tables.
    pub objects: usize,
    /// Grasps executed.
    pub attempts: usize,
    /// Objects lifted.
    pub successes: usize,
    /// Grasp success rate: successes / attempts.
    pub gsr: f64,
    /// Declutter rate: successes / objects.
    pub dr: f64,
    /// Half the width of the 95 % interval of `gsr`.
    pub gsr_interval: f64,
    /// Half the width of the 95 % interval of `dr`.
    pub dr_interval: f64,
    /// Attempts that collided at the pre-grasp.
    pub blocked: usize,
    /// Attempts that closed on nothing.
    pub closed_on_nothing: usize,
    /// Attempts that lost the object in the lift.
    pub lost_in_lift: usize,
    /// Rounds that ended because the table was empty.
    pub cleared: usize,
    /// Rounds that ended because nothing was proposed or seen.
    pub nothing_proposed: usize,
    /// Rounds that ended after two failures in a row.
    pub gave_up: usize,
    /// Median time to plan, milliseconds.
    pub planning_p50_ms: f64,
    /// 95th percentile of the time to plan, milliseconds.
    pub planning_p95_ms: f64,
}

impl Benchmark {
    /// Plays every round, on all cores; `progress` is called after each.
    ///
    /// # Errors
    /// The first error of a planner.
    pub fn run(
        &self,
        planner: &PlannerSpec,
        params: &DecodeParams,
        progress: impl Fn() + Sync,
    ) -> anyhow::Result<Vec<Round>> {
        // Planners that wait for the next round: there are as many as threads, however the rounds are dealt out.
        let idle = Mutex::new(Vec::new());
        let idle = || idle.lock().unwrap_or_else(PoisonError::into_inner);
        (0..self.rounds)
            .into_par_iter()
            .map(|number| {
                let waiting = idle().pop();
                let mut player = waiting.map_or_else(|| planner.build(params), Ok)?;
                let round = self.play(number, player.as_mut());
                idle().push(player);
                progress();
                round
            })
            .collect()
    }

    /// The scene of a round, and the generator for what happens in it.
    #[must_use]
    pub fn scene(&self, number: u64) -> (World, ChaCha8Rng) {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(number);
        let world = generate(self.kind, &self.objects, self.count, &mut rng);
        (world, rng)
    }

    /// Looks at a scene; `None` if nothing of it is seen.
    #[must_use]
    pub fn observe(&self, world: &World, rng: &mut ChaCha8Rng) -> Option<Observation> {
        Observation::new(observe(world, &self.views, self.noise, rng))
    }

    fn play(&self, number: u64, planner: &mut dyn Planner) -> anyhow::Result<Round> {
        let (mut world, mut rng) = self.scene(number);
        let mut round =
            Round { objects: world.objects().len(), attempts: vec![], ending: Ending::Cleared, planning: vec![] };
        let mut failures = 0;
        while !world.objects().is_empty() {
            let Some(observation) = self.observe(&world, &mut rng) else {
                round.ending = Ending::NothingSeen;
                break;
            };
            let start = Instant::now();
            let grasps = planner.plan(&observation, &mut rng)?;
            round.planning.push(start.elapsed());
            let Some(best) = grasps.first() else {
                round.ending = Ending::NothingProposed;
                break;
            };
            let outcome = execute(&mut world, &best.pose);
            round.attempts.push(outcome);
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
        Ok(round)
    }
}

impl Summary {
    /// Pools rounds, as the papers do.
    #[must_use]
    pub fn of(rounds: &[Round]) -> Self {
        let attempts: Vec<Outcome> = rounds.iter().flat_map(|round| round.attempts.iter().copied()).collect();
        let count = |wanted: fn(&Outcome) -> bool| attempts.iter().filter(|outcome| wanted(outcome)).count();
        let ended = |ending: Ending| rounds.iter().filter(|round| round.ending == ending).count();
        let objects = rounds.iter().map(|round| round.objects).sum();
        let successes = count(Outcome::is_success);
        let (gsr, gsr_interval) = proportion(successes, attempts.len());
        let (dr, dr_interval) = proportion(successes, objects);
        let mut planning: Vec<f64> =
            rounds.iter().flat_map(|round| &round.planning).map(|time| time.as_secs_f64() * 1e3).collect();
        planning.sort_by(f64::total_cmp);
        let percentile = |share: f64| match planning.len() {
            0 => 0.0,
            n => planning[((share * n as f64) as usize).min(n - 1)],
        };
        Self {
            rounds: rounds.len(),
            objects,
            attempts: attempts.len(),
            successes,
            gsr,
            dr,
            gsr_interval,
            dr_interval,
            blocked: count(|o| matches!(o, Outcome::BlockedAtPregrasp | Outcome::BlockedOnApproach)),
            closed_on_nothing: count(|o| *o == Outcome::ClosedOnNothing),
            lost_in_lift: count(|o| *o == Outcome::LostInLift),
            cleared: ended(Ending::Cleared),
            nothing_proposed: ended(Ending::NothingProposed) + ended(Ending::NothingSeen),
            gave_up: ended(Ending::GaveUp),
            planning_p50_ms: percentile(0.5),
            planning_p95_ms: percentile(0.95),
        }
    }
}

/// A share and half of its 95 % interval (normal approximation).
fn proportion(part: usize, whole: usize) -> (f64, f64) {
    if whole == 0 {
        return (0.0, 0.0);
    }
    let share = part as f64 / whole as f64;
    (share, 1.96 * (share * (1.0 - share) / whole as f64).sqrt())
}
