//! The physics: Coulomb friction, rest, collision shapes, and reproducible labels.

use std::f64::consts::PI;
use std::sync::Arc;

use grasp_picture::Mesh;
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::camera::{DepthNoise, Views};
use grasp_sim::hull::convex_hull;
use grasp_sim::label::{LabelledScene, SceneConfig};
use grasp_sim::objects::{Object, ObjectSet, Split};
use grasp_sim::physics::{Gripper, HandPart, STEPS_PER_SECOND, World};
use grasp_sim::scene::{SceneKind, generate, is_at_rest};
use grasp_sim::trial::{self, Outcome};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

const CUBE: f64 = 0.04;

fn cube(mass: f64, friction: f64) -> Arc<Object> {
    let mesh = Mesh::cuboid(Vector3::repeat(CUBE));
    Arc::new(Object { name: "cube".into(), parts: vec![mesh.clone()], visual: mesh, mass, friction })
}

fn cube_on_table(mass: f64, friction: f64) -> World {
    let mut world = World::new();
    let pose = Isometry3::translation(0.15, 0.15, TABLE_HEIGHT + CUBE / 2.0);
    world.add(&cube(mass, friction), 1.0, &pose);
    (0..240).for_each(|_| world.step());
    world
}

/// Straight down, the fingertips 1 cm above the table.
fn from_above() -> Isometry3<f64> {
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
    Isometry3::from_parts(Translation3::new(0.15, 0.15, TABLE_HEIGHT + 0.01 + grasp::FINGER_DEPTH), down)
}

#[test]
fn voxels_inside_objects_are_occupied() {
    let mut world = cube_on_table(0.2, 1.0);
    let turned = Isometry3::new(Vector3::new(0.05, 0.2, 0.2), Vector3::new(0.3, 0.2, 0.8));
    world.add(&cube(0.2, 1.0), 1.5, &turned);
    const N: usize = 40;
    let occupancy = world.occupancy(N);
    let voxel = grasp::WORKSPACE_SIZE / N as f64;
    let poses: Vec<_> = world.objects().iter().map(|body| (world.pose(body.id), body.scale)).collect();
    let (mut occupied, mut near) = (0, 0);
    for index in 0..N.pow(3) {
        let centre = [index / (N * N), index / N % N, index % N].map(|cell| (cell as f64 + 0.5) * voxel);
        // Positive outside.
        let outside = |(pose, scale): &(Isometry3<f64>, f64)| {
            let local = pose.inverse_transform_point(&Point3::from(centre));
            local.iter().map(|c| c.abs() - CUBE * scale / 2.0).fold(f64::NEG_INFINITY, f64::max)
        };
        let distance = poses.iter().map(outside).fold(f64::INFINITY, f64::min);
        occupied += usize::from(occupancy.contains(index));
        near += usize::from(distance.abs() < 1e-5);
        assert!(distance.abs() < 1e-5 || occupancy.contains(index) == (distance < 0.0), "{centre:?}: {distance}");
    }
    assert!(occupied > 400 && near < occupied / 4, "{occupied} voxels, {near} of them at a surface");
}

#[test]
fn a_cube_is_lifted() {
    let world = cube_on_table(0.2, 1.0);
    match trial::label(&world, &from_above(), 0.0) {
        // The collision shape of the cube is 1 mm larger on each side; that of a finger is larger, too, minus its
        // softness.
        Outcome::Lifted { width, .. } => assert!((0.001..0.004).contains(&(width - CUBE)), "held at {width} m"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_frictionless_cube_slips() {
    let outcome = trial::label(&cube_on_table(0.2, 0.0), &from_above(), 0.0);
    assert_eq!(outcome, Outcome::LostInLift);
}

#[test]
fn the_smallest_friction_that_holds_follows_coulombs_law() {
    // Two fingers of 20 N hold 0.4 kg × 9.81 m/s² from μ = 3.924 / 40 = 0.0981 on.
    let is_held = |friction: f64| {
        let mut world = cube_on_table(0.4, friction);
        let mut gripper = Gripper::insert(&mut world, &from_above(), &from_above());
        for step in 0..3 * STEPS_PER_SECOND {
            // Half a second to close, then up by 6 cm as slowly as adds next to nothing to the weight.
            let time = (f64::from(step) / f64::from(STEPS_PER_SECOND) - 0.5).max(0.0);
            gripper.set_velocity(&mut world, &(Vector3::z() * 0.02 * time));
            gripper.close(&mut world);
            world.step();
        }
        world.pose(world.objects()[0].id).translation.z > TABLE_HEIGHT + CUBE / 2.0 + 0.05
    };
    assert!(!is_held(0.095));
    // The fingers reach slightly less than their nominal force.
    assert!(is_held(0.12));
}

/// The engine's shapes have the right size: a needle along x is near the shape exactly inside the mesh's outline.
#[test]
fn outlines_of_hulls_and_cylinders_are_those_of_their_meshes() {
    let needle = Mesh::cuboid(Vector3::new(4e-4, 4e-4, 0.3)).vertices;
    let needle = [HandPart::new(needle.iter().map(|p| p - Vector3::z() * 0.15).collect())];
    const ERROR: f64 = 4e-4;
    const GAP: f64 = 0.001;
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let cloud: Vec<Point3<f64>> =
        (0..40).map(|_| Point3::from(Vector3::from_fn(|_, _| rng.random_range(-0.03..0.03)))).collect();
    let along_x = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), PI / 2.0);
    for mesh in [convex_hull(&cloud).unwrap(), Mesh::cylinder(0.02, 0.08, 48)] {
        let tilted = Isometry3::new(Vector3::new(0.15, 0.15, 0.2), Vector3::new(0.4, 0.7, -0.3));
        let mut world = World::new();
        let object =
            Object { name: "shape".into(), parts: vec![mesh.clone()], visual: mesh.clone(), mass: 0.1, friction: 1.0 };
        world.add(&Arc::new(object), 1.0, &tilted);
        world.step();
        let outline: Vec<[f64; 2]> = mesh.vertices.iter().map(|p| tilted * p).map(|p| [p.y, p.z]).collect();
        // Distance of a point outside the outline: the maximum over all directions of the distance beyond the outline.
        let outside = |y: f64, z: f64| {
            let beyond = |(sin, cos): (f64, f64)| {
                let reach = outline.iter().map(|p| p[0] * cos + p[1] * sin).fold(f64::NEG_INFINITY, f64::max);
                y * cos + z * sin - reach
            };
            (0..720).map(|i| beyond((f64::from(i) * PI / 360.0).sin_cos())).fold(f64::NEG_INFINITY, f64::max)
        };
        let (mut hits, mut misses) = (0, 0);
        for (i, j) in (0..60).flat_map(|i| (0..60).map(move |j| (i, j))) {
            let (y, z) = (0.09 + 0.002 * f64::from(i), 0.14 + 0.002 * f64::from(j));
            let pose = Isometry3::from_parts(Translation3::new(0.3, y, z), along_x);
            let hit = world.is_near(&needle, &pose, GAP);
            let outside = outside(y, z);
            assert!(
                (outside - GAP).abs() < ERROR || hit == (outside < GAP),
                "at {y:.3}, {z:.3}: {outside} m outside, hit {hit}"
            );
            if hit { hits += 1 } else { misses += 1 }
        }
        assert!(hits > 200 && misses > 200, "{hits} hits, {misses} misses");
    }
}

#[test]
fn contact_on_the_approach_is_a_failure_only_for_labels() {
    // The cube is 4 cm wide. With a shift of 3 cm one finger is above it.
    let shifted = Translation3::new(0.0, 0.03, 0.0) * from_above();
    assert_eq!(trial::label(&cube_on_table(0.2, 1.0), &shifted, 0.0), Outcome::BlockedOnApproach);
    let (outcome, short_by) = trial::execute(&mut cube_on_table(0.2, 1.0), &shifted);
    assert_ne!(outcome, Outcome::BlockedOnApproach);
    assert!((0.001..0.05).contains(&short_by), "the hand stops at the contact: {short_by}");
    let through_the_table = Translation3::new(0.0, 0.0, -0.02) * from_above();
    assert_eq!(trial::label(&cube_on_table(0.2, 1.0), &through_the_table, 0.0), Outcome::BlockedOnApproach);
}

#[test]
fn an_enlarged_hand_needs_clearance_on_its_approach() {
    // The fingers pass the cube at 20 mm on each side; with a shift of 16 mm one of them at 4 mm.
    let shifted = Translation3::new(0.0, 0.016, 0.0) * from_above();
    let world = cube_on_table(0.2, 1.0);
    assert!((trial::clearance(&world, &shifted, 0.02) - 0.004).abs() < 1e-4);
    assert!(trial::label(&world, &shifted, 0.0).is_success());
    assert_eq!(trial::label(&world, &shifted, 0.002), Outcome::BlockedOnApproach);
}

#[test]
fn a_hand_that_overlaps_the_table_is_pushed_out() {
    // A horizontal approach. The palm is 20 cm wide; on edge, half of it is in the table.
    let level = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), PI / 2.0);
    let on_edge = level * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI / 2.0);
    let far_from_the_cube = Translation3::new(0.05, 0.05, TABLE_HEIGHT + 0.06);
    for (rotation, expected) in [(level, Outcome::ClosedOnNothing), (on_edge, Outcome::BlockedAtPregrasp)] {
        let grasp = Isometry3::from_parts(far_from_the_cube, rotation);
        assert_eq!(trial::execute(&mut cube_on_table(0.2, 1.0), &grasp).0, expected);
        assert!(!trial::label(&cube_on_table(0.2, 1.0), &grasp, 0.0).is_success());
    }
}

#[test]
fn a_hundred_piles_come_to_rest_and_stay() {
    let objects = ObjectSet::procedural(Split::PileTest);
    (0..100).into_par_iter().for_each(|seed| {
        let mut world = generate(SceneKind::Pile, &objects, 5, &mut ChaCha8Rng::seed_from_u64(seed));
        // Generation gives up after a time limit, so that rest is not guaranteed.
        assert!(is_at_rest(&world), "seed {seed}");
        let poses = |world: &World| world.objects().iter().map(|body| world.pose(body.id)).collect::<Vec<_>>();
        let before = poses(&world);
        (0..240).for_each(|_| world.step());
        for (a, b) in before.iter().zip(poses(&world)) {
            let moved = (a.translation.vector - b.translation.vector).norm();
            assert!(moved < 1e-4, "seed {seed}: {moved} m in a second of rest");
        }
    });
}

#[test]
fn labels_do_not_depend_on_order_or_threads() {
    let config = SceneConfig {
        kind: SceneKind::Pile,
        objects: ObjectSet::procedural(Split::Train),
        points: 10,
        views: Views::Random(1..=2),
        observations: 2,
        noise: DepthNoise::BENCHMARK,
        seed: 3,
    };
    let forward: Vec<Option<LabelledScene>> = (0..2).map(|index| config.label(index)).collect();
    let mut backward: Vec<_> = (0..2).rev().map(|index| config.label(index)).collect();
    backward.reverse();
    let parallel: Vec<_> = (0..2).into_par_iter().map(|index| config.label(index)).collect();
    assert_eq!(forward, backward);
    assert_eq!(forward, parallel);
    assert!(forward.iter().flatten().count() > 0);
}
