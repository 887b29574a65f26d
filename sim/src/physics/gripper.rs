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

/// Velocity gain of the fingers' motor, N·s/m. A blocked finger pushes with [`FINGER_FORCE`]; a free finger closes with
/// 0.5 m/s, similar to the reference's position control.
const MOTOR_DAMPING: f64 = 40.0;

/// Rate at which a lagging finger catches up with the other, 1/s: the hand's gear keeps both at the same opening.
const GEAR_GAIN: f64 = 195.0;

/// Spinning friction of the fingers, metres: torque about the contact normal per normal force. It models the soft pads
/// of the reference's hand, which prevent rotation about the line between the fingers.
const SPINNING_FRICTION: f64 = 0.1;

/// Margin of a finger's collision shape around its mesh, metres: [`MARGIN`] minus the deformation of the reference's
/// soft finger (30 kN/m) under [`FINGER_FORCE`].
const FINGER_MARGIN: f64 = MARGIN - FINGER_FORCE / 30_000.0;

/// Friction of the fingers; multiplied by that of the object.
const FINGER_FRICTION: f32 = 1.0;

/// Friction of the palm (Bullet's default).
const PALM_FRICTION: f32 = 0.5;

const FINGER_MASS: f32 = 0.15;
const PALM_MASS: f32 = 0.81;

/// Maximum force that holds the hand at its target, newtons. Greater contact forces displace it.
const HOLDING_FORCE: f64 = 300.0;

/// Rate at which the hand approaches its target, 1/s: Bullet's constraint covers 20 % of the distance per step of 1/240
/// s.
const HOLDING_RATE: f32 = 53.6;

/// Engine units. Large enough that only [`HOLDING_FORCE`] limits the force.
const HOLDING_DAMPING: f32 = 1e4;

/// Engine units. Large enough that only the maximum torque limits a brake.
const BRAKE_DAMPING: f32 = 1e7;

/// A free-floating Panda hand in a world: a palm that is held at a target, and two fingers.
pub struct Gripper {
    /// The target, a body without a shape.
    target: RigidBodyHandle,
    palm: RigidBodyHandle,
    fingers: [Finger; 2],
    /// Brakes of the rotation of touched objects about the closing axis.
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
    /// Inserts an open hand with its grasp frame at `pose`, held at `target` (both `T_task_grasp`).
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
            // 0 is open, -travel is closed: the joint's axis points outward.
            let joint = PrismaticJointBuilder::new(Vector::new(0.0, side as f32, 0.0))
                .local_anchor1(vector(&(offset * SCALE)))
                .local_anchor2(Vector::ZERO)
                .limits([-(FINGER_TRAVEL * SCALE) as f32, 0.0])
                .motor_model(MotorModel::ForceBased)
                .motor_velocity(0.0, MOTOR_DAMPING as f32)
                .motor_max_force((1.5 * FINGER_FORCE * SCALE) as f32)
                .contacts_enabled(false)
                .build();
            // An impulse joint, because with multibody joints the hand lifted a frictionless cube.
            let joint = world.joints.insert(palm, body, GenericJoint::from(joint), true);
            Finger { body, collider, joint, side }
        });
        Self { target, palm, fingers, brakes: Vec::new() }
    }

    /// Closes the fingers during the next step.
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

    /// Sets the torque of the brakes from the contact forces of the last step.
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
                // Torques scale with the square of lengths; the engine's force already contains one factor.
                joint.data.set_motor_max_force(JointAxis::AngY, force * (SPINNING_FRICTION * SCALE) as f32);
            }
        }
    }

    /// The objects in contact with the fingers, and the force in engine units.
    fn touched(&self, world: &World) -> Vec<(BodyId, f32)> {
        let mut touched: Vec<(BodyId, f32)> = Vec::new();
        for finger in &self.fingers {
            for pair in world.narrow_phase.contact_pairs_with(finger.collider) {
                // The manifolds' distances are stale between steps. An impulse indicates a contact in the last step.
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

    /// The object with the greatest contact force on the fingers.
    #[must_use]
    pub fn held(&self, world: &World) -> Option<BodyId> {
        self.touched(world).into_iter().max_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(id, _)| id)
    }

    /// `T_task_grasp` of the hand.
    #[must_use]
    pub fn pose(&self, world: &World) -> Isometry3<f64> {
        from_engine(world.bodies[self.palm].position())
    }

    /// Whether the hand with the object `held` can move by `travel` (task frame, metres) without touching anything
    /// else.
    #[must_use]
    pub fn is_free_to_move(&self, world: &World, held: BodyId, travel: &Vector3<f64>) -> bool {
        let fingers = self.fingers.each_ref().map(|finger| finger.collider);
        let mut moving = world.colliders_of(held.0).chain(world.colliders_of(self.palm)).chain(fingers);
        moving.all(|collider| {
            !world.touches_another(collider, held, &fingers) && world.is_path_free(collider, held, travel)
        })
    }

    /// Removes the hand from the world.
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
    // Parts of the hand do not collide with each other.
    let groups = InteractionGroups::new(Group::GROUP_2, !Group::GROUP_2, InteractionTestMode::And);
    let collider = ColliderBuilder::new(part.shape.clone())
        .mass(mass)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Multiply)
        .contact_skin((margin * SCALE) as f32)
        .collision_groups(groups);
    world.colliders.insert_with_parent(collider, body, &mut world.bodies)
}
