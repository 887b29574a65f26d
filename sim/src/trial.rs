//! One grasp, tried: pre-grasp, approach, close, lift.

use std::f64::consts::FRAC_PI_3;
use std::sync::LazyLock;

use nalgebra::{Isometry3, Translation3, Vector3};

use crate::physics::{BodyId, CONTACT_GAP, Gripper, HandPart, OPEN_HAND, STEPS_PER_SECOND, World};

/// Distance of the pre-grasp from the grasp along the approach, metres.
pub const PREGRASP_DISTANCE: f64 = 0.05;

/// Height of the lift, metres.
const LIFT: f64 = 0.1;

/// Speed of the lift, m/s: the reference's hand makes 2 mm in 4 steps of 1/240 s.
const LIFT_SPEED: f64 = 0.12;

/// Opening below which the hand holds nothing: a tenth of its greatest (VGN).
const EMPTY_WIDTH: f64 = 0.1 * grasp::MAX_OPENING;

/// Steps between two looks at what the lift does, 50 ms.
const LOOK: u32 = STEPS_PER_SECOND / 20;

/// Step of the approach, metres.
const APPROACH_STEP: f64 = 0.002;

/// How far the hand is behind its target on its approach, metres: what Bullet's constraint leaves of steps of 2 mm.
const LAG: f64 = 0.0014;

/// The way of the open hand from the pre-grasp to the grasp.
static WAY: LazyLock<Vec<HandPart>> =
    LazyLock::new(|| OPEN_HAND.iter().map(|part| part.swept(PREGRASP_DISTANCE)).collect());

/// What became of a grasp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outcome {
    /// The object was lifted; `width` is the opening after the lift, metres.
    Lifted {
        /// What was lifted.
        object: BodyId,
        /// Opening, metres.
        width: f64,
    },
    /// The open hand touched something where it appeared, and what it closed on there was not lifted.
    BlockedAtPregrasp,
    /// The open hand collided on its way to the grasp, where that counts as a failure.
    BlockedOnApproach,
    /// The fingers closed on nothing.
    ClosedOnNothing,
    /// What was held slipped out while it was lifted.
    LostInLift,
}

impl Outcome {
    /// The outcome in a word, as reports have it.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Lifted { .. } => "lifted",
            Self::BlockedAtPregrasp => "blocked_at_pregrasp",
            Self::BlockedOnApproach => "blocked_on_approach",
            Self::ClosedOnNothing => "closed_on_nothing",
            Self::LostInLift => "lost_in_lift",
        }
    }

    /// Whether the object was lifted.
    #[must_use]
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Lifted { .. })
    }
}

/// Tries a grasp as training data is labelled: any contact on the way, of a hand that is swollen by `swell` metres a side,
/// is a failure. `world` is left as it was.
#[must_use]
pub fn label(world: &World, grasp: &Isometry3<f64>, swell: f64) -> Outcome {
    // One test of the swept hand stands for the pre-grasp and every step of the approach.
    if world.is_near(&WAY, grasp, CONTACT_GAP + swell) {
        return Outcome::BlockedOnApproach;
    }
    close_and_lift(&mut world.clone(), grasp, grasp, Until::NothingIsHeld)
}

/// How much room the open hand has on its way to a grasp: the distance of the nearest object's mesh, at most `limit`,
/// metres.
#[must_use]
pub fn clearance(world: &World, grasp: &Isometry3<f64>, limit: f64) -> f64 {
    world.clearance(&WAY, grasp, limit)
}

/// Executes a grasp as in evaluation: the hand closes where its approach met something, and how far from the grasp that
/// was is the second answer, metres. A lifted object is still in the hand's place in `world`; the caller decides what
/// becomes of it.
///
/// As in the reference, a hand that touches something where it appears closes there, and if it appears in something it is
/// pushed out; only a failure is then called [`BlockedAtPregrasp`](Outcome::BlockedAtPregrasp).
pub fn execute(world: &mut World, grasp: &Isometry3<f64>) -> (Outcome, f64) {
    let at = |distance: f64| grasp * Translation3::new(0.0, 0.0, -distance);
    let steps = (PREGRASP_DISTANCE / APPROACH_STEP).round() as u32;
    let touched_in = (1..=steps).find(|&step| world.is_near(&OPEN_HAND, &at(distance_after(step) + LAG), CONTACT_GAP));
    let short_by = touched_in.map_or(0.0, distance_after);
    match close_and_lift(world, &at(short_by), grasp, Until::TheEnd) {
        outcome if touched_in == Some(1) && !outcome.is_success() => (Outcome::BlockedAtPregrasp, short_by),
        outcome => (outcome, short_by),
    }
}

/// From the grasp after so many steps of the approach.
fn distance_after(step: u32) -> f64 {
    PREGRASP_DISTANCE - f64::from(step) * APPROACH_STEP
}

/// How long a trial goes on.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Until {
    /// Until it has failed: only the outcome is asked for.
    NothingIsHeld,
    /// As in the reference the hand is lifted whatever it holds. It moves what stands around, so that the next attempt
    /// meets another scene, and now and then it catches something.
    TheEnd,
}

/// Closes the hand at `start` and lifts it to where a lift from `grasp` ends.
fn close_and_lift(world: &mut World, start: &Isometry3<f64>, grasp: &Isometry3<f64>, until: Until) -> Outcome {
    let behind = start * Translation3::new(0.0, 0.0, -LAG);
    let mut gripper = Gripper::insert(world, &behind, start);
    let closed_on = close(world, &mut gripper);
    let outcome = match closed_on {
        None if until == Until::NothingIsHeld => Outcome::ClosedOnNothing,
        _ => match lift(world, &mut gripper, start, grasp, until) {
            Outcome::LostInLift if closed_on.is_none() => Outcome::ClosedOnNothing,
            outcome => outcome,
        },
    };
    gripper.remove(world);
    outcome
}

/// Closes until the width is still for 50 ms, or 0.5 s at the longest. What is held then.
fn close(world: &mut World, gripper: &mut Gripper) -> Option<BodyId> {
    const STILL: f64 = 1e-5;
    let mut still_since = 0;
    let mut width = gripper.width(world);
    for step in 1..=STEPS_PER_SECOND / 2 {
        gripper.close(world);
        world.step();
        let now = gripper.width(world);
        if (now - width).abs() > STILL {
            still_since = step;
        } else if step - still_since >= STEPS_PER_SECOND / 20 {
            break;
        }
        width = now;
    }
    holds(world, gripper)
}

fn lift(
    world: &mut World,
    gripper: &mut Gripper,
    start: &Isometry3<f64>,
    grasp: &Isometry3<f64>,
    until: Until,
) -> Outcome {
    let target = grasp.translation.vector + retreat(grasp) * LIFT;
    let path = target - start.translation.vector;
    let steps = (path.norm() / LIFT_SPEED * f64::from(STEPS_PER_SECOND)).round() as u32;
    gripper.set_velocity(world, &(path.normalize() * LIFT_SPEED));
    let mut carried = None;
    for step in 1..=steps {
        gripper.close(world);
        world.step();
        if step % LOOK == 0 {
            // The reference looks once, at the end; shut fingers will not hold anything any more.
            if until == Until::NothingIsHeld && gripper.width(world) <= EMPTY_WIDTH {
                return Outcome::LostInLift;
            }
            // Nor will anything change for what hangs still in the hand with nothing before it.
            let before = std::mem::replace(&mut carried, Carried::now(world, gripper));
            if let (Some(before), Some(now)) = (before, &carried)
                && now.hangs_still(&before)
                && gripper.is_free_to_move(world, now.object, &(target - gripper.pose(world).translation.vector))
            {
                break;
            }
        }
    }
    match holds(world, gripper) {
        Some(object) => Outcome::Lifted { object, width: gripper.width(world) },
        None => Outcome::LostInLift,
    }
}

/// Where an object is in the hand.
struct Carried {
    object: BodyId,
    pose: Isometry3<f64>,
}

impl Carried {
    fn now(world: &World, gripper: &Gripper) -> Option<Self> {
        let object = holds(world, gripper)?;
        Some(Self { object, pose: gripper.pose(world).inv_mul(&world.pose(object)) })
    }

    /// Whether what creeps now would not have crept 3 mm, or turned nine degrees, when the lift ends.
    fn hangs_still(&self, before: &Self) -> bool {
        const CREEP: f64 = 2e-4;
        const TURN: f64 = 1e-2;
        let moved = before.pose.inv_mul(&self.pose);
        self.object == before.object && moved.translation.vector.norm() < CREEP && moved.rotation.angle() < TURN
    }
}

fn holds(world: &World, gripper: &Gripper) -> Option<BodyId> {
    gripper.held(world).filter(|_| gripper.width(world) > EMPTY_WIDTH)
}

/// Back along the approach, or straight up where the approach is more than 60° off straight down.
fn retreat(grasp: &Isometry3<f64>) -> Vector3<f64> {
    let approach = grasp.rotation * Vector3::z();
    if approach.angle(&-Vector3::z()) > FRAC_PI_3 { Vector3::z() } else { -approach }
}
