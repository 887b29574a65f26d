use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use rapier3d::math::{AngVector, Vector};
use rapier3d::prelude::{
    CoefficientCombineRule, ColliderBuilder, ColliderHandle, GenericJoint, GenericJointBuilder, Group,
    ImpulseJointHandle, InteractionGroups, InteractionTestMode, JointAxesMask, JointAxis, MotorModel,
    PrismaticJointBuilder, RigidBodyBuilder, RigidBodyHandle, RigidBodyVelocity,
};

use super::hand::{FINGER_TRAVEL, FINGERS, HandPart, PALM};
use super::world::{MARGIN, SCALE, from_engine, to_engine, vector};
use super::{BodyId, STEPS_PER_SECOND, World};

/// Force with which each finger closes, newtons.
const FINGER_FORCE: f64 = 20.0;

/// Velocity gain of the fingers' motor, N·s/m: at rest against an object it pushes with [`FINGER_FORCE`], free it closes
/// with 0.5 m/s, about as fast as the reference's position control.
const MOTOR_DAMPING: f64 = 40.0;

/// How fast a finger that lags behind the other catches up, 1/s: the hand's gear keeps both at the same opening.
const GEAR_GAIN: f64 = 195.0;

/// Spinning friction of the fingers, metres: the torque about a contact's normal that a normal force of 1 N holds (the
/// reference's hand: a soft pad does not let an object swing about the line between the fingers).
const SPINNING_FRICTION: f64 = 0.1;

/// By how much the collision shape of a finger is larger than its mesh, metres: [`MARGIN`], less what the reference's soft
/// finger (30 kN/m) gives way under [`FINGER_FORCE`].
const FINGER_MARGIN: f64 = MARGIN - FINGER_FORCE / 30_000.0;

/// Friction of the fingers; an object's own is multiplied with it.
const FINGER_FRICTION: f32 = 1.0;

/// Friction of the palm (Bullet's for a link that states none).
const PALM_FRICTION: f32 = 0.5;

const FINGER_MASS: f32 = 0.15;
const PALM_MASS: f32 = 0.81;

/// The force with which the hand is held where it shall be, newtons: what is in its way for more pushes it off.
const HOLDING_FORCE: f64 = 300.0;

/// How fast the hand comes to where it shall be, 1/s: Bullet's constraint takes 20 % of the way in a step of 1/240 s.
const HOLDING_RATE: f32 = 53.6;

/// Engine units. Enough that the hand gives way by [`HOLDING_FORCE`] alone.
const HOLDING_DAMPING: f32 = 1e4;

/// Engine units. Enough that a brake gives way by its greatest torque alone.
const BRAKE_DAMPING: f32 = 1e7;

/// A free-floating Panda hand in a world: a palm that is held at a target, and two fingers that push.
pub struct Gripper {
    /// The target, a body without a shape.
    target: RigidBodyHandle,
    palm: RigidBodyHandle,
    fingers: [Finger; 2],
    /// A brake on the turning, about the closing axis, of each object that was touched.
    brakes: Vec<(BodyId, ImpulseJointHandle)>,
}

struct Finger {
    body: RigidBodyHandle,
    collider: ColliderHandle,
    joint: ImpulseJointHandle,
    /// +1 for the left finger, −1 for the right: its outward direction along y.
    side: f64,
}

impl Gripper {
    /// Puts an open hand into `world` with its grasp frame at `pose`, on its way to `target` (both `T_task_grasp`).
    #[must_use]
    pub fn insert(world: &mut World, pose: &Isometry3<f64>, target: &Isometry3<f64>) -> Self {
        world.grip();
        let target = world.bodies.insert(RigidBodyBuilder::kinematic_velocity_based().pose(to_engine(target)));
        let palm = RigidBodyBuilder::dynamic().pose(to_engine(pose)).gravity_scale(0.0).can_sleep(false);
        let palm = world.bodies.insert(palm);
        insert_part(world, palm, &PALM, PALM_MASS, PALM_FRICTION, MARGIN);
        let mut holder = GenericJointBuilder::new(JointAxesMask::ANG_AXES).contacts_enabled(false);
        for axis in [JointAxis::LinX, JointAxis::LinY, JointAxis::LinZ] {
            holder = holder
                .motor_model(axis, MotorModel::ForceBased)
                .motor_position(axis, 0.0, HOLDING_DAMPING * HOLDING_RATE, HOLDING_DAMPING)
                .motor_max_force(axis, (HOLDING_FORCE * SCALE) as f32);
        }
        world.joints.insert(target, palm, holder.build(), true);
        let fingers = [1.0, -1.0].map(|side| {
            let offset = Vector3::new(0.0, side * FINGER_TRAVEL, 0.0);
            let body = RigidBodyBuilder::dynamic()
                .pose(to_engine(&(pose * Translation3::from(offset))))
                .gravity_scale(0.0)
                .can_sleep(false);
            let body = world.bodies.insert(body);
            let part = &FINGERS[usize::from(side < 0.0)];
            let collider = insert_part(world, body, part, FINGER_MASS, FINGER_FRICTION, FINGER_MARGIN);
            // Open at 0, closed at -travel: the joint's axis points outward.
            let joint = PrismaticJointBuilder::new(Vector::new(0.0, side as f32, 0.0))
                .local_anchor1(vector(&(offset * SCALE)))
                .local_anchor2(Vector::ZERO)
                .limits([-(FINGER_TRAVEL * SCALE) as f32, 0.0])
                .motor_model(MotorModel::ForceBased)
                .motor_velocity(0.0, MOTOR_DAMPING as f32)
                .motor_max_force((1.5 * FINGER_FORCE * SCALE) as f32)
                .contacts_enabled(false)
                .build();
            // An impulse joint: multibody joints were seen to lift a frictionless cube.
            let joint = world.joints.insert(palm, body, GenericJoint::from(joint), true);
            Finger { body, collider, joint, side }
        });
        Self { target, palm, fingers, brakes: Vec::new() }
    }

    /// Lets the fingers push shut during the next step.
    pub fn close(&mut self, world: &mut World) {
        self.brake(world);
        let joints = self.positions(world);
        let mean = (joints[0] + joints[1]) / 2.0;
        for (finger, position) in self.fingers.iter().zip(joints) {
            let velocity = -FINGER_FORCE / MOTOR_DAMPING - GEAR_GAIN * (position - mean);
            if let Some(joint) = world.joints.get_mut(finger.joint, true) {
                joint.data.set_motor_velocity(JointAxis::LinX, (velocity * SCALE) as f32, MOTOR_DAMPING as f32);
            }
        }
    }

    /// Sets the brakes by the forces of the last step.
    fn brake(&mut self, world: &mut World) {
        let touched = self.touched(world);
        for &(id, _) in &touched {
            if !self.brakes.iter().any(|(braked, _)| *braked == id) {
                let turned = world.pose(id).rotation.inverse() * self.pose(world).rotation;
                let joint = GenericJointBuilder::new(JointAxesMask::empty())
                    .local_frame2(to_engine(&Isometry3::from_parts(Translation3::identity(), turned)))
                    .motor_model(JointAxis::AngY, MotorModel::ForceBased)
                    .motor_velocity(JointAxis::AngY, 0.0, BRAKE_DAMPING)
                    .build();
                self.brakes.push((id, world.joints.insert(self.palm, id.0, joint, true)));
            }
        }
        for (id, joint) in &self.brakes {
            let force = touched.iter().find(|(touched, _)| touched == id).map_or(0.0, |(_, force)| *force);
            if let Some(joint) = world.joints.get_mut(*joint, true) {
                // Torques scale with the square of lengths; an engine's force holds one factor already.
                joint.data.set_motor_max_force(JointAxis::AngY, force * (SPINNING_FRICTION * SCALE) as f32);
            }
        }
    }

    /// The objects the fingers press, and the force in engine units.
    fn touched(&self, world: &World) -> Vec<(BodyId, f32)> {
        let mut touched: Vec<(BodyId, f32)> = Vec::new();
        for finger in &self.fingers {
            for pair in world.narrow_phase.contact_pairs_with(finger.collider) {
                // The manifolds' distances are stale between steps; an impulse means that it was touched in this one.
                let force = pair.total_impulse_magnitude() * STEPS_PER_SECOND as f32;
                let other = if pair.collider1 == finger.collider { pair.collider2 } else { pair.collider1 };
                if let Some(id) = world.object_of(other).filter(|_| force > 0.0) {
                    match touched.iter_mut().find(|(known, _)| *known == id) {
                        Some((_, sum)) => *sum += force,
                        None => touched.push((id, force)),
                    }
                }
            }
        }
        touched
    }

    /// Moves the target at `velocity` (task frame, m/s) from the next step on.
    pub fn set_velocity(&self, world: &mut World, velocity: &Vector3<f64>) {
        let velocity = RigidBodyVelocity { linvel: vector(&(velocity * SCALE)), angvel: AngVector::ZERO };
        world.bodies[self.target].set_vels(velocity, true);
    }

    /// Opening between the fingers, metres.
    #[must_use]
    pub fn width(&self, world: &World) -> f64 {
        let joints = self.positions(world);
        grasp::MAX_OPENING + joints[0] + joints[1]
    }

    /// The object the fingers press hardest, if they press any.
    #[must_use]
    pub fn held(&self, world: &World) -> Option<BodyId> {
        self.touched(world).into_iter().max_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(id, _)| id)
    }

    /// `T_task_grasp` of the hand.
    #[must_use]
    pub fn pose(&self, world: &World) -> Isometry3<f64> {
        from_engine(world.bodies[self.palm].position())
    }

    /// Whether the hand can move on by `travel` (task frame, metres) with `held` in it, touching nothing else.
    #[must_use]
    pub fn is_free_to_move(&self, world: &World, held: BodyId, travel: &Vector3<f64>) -> bool {
        let fingers = self.fingers.each_ref().map(|finger| finger.collider);
        let mut moving = world.colliders_of(held.0).chain(world.colliders_of(self.palm)).chain(fingers);
        moving.all(|collider| {
            !world.touches_another(collider, held, &fingers) && world.is_path_free(collider, held, travel)
        })
    }

    /// Takes the hand out of the world.
    pub fn remove(self, world: &mut World) {
        for finger in &self.fingers {
            world.remove_engine_body(finger.body);
        }
        world.remove_engine_body(self.palm);
        world.remove_engine_body(self.target);
        world.release();
    }

    /// Each finger's joint, metres: 0 open, −0.04 closed.
    fn positions(&self, world: &World) -> [f64; 2] {
        let palm = self.pose(world);
        [0, 1].map(|i| {
            let finger = &self.fingers[i];
            let base = from_engine(world.bodies[finger.body].position()).translation.vector;
            palm.inverse_transform_point(&Point3::from(base)).y * finger.side - FINGER_TRAVEL
        })
    }
}

fn insert_part(
    world: &mut World,
    body: RigidBodyHandle,
    part: &HandPart,
    mass: f32,
    friction: f32,
    margin: f64,
) -> ColliderHandle {
    // The parts of the hand pass through each other.
    let groups = InteractionGroups::new(Group::GROUP_2, !Group::GROUP_2, InteractionTestMode::And);
    let collider = ColliderBuilder::new(part.shape.clone())
        .mass(mass)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Multiply)
        .contact_skin((margin * SCALE) as f32)
        .collision_groups(groups);
    world.colliders.insert_with_parent(collider, body, &mut world.bodies)
}
