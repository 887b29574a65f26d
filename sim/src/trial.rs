//! A trial of a grasp: pre-grasp, approach, close, lift.

use std::f64::consts::FRAC_PI_3;
use std::sync::LazyLock;

use grasp::pregrasp;
use nalgebra::{Isometry3, Translation3, Vector3};

use crate::physics::{BodyId, CONTACT_GAP, Gripper, HandPart, OPEN_HAND, STEPS_PER_SECOND, World};

/// Distance of the pre-grasp from the grasp along the approach, metres.
pub const PREGRASP_DISTANCE: f64 = 0.05;

/// Height of the lift, metres.
const LIFT: f64 = 0.1;

/// Speed of the lift, m/s: the reference's hand moves 2 mm in 4 steps of 1/240 s.
const LIFT_SPEED: f64 = 0.12;

/// Opening below which a grasp is empty: a tenth of the maximum opening (VGN).
const EMPTY_WIDTH: f64 = 0.1 * grasp::MAX_OPENING;

/// Steps between two checks during the lift, 50 ms.
const LOOK: u32 = STEPS_PER_SECOND / 20;

/// Step of the approach, metres.
const APPROACH_STEP: f64 = 0.002;

/// Lag of the hand behind its target on the approach, metres: the residual of Bullet's constraint for steps of 2 mm.
const LAG: f64 = 0.0014;

/// The volume swept by the open hand from the pre-grasp to the grasp.
static SWEPT_HAND: LazyLock<Vec<HandPart>> =
    LazyLock::new(|| OPEN_HAND.iter().map(|part| part.swept(PREGRASP_DISTANCE)).collect());

/// The outcome of a trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outcome {
    /// An object was lifted.
    Lifted {
        /// The lifted object.
        object: BodyId,
        /// Opening after the lift, metres.
        width: f64,
    },
    /// The open hand was in contact at the pre-grasp, closed there and lifted nothing.
    BlockedAtPregrasp,
    /// The open hand collided on its approach; only for labels.
    BlockedOnApproach,
    /// Empty grasp: no object was between the fingers.
    ClosedOnNothing,
    /// The object slipped out of the hand during the lift.
    LostInLift,
}

impl Outcome {
    /// The name of the outcome in reports.
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

/// Tries a grasp for a label: any contact on the approach is a failure. The hand is enlarged by `padding` metres per side
/// for the contact test. `world` is not changed.
#[must_use]
pub fn label(world: &World, grasp: &Isometry3<f64>, padding: f64) -> Outcome {
    // One test of the swept hand covers the pre-grasp and every step of the approach.
    if world.is_near(&SWEPT_HAND, grasp, CONTACT_GAP + padding) {
        return Outcome::BlockedOnApproach;
    }
    close_and_lift(&mut world.clone(), grasp, grasp, Until::NothingIsHeld)
}

/// Clearance of the open hand between pre-grasp and grasp: the distance to the nearest object's mesh, at most `limit`,
/// metres.
#[must_use]
pub fn clearance(world: &World, grasp: &Isometry3<f64>, limit: f64) -> f64 {
    world.clearance(&SWEPT_HAND, grasp, limit)
}

/// Executes a grasp as in evaluation: on contact during the approach the hand closes at once. Returns the outcome and
/// the distance from the grasp at which the hand closed, metres. A lifted object stays in `world`; the caller removes
/// it.
///
/// As in the reference, a hand in contact at the pre-grasp closes there, and a hand that overlaps an object or the
/// table is pushed out. Only a failure then counts as [`BlockedAtPregrasp`](Outcome::BlockedAtPregrasp).
pub fn execute(world: &mut World, grasp: &Isometry3<f64>) -> (Outcome, f64) {
    let touched_in = first_contact(world, grasp);
    let short_by = touched_in.map_or(0.0, distance_after);
    match close_and_lift(world, &pregrasp(grasp, short_by), grasp, Until::TheEnd) {
        outcome if touched_in == Some(1) && !outcome.is_success() => (Outcome::BlockedAtPregrasp, short_by),
        outcome => (outcome, short_by),
    }
}

/// As [`execute`], but `world` is not changed, and the trial ends as soon as the outcome is known. A hand in contact at
/// the pre-grasp is [`BlockedAtPregrasp`](Outcome::BlockedAtPregrasp) at once.
#[must_use]
pub fn attempt(world: &World, grasp: &Isometry3<f64>) -> (Outcome, f64) {
    let touched_in = first_contact(world, grasp);
    let short_by = touched_in.map_or(0.0, distance_after);
    if touched_in == Some(1) {
        return (Outcome::BlockedAtPregrasp, short_by);
    }
    (close_and_lift(&mut world.clone(), &pregrasp(grasp, short_by), grasp, Until::NothingIsHeld), short_by)
}

/// The step of the approach in which the open hand first touches something.
fn first_contact(world: &World, grasp: &Isometry3<f64>) -> Option<u32> {
    let steps = (PREGRASP_DISTANCE / APPROACH_STEP).round() as u32;
    let is_free = !world.is_near(&SWEPT_HAND, grasp, CONTACT_GAP);
    let touches = |step| world.is_near(&OPEN_HAND, &pregrasp(grasp, distance_after(step) + LAG), CONTACT_GAP);
    if is_free { None } else { (1..=steps).find(|&step| touches(step)) }
}

/// Distance from the grasp after this many steps of the approach, metres.
fn distance_after(step: u32) -> f64 {
    PREGRASP_DISTANCE - f64::from(step) * APPROACH_STEP
}

/// When a trial ends.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Until {
    /// As soon as it has failed, because only the outcome is needed.
    NothingIsHeld,
    /// After the full motion, as in the reference, even with an empty hand. The motion can move other objects, which
    /// changes the scene of the next attempt, and can catch an object.
    TheEnd,
}

/// Closes the hand at `start` and lifts it to the end of a lift from `grasp`.
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

/// Closes until the width is constant for 50 ms, for at most 0.5 s. Returns the held object.
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
            // The reference checks only at the end. Closed fingers cannot hold an object later, so the trial ends here.
            if until == Until::NothingIsHeld && gripper.width(world) <= EMPTY_WIDTH {
                return Outcome::LostInLift;
            }
            // The outcome is also known if the object is still in the hand and the remaining path is free.
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

/// Pose of the held object in the hand.
struct Carried {
    object: BodyId,
    pose: Isometry3<f64>,
}

impl Carried {
    fn now(world: &World, gripper: &Gripper) -> Option<Self> {
        let object = holds(world, gripper)?;
        Some(Self { object, pose: gripper.pose(world).inv_mul(&world.pose(object)) })
    }

    /// Whether the object is still: at this rate it creeps less than 3 mm and 9° until the end of the lift.
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

/// Direction of the lift: back along the approach, or straight up if the approach is more than 60° from straight down.
fn retreat(grasp: &Isometry3<f64>) -> Vector3<f64> {
    let approach = grasp.rotation * Vector3::z();
    if approach.angle(&-Vector3::z()) > FRAC_PI_3 { Vector3::z() } else { -approach }
}
