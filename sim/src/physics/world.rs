use std::sync::Arc;

use grasp::WORKSPACE_SIZE;
use grasp_data::Occupancy;
use nalgebra::{Isometry3, Point3, Quaternion, UnitQuaternion, Vector3};
use rapier3d::math::{Pose, Rotation, Vector};
use rapier3d::parry::bounding_volume::Aabb;
use rapier3d::parry::query::{self, ClosestPoints};
use rapier3d::prelude::{
    BoundingVolume, BroadPhaseBvh, CCDSolver, CoefficientCombineRule, ColliderBuilder, ColliderHandle, ColliderSet,
    FrictionModel, ImpulseJointSet, IntegrationParameters, IslandManager, MultibodyJointSet, NarrowPhase,
    PhysicsPipeline, QueryFilter, QueryPipeline, RigidBodyBuilder, RigidBodyHandle, RigidBodySet, Shape, SharedShape,
    SoftBodySet, SpringCoefficients,
};

use super::HandPart;
use crate::TABLE_HEIGHT;
use crate::objects::Object;

/// Simulation steps per second, as in the reference (Bullet's default).
pub const STEPS_PER_SECOND: u32 = 240;

/// Engine units per metre.
pub(super) const SCALE: f64 = 100.0;

/// Margin of the collision shape of a convex body around its mesh, metres: that of Bullet.
pub(super) const MARGIN: f64 = 0.001;

/// Distance of two convex meshes below which they count as touching, metres. Bullet keeps a contact until the two
/// shapes with their margins are 2 % of the smaller one's size apart: 0.8 mm for a finger.
pub const CONTACT_GAP: f64 = 2.0 * MARGIN + 0.0008;

/// Angular damping of objects during scene generation, 1/s. Without it round bodies do not stop rolling.
const REST_DAMPING: f32 = 10.0;

/// Angular damping from the first trial on, 1/s, as in the reference.
const TRIAL_DAMPING: f32 = 0.04;

/// Friction of the table and the walls; multiplied by that of the object, as in Bullet.
const TABLE_FRICTION: f32 = 0.5;

/// Handle of a body, valid in its world and in clones of that world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BodyId(pub(super) RigidBodyHandle);

/// An object in a world.
#[derive(Clone, Debug)]
pub struct Body {
    /// Handle.
    pub id: BodyId,
    /// Shape, mass and friction.
    pub object: Arc<Object>,
    /// Scale of its mesh.
    pub scale: f64,
}

/// A table with objects. Cloning takes microseconds, because clones share the shapes.
pub struct World {
    pub(super) bodies: RigidBodySet,
    pub(super) colliders: ColliderSet,
    pub(super) joints: ImpulseJointSet,
    pub(super) narrow_phase: NarrowPhase,
    broad_phase: BroadPhaseBvh,
    islands: IslandManager,
    multibody_joints: MultibodyJointSet,
    soft_bodies: SoftBodySet,
    ccd: CCDSolver,
    pipeline: PhysicsPipeline,
    parameters: IntegrationParameters,
    objects: Vec<Body>,
    walls: Vec<RigidBodyHandle>,
}

impl Clone for World {
    fn clone(&self) -> Self {
        Self {
            bodies: self.bodies.clone(),
            colliders: self.colliders.clone(),
            joints: self.joints.clone(),
            narrow_phase: self.narrow_phase.clone(),
            broad_phase: self.broad_phase.clone(),
            islands: self.islands.clone(),
            multibody_joints: self.multibody_joints.clone(),
            // Unused soft bodies and scratch memory of the pipelines are not copied.
            soft_bodies: SoftBodySet::new(),
            ccd: CCDSolver::new(),
            pipeline: PhysicsPipeline::new(),
            parameters: self.parameters,
            objects: self.objects.clone(),
            walls: self.walls.clone(),
        }
    }
}

impl Default for World {
    fn default() -> Self {
        Self::new()
    }
}

impl World {
    /// An empty table whose top is at z = [`TABLE_HEIGHT`].
    #[must_use]
    pub fn new() -> Self {
        let mut world = Self {
            bodies: RigidBodySet::new(),
            colliders: ColliderSet::new(),
            joints: ImpulseJointSet::new(),
            narrow_phase: NarrowPhase::new(),
            broad_phase: BroadPhaseBvh::new(),
            islands: IslandManager::new(),
            multibody_joints: MultibodyJointSet::new(),
            soft_bodies: SoftBodySet::new(),
            ccd: CCDSolver::new(),
            pipeline: PhysicsPipeline::new(),
            parameters: Self::parameters(),
            objects: Vec::new(),
            walls: Vec::new(),
        };
        const TABLE_THICKNESS: f64 = 0.1;
        let centre = Vector3::new(0.15, 0.15, TABLE_HEIGHT - TABLE_THICKNESS / 2.0);
        world.add_fixed_box(&centre, &Vector3::new(0.5, 0.5, TABLE_THICKNESS / 2.0));
        world
    }

    /// Adds an object scaled by `scale` at `pose` (`T_task_object`). Its mass does not change with the scale.
    pub fn add(&mut self, object: &Arc<Object>, scale: f64, pose: &Isometry3<f64>) -> BodyId {
        let body = RigidBodyBuilder::dynamic()
            .pose(to_engine(pose))
            .linear_damping(0.04)
            .angular_damping(REST_DAMPING)
            .build();
        let handle = self.bodies.insert(body);
        self.bodies[handle].activation_mut().normalized_linear_threshold = 1.0;
        let (shape, volume) = shape(object, scale);
        let collider = ColliderBuilder::new(shape)
            .density(object.mass as f32 / volume)
            .friction(object.friction as f32)
            .friction_combine_rule(CoefficientCombineRule::Multiply)
            .contact_skin((MARGIN * SCALE) as f32)
            .restitution(0.0);
        self.colliders.insert_with_parent(collider, handle, &mut self.bodies);
        let id = BodyId(handle);
        self.objects.push(Body { id, object: Arc::clone(object), scale });
        id
    }

    /// Sets the solver's parameters for trials. They are slower, and piles rest less well.
    ///
    /// A grasped object creeps out of the hand unless friction is solved in both passes of a step and at every contact
    /// point. The fingers push with two thirds of their force unless motors and contacts are iterated together.
    /// Contacts are hard, but overlapping bodies (a hand inserted into an object or the table) separate slowly, as in
    /// Bullet.
    pub(super) fn grip(&mut self) {
        self.set_angular_damping(TRIAL_DAMPING);
        self.parameters = IntegrationParameters {
            friction_model: FrictionModel::Coulomb,
            friction_in_bias_pass: true,
            num_solver_iterations: 6,
            normalized_max_corrective_velocity: 50.0,
            contact_softness: SpringCoefficients::new(2000.0, 100.0),
            static_contact_softness: SpringCoefficients::new(2000.0, 100.0),
            ..Self::parameters()
        };
    }

    /// Restores the solver's parameters that keep a pile at rest. The damping stays that of trials.
    pub(super) fn release(&mut self) {
        self.parameters = Self::parameters();
    }

    fn set_angular_damping(&mut self, damping: f32) {
        for body in &self.objects {
            self.bodies[body.id.0].set_angular_damping(damping);
        }
    }

    /// Removes an object.
    pub fn remove(&mut self, id: BodyId) {
        self.objects.retain(|body| body.id != id);
        self.remove_engine_body(id.0);
    }

    /// Adds four walls of an open box; `lower` and `upper` are its inner corners in x and y.
    pub fn add_walls(&mut self, lower: [f64; 2], upper: [f64; 2], height: f64) {
        const THICKNESS: f64 = 0.02;
        let middle = [0, 1].map(|axis| f64::midpoint(lower[axis], upper[axis]));
        for axis in 0..2 {
            for (edge, outward) in [(lower[axis], -1.0), (upper[axis], 1.0)] {
                let mut centre = Vector3::new(middle[0], middle[1], TABLE_HEIGHT + height / 2.0);
                centre[axis] = edge + outward * THICKNESS / 2.0;
                let mut half = Vector3::repeat(height / 2.0);
                half[axis] = THICKNESS / 2.0;
                half[1 - axis] = (upper[1 - axis] - lower[1 - axis]) / 2.0 + THICKNESS;
                let wall = self.add_fixed_box(&centre, &half);
                self.walls.push(wall);
            }
        }
    }

    /// Removes the walls.
    pub fn remove_walls(&mut self) {
        for wall in std::mem::take(&mut self.walls) {
            self.remove_engine_body(wall);
        }
    }

    /// Advances by 1 / [`STEPS_PER_SECOND`] seconds.
    pub fn step(&mut self) {
        self.pipeline.step(
            Vector::new(0.0, 0.0, (-9.81 * SCALE) as f32),
            &self.parameters,
            &mut self.islands,
            &mut self.broad_phase,
            &mut self.narrow_phase,
            &mut self.bodies,
            &mut self.colliders,
            &mut self.joints,
            &mut self.multibody_joints,
            &mut self.soft_bodies,
            &mut self.ccd,
            &(),
            &(),
        );
    }

    /// Puts the objects to sleep: they are not simulated until something touches them.
    pub fn sleep(&mut self) {
        for body in &self.objects {
            self.bodies[body.id.0].sleep();
        }
        // The engine removes sleeping bodies from its active set in a step.
        self.step();
    }

    /// The objects, in the order of their insertion.
    #[must_use]
    pub fn objects(&self) -> &[Body] {
        &self.objects
    }

    /// `T_task_object` of a body.
    #[must_use]
    pub fn pose(&self, id: BodyId) -> Isometry3<f64> {
        from_engine(self.bodies[id.0].position())
    }

    /// The norm of linear (m/s) and angular (rad/s) velocity together, as the reference measures rest.
    #[must_use]
    pub fn speed(&self, id: BodyId) -> f64 {
        let body = &self.bodies[id.0];
        let linear = f64::from(body.linvel().length()) / SCALE;
        linear.hypot(f64::from(body.angvel().length()))
    }

    /// Whether an object scaled by `scale` at `pose` would touch another object, or the table.
    #[must_use]
    pub fn is_occupied(&self, object: &Object, scale: f64, pose: &Isometry3<f64>) -> bool {
        let corners = object.parts.iter().flat_map(|part| &part.vertices);
        let lowest = corners.map(|corner| (pose * Point3::from(corner.coords * scale)).z).fold(f64::INFINITY, f64::min);
        lowest < TABLE_HEIGHT + CONTACT_GAP - MARGIN || {
            let (shape, _) = shape(object, scale);
            distances(&self.objects_query(), &*shape, &to_engine(pose), CONTACT_GAP).next().is_some()
        }
    }

    /// Whether any of the parts, in the frame `pose`, is closer than `gap` metres to an object's mesh, or closer than
    /// `gap` minus `MARGIN` to the table, which has no margin.
    #[must_use]
    pub fn is_near(&self, parts: &[HandPart], pose: &Isometry3<f64>, gap: f64) -> bool {
        parts.iter().any(|part| part.lowest_point(pose) < TABLE_HEIGHT + gap - MARGIN) || {
            let query = self.objects_query();
            parts.iter().any(|part| distances(&query, &*part.shape, &to_engine(pose), gap).next().is_some())
        }
    }

    /// The smallest distance between the parts, in the frame `pose`, and the objects' meshes, at most `limit`, metres.
    #[must_use]
    pub fn clearance(&self, parts: &[HandPart], pose: &Isometry3<f64>, limit: f64) -> f64 {
        let (query, pose) = (self.objects_query(), to_engine(pose));
        parts.iter().flat_map(|part| distances(&query, &*part.shape, &pose, limit)).fold(limit, f64::min)
    }

    /// The object nearest to a point: an index into [`objects`](Self::objects).
    #[must_use]
    pub fn nearest(&self, point: &Point3<f64>) -> Option<usize> {
        const REACH: f32 = (0.05 * SCALE) as f32;
        let (collider, _) = self.objects_query().project_point(vector(&(point.coords * SCALE)), REACH, true)?;
        let id = self.object_of(collider)?;
        self.objects.iter().position(|body| body.id == id)
    }

    /// The voxels of the task volume with `resolution`³ voxels whose centres are inside an object.
    #[must_use]
    pub fn occupancy(&self, resolution: usize) -> Occupancy {
        let mut occupancy = Occupancy::empty(resolution.pow(3));
        let voxel = (WORKSPACE_SIZE * SCALE) as f32 / resolution as f32;
        // The voxels whose centres are between two coordinates.
        let between = |lower: f32, upper: f32| {
            let [first, end] = [lower, upper].map(|bound| (bound / voxel + 0.5).clamp(0.0, resolution as f32) as usize);
            first..end
        };
        for collider in self.objects.iter().flat_map(|body| self.colliders_of(body.id.0)) {
            let collider = &self.colliders[collider];
            let Aabb { mins, maxs } = collider.compute_aabb();
            for x in between(mins.x, maxs.x) {
                for y in between(mins.y, maxs.y) {
                    for z in between(mins.z, maxs.z) {
                        let centre = [x, y, z].map(|index| (index as f32 + 0.5) * voxel);
                        if collider.shape().contains_point(collider.position(), centre.into()) {
                            occupancy.insert((x * resolution + y) * resolution + z);
                        }
                    }
                }
            }
        }
        occupancy
    }

    /// The object that a collider belongs to.
    pub(super) fn object_of(&self, collider: ColliderHandle) -> Option<BodyId> {
        let handle = self.colliders.get(collider)?.parent()?;
        self.objects.iter().map(|body| body.id).find(|id| id.0 == handle)
    }

    pub(super) fn colliders_of(&self, handle: RigidBodyHandle) -> impl Iterator<Item = ColliderHandle> {
        self.bodies[handle].colliders().iter().copied()
    }

    /// Whether `collider` is in contact with anything except `held` and the `fingers`.
    pub(super) fn touches_another(&self, collider: ColliderHandle, held: BodyId, fingers: &[ColliderHandle]) -> bool {
        self.narrow_phase.contact_pairs_with(collider).any(|pair| {
            let other = if pair.collider1 == collider { pair.collider2 } else { pair.collider1 };
            let expected = fingers.contains(&other) || self.colliders[other].parent() == Some(held.0);
            !expected && pair.total_impulse_magnitude() > 0.0
        })
    }

    /// Whether the bounding box swept by `collider` along `travel` (metres) intersects no object except `held`.
    pub(super) fn is_path_free(&self, collider: ColliderHandle, held: BodyId, travel: &Vector3<f64>) -> bool {
        let start = self.colliders[collider].compute_aabb();
        let swept = start.merged(&start.translated(vector(&(travel * SCALE))));
        let mut others =
            self.objects.iter().filter(|body| body.id != held).flat_map(|body| self.colliders_of(body.id.0));
        others.all(|other| !swept.intersects(&self.colliders[other].compute_aabb()))
    }

    pub(super) fn remove_engine_body(&mut self, handle: RigidBodyHandle) {
        self.bodies.remove(
            handle,
            &mut self.islands,
            &mut self.colliders,
            &mut self.joints,
            &mut self.multibody_joints,
            &mut self.soft_bodies,
            true,
        );
    }

    /// Parameters of the solver that keep piles at rest. Contacts are stiffer than the engine's defaults and
    /// overdamped. Contact recycling is off, because grasped objects creep with it. Contact clustering is off, because
    /// objects of many parts oscillate with it: 17 of 100 piles did not come to rest with it, all did without.
    fn parameters() -> IntegrationParameters {
        IntegrationParameters {
            dt: 1.0 / STEPS_PER_SECOND as f32,
            num_solver_iterations: 8,
            length_unit: 5.0,
            contact_softness: SpringCoefficients::new(240.0, 5.0),
            static_contact_softness: SpringCoefficients::new(480.0, 5.0),
            num_internal_pgs_iterations: 2,
            contact_recycling: false,
            contact_clustering: false,
            // 3 mm: two margins and 1 mm. With less, contacts appear and disappear, the fingers chatter, and 4 of 10
            // piles do not come to rest.
            normalized_prediction_distance: 0.06,
            max_ccd_substeps: 0,
            friction_model: FrictionModel::Simplified,
            ..IntegrationParameters::default()
        }
    }

    fn objects_query(&self) -> QueryPipeline<'_> {
        self.broad_phase.as_query_pipeline(
            self.narrow_phase.query_dispatcher(),
            &self.bodies,
            &self.colliders,
            QueryFilter::only_dynamic(),
        )
    }

    fn add_fixed_box(&mut self, centre: &Vector3<f64>, half: &Vector3<f64>) -> RigidBodyHandle {
        let body = RigidBodyBuilder::fixed().translation(vector(&(centre * SCALE)));
        let handle = self.bodies.insert(body);
        let half = half * SCALE;
        let collider = ColliderBuilder::cuboid(half.x as f32, half.y as f32, half.z as f32)
            .friction(TABLE_FRICTION)
            .friction_combine_rule(CoefficientCombineRule::Multiply)
            .restitution(0.0);
        self.colliders.insert_with_parent(collider, handle, &mut self.bodies);
        handle
    }
}

/// The distances of the colliders that are closer than `limit` to a shape, metres.
fn distances<'a>(
    query: &'a QueryPipeline<'_>,
    shape: &'a dyn Shape,
    pose: &'a Pose,
    limit: f64,
) -> impl Iterator<Item = f64> + 'a {
    // With a reach of 0 the engine does not find intersections with compound shapes.
    const LEAST_REACH: f64 = 1e-5;
    let reach = (limit.max(LEAST_REACH) * SCALE) as f32;
    let nearby = query.intersect_aabb_conservative(shape.compute_aabb(pose).loosened(reach));
    nearby.filter_map(move |(_, collider)| {
        let found = query::closest_points(pose, shape, collider.position(), collider.shape(), reach);
        match found {
            Ok(ClosestPoints::Intersecting) => Some(0.0),
            Ok(ClosestPoints::WithinMargin(a, b)) => Some(f64::from((b - a).length()) / SCALE),
            // Convex meshes and their compounds are all supported.
            Ok(ClosestPoints::Disjoint) | Err(_) => None,
        }
    })
}

/// The collision shape of an object in engine units, and its volume.
fn shape(object: &Object, scale: f64) -> (SharedShape, f32) {
    let factor = scale * SCALE;
    let mut parts: Vec<(Pose, SharedShape)> = object
        .parts
        .iter()
        .filter_map(|part| {
            let points: Vec<Vector> = part.vertices.iter().map(|p| vector(&(p.coords * factor))).collect();
            SharedShape::convex_hull(&points).map(|hull| (Pose::identity(), hull))
        })
        .collect();
    let volume = parts.iter().map(|(_, part)| part.mass_properties(1.0).mass()).sum();
    // A compound shape needs a tree; a single part does not.
    let shape = if parts.len() == 1 { parts.remove(0).1 } else { SharedShape::compound(parts) };
    (shape, volume)
}

pub(super) fn vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

pub(super) fn to_engine(pose: &Isometry3<f64>) -> Pose {
    let q = pose.rotation.quaternion().coords;
    Pose::from_parts(
        vector(&(pose.translation.vector * SCALE)),
        Rotation::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32).normalize(),
    )
}

pub(super) fn from_engine(pose: &Pose) -> Isometry3<f64> {
    let t = Vector3::new(pose.translation.x, pose.translation.y, pose.translation.z).cast::<f64>() / SCALE;
    let q = pose.rotation;
    let rotation = Quaternion::new(q.w, q.x, q.y, q.z).cast::<f64>();
    Isometry3::from_parts(t.into(), UnitQuaternion::from_quaternion(rotation))
}
