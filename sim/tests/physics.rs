//! What the physics must get right: friction as Coulomb has it, rest without energy, and the same labels every time.

use std::f64::consts::PI;
use std::sync::Arc;

use grasp_sim::TABLE_HEIGHT;
use grasp_sim::camera::Views;
use grasp_sim::label::{LabelledScene, Recipe};
use grasp_sim::mesh::Mesh;
use grasp_sim::objects::{Object, ObjectSet, Split};
use grasp_sim::physics::World;
use grasp_sim::scene::{SceneKind, generate, is_at_rest};
use grasp_sim::trial::{self, Outcome};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::SeedableRng;
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
fn a_cube_is_lifted() {
    let world = cube_on_table(0.2, 1.0);
    match trial::label(&world, &from_above()) {
        Outcome::Lifted { width, .. } => assert!((width - CUBE).abs() < 1e-3, "held at {width} m"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_frictionless_cube_slips() {
    let outcome = trial::label(&cube_on_table(0.2, 0.0), &from_above());
    assert_eq!(outcome, Outcome::LostInLift);
}

#[test]
fn the_least_friction_that_holds_is_coulombs() {
    // Two fingers of 20 N hold 0.4 kg × 9.81 m/s² from μ = 3.924 / 40 = 0.098 on; the lift's start adds 2 m/s².
    assert!(!trial::label(&cube_on_table(0.4, 0.095), &from_above()).is_success());
    assert!(trial::label(&cube_on_table(0.4, 0.12), &from_above()).is_success());
}

#[test]
fn contact_on_the_way_is_a_failure_only_when_labelling() {
    // Both fingers over the cube: closed along x, it is 4 cm wide, but shifted by 3 cm a finger stands on it.
    let shifted = Translation3::new(0.0, 0.03, 0.0) * from_above();
    assert_eq!(trial::label(&cube_on_table(0.2, 1.0), &shifted), Outcome::BlockedOnApproach);
    let (outcome, short_by) = trial::execute(&mut cube_on_table(0.2, 1.0), &shifted);
    assert_ne!(outcome, Outcome::BlockedOnApproach);
    assert!((0.001..0.05).contains(&short_by), "the hand stops where the finger stands: {short_by}");
    let through_the_table = Translation3::new(0.0, 0.0, -0.02) * from_above();
    assert_eq!(trial::label(&cube_on_table(0.2, 1.0), &through_the_table), Outcome::BlockedOnApproach);
}

#[test]
fn a_pile_comes_to_rest_and_stays() {
    let objects = ObjectSet::procedural(Split::PileTest);
    for seed in 0..20 {
        let mut world = generate(SceneKind::Pile, &objects, 5, &mut ChaCha8Rng::seed_from_u64(seed));
        assert!(is_at_rest(&world), "seed {seed}");
        let poses = |world: &World| world.objects().iter().map(|body| world.pose(body.id)).collect::<Vec<_>>();
        let before = poses(&world);
        (0..240).for_each(|_| world.step());
        for (a, b) in before.iter().zip(poses(&world)) {
            let moved = (a.translation.vector - b.translation.vector).norm();
            assert!(moved < 1e-4, "seed {seed}: {moved} m in a second of rest");
        }
    }
}

#[test]
fn labels_do_not_depend_on_order_or_threads() {
    let recipe = Recipe {
        kind: SceneKind::Pile,
        objects: ObjectSet::procedural(Split::Train),
        points: 10,
        views: Views::Anywhere(1..=2),
        looks: 2,
        noise: 1.0,
        seed: 3,
    };
    let forward: Vec<Option<LabelledScene>> = (0..4).map(|index| recipe.label(index)).collect();
    let mut backward: Vec<_> = (0..4).rev().map(|index| recipe.label(index)).collect();
    backward.reverse();
    let parallel: Vec<_> = (0..4).into_par_iter().map(|index| recipe.label(index)).collect();
    assert_eq!(forward, backward);
    assert_eq!(forward, parallel);
    assert!(forward.iter().flatten().count() > 0);
}
