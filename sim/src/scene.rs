//! Generation of scenes: objects dropped into a pile or placed upright, at rest on the table.

use std::f64::consts::TAU;
use std::ops::Range;

use grasp::WORKSPACE_SIZE;
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

use crate::TABLE_HEIGHT;
use crate::objects::{Object, ObjectSet};
use crate::physics::{STEPS_PER_SECOND, World};

/// The scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneKind {
    /// Objects dropped at random.
    Pile,
    /// Objects standing upright, side by side.
    Packed,
}

/// Scale of the objects of a pile.
const PILE_SCALE: Range<f64> = 0.8..1.0;

/// Scale of packed objects.
const PACKED_SCALE: Range<f64> = 0.7..0.9;

impl SceneKind {
    /// The average scale of the objects of a scene.
    #[must_use]
    pub fn mean_scale(self) -> f64 {
        let range = match self {
            Self::Pile => PILE_SCALE,
            Self::Packed => PACKED_SCALE,
        };
        (range.start + range.end) / 2.0
    }
}

/// Velocity norm (m/s and rad/s together) at which a body counts as resting.
const REST_SPEED: f64 = 0.01;

/// Steps between two checks for rest.
const REST_CHUNK: u32 = 60;

/// Maximum number of scenes that are generated until one comes to rest.
const DRAWS: usize = 3;

/// Generates a scene of up to `count` objects drawn from `objects`, at rest. It depends only on the state of `rng`.
#[must_use]
pub fn generate(kind: SceneKind, objects: &ObjectSet, count: usize, rng: &mut impl Rng) -> World {
    // One pile in a hundred has a round object that never stops rolling. The scene would change between observation and
    // trial.
    let mut world = draw(kind, objects, count, rng);
    for _ in 1..DRAWS {
        if is_at_rest(&world) {
            break;
        }
        world = draw(kind, objects, count, rng);
    }
    world
}

fn draw(kind: SceneKind, objects: &ObjectSet, count: usize, rng: &mut impl Rng) -> World {
    let mut world = match kind {
        SceneKind::Pile => pile(objects, count, rng),
        SceneKind::Packed => packed(objects, count, rng),
    };
    // A further second of simulation, because contacts still creep at speeds below `REST_SPEED`.
    wait_for_rest(&mut world, 5.0);
    (0..STEPS_PER_SECOND).for_each(|_| world.step());
    settle(&mut world);
    world
}

/// Simulates until everything rests and removes objects that left the workspace, until no object leaves.
pub fn settle(world: &mut World) {
    loop {
        wait_for_rest(world, 2.0);
        let workspace = 0.0..=WORKSPACE_SIZE;
        let gone: Vec<_> = world
            .objects()
            .iter()
            .map(|body| body.id)
            .filter(|&id| !world.pose(id).translation.vector.iter().all(|c| workspace.contains(c)))
            .collect();
        if gone.is_empty() {
            return;
        }
        gone.into_iter().for_each(|id| world.remove(id));
    }
}

/// Whether every object rests.
#[must_use]
pub fn is_at_rest(world: &World) -> bool {
    world.objects().iter().all(|body| world.speed(body.id) <= REST_SPEED)
}

/// Simulates until every object rests, for at most `timeout` seconds.
fn wait_for_rest(world: &mut World, timeout: f64) {
    let chunks = (timeout * f64::from(STEPS_PER_SECOND) / f64::from(REST_CHUNK)).ceil() as u32;
    for _ in 0..chunks {
        (0..REST_CHUNK).for_each(|_| world.step());
        if is_at_rest(world) {
            return;
        }
    }
}

/// Drops objects one by one into an open box, and removes the box.
fn pile(objects: &ObjectSet, count: usize, rng: &mut impl Rng) -> World {
    const BOX: Range<f64> = 0.02..0.28;
    const BOX_HEIGHT: f64 = 0.13;
    const DROP_HEIGHT: f64 = 0.2;
    let mut world = World::new();
    world.add_walls([BOX.start; 2], [BOX.end; 2], BOX_HEIGHT);
    for _ in 0..count {
        let object = objects.draw(rng);
        let position =
            Translation3::new(rng.random_range(0.1..0.2), rng.random_range(0.1..0.2), TABLE_HEIGHT + DROP_HEIGHT);
        let pose = Isometry3::from_parts(position, random_rotation(rng));
        world.add(&object, rng.random_range(PILE_SCALE), &pose);
        wait_for_rest(&mut world, 1.0);
    }
    world.remove_walls();
    settle(&mut world);
    world
}

/// Places objects upright at free positions.
fn packed(objects: &ObjectSet, count: usize, rng: &mut impl Rng) -> World {
    const ATTEMPTS: usize = 12;
    const CLEARANCE: f64 = 0.002;
    /// Enlargement of Bullet's bounding boxes on each side, metres.
    const BOX_MARGIN: f64 = 0.003;
    let mut world = World::new();
    for _ in 0..ATTEMPTS {
        if world.objects().len() >= count {
            break;
        }
        let object = objects.draw(rng);
        let (x, y) = (rng.random_range(0.08..0.22), rng.random_range(0.08..0.22));
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), rng.random_range(0.0..TAU));
        let scale = rng.random_range(PACKED_SCALE);
        // As in VGN's code, the object's origin is placed at half its height. An object that would intersect the table
        // is rejected; an object above the table falls.
        let z = TABLE_HEIGHT + scale * height(&object) / 2.0 + BOX_MARGIN + CLEARANCE;
        let pose = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
        if !world.is_occupied(&object, scale, &pose) {
            world.add(&object, scale, &pose);
            settle(&mut world);
        }
    }
    world
}

/// Uniform over all rotations, because a 4-D Gaussian is isotropic.
fn random_rotation(rng: &mut impl Rng) -> UnitQuaternion<f64> {
    let [x, y, z, w] = std::array::from_fn(|_| StandardNormal.sample(rng));
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

fn height(object: &Object) -> f64 {
    let heights = || object.parts.iter().flat_map(|part| &part.vertices).map(|p: &Point3<f64>| p.z);
    heights().fold(f64::NEG_INFINITY, f64::max) - heights().fold(f64::INFINITY, f64::min)
}
