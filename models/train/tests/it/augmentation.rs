//! Augmentation of scenes together with their grasps.

use grasp_data::{MAX_CLEARANCE, Trial};
use grasp_train::{Augmentation, Transform};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::support;

const N: usize = 16;

fn random_trial(rng: &mut ChaCha8Rng) -> Trial {
    let position = Point3::from(std::array::from_fn(|_| rng.random_range(0.0..N as f64)));
    let rotation = UnitQuaternion::from_euler_angles(
        rng.random_range(-3.0..3.0),
        rng.random_range(-1.5..1.5),
        rng.random_range(-3.0..3.0),
    );
    let yaws = rng.random::<u8>() & 0b1_1110;
    let (share, clearance) = (rng.random(), rng.random_range(0.0..MAX_CLEARANCE));
    Trial { position, rotation, width: 5.0, success: true, yaws, share, clearance }
}

/// Points that define a grasp up to its symmetry: the finger base and the two fingertips; for the grasp and for each
/// other valid yaw.
fn points(trial: &Trial) -> Vec<[Point3<f64>; 3]> {
    let points_of = |rotation| {
        let pose = Isometry3::from_parts(Translation3::from(trial.position), rotation);
        let [left, right] = [-1.0, 1.0].map(|side| pose * Point3::new(0.0, side * trial.width / 2.0, 6.0));
        [trial.position, left, right]
    };
    trial.rotations().map(points_of).collect()
}

/// Whether two grasps are the same, with the fingers in either order.
fn same([base, left, right]: [Point3<f64>; 3], other: [Point3<f64>; 3]) -> bool {
    let close = |points: [Point3<f64>; 3]| points.iter().zip(&other).all(|(a, b)| (a - b).norm() < 1e-9);
    close([base, left, right]) || close([base, right, left])
}

/// Maps a point of a scene to the transformed scene.
type PointMap<'a> = &'a dyn Fn(Point3<f64>) -> Point3<f64>;

#[test]
fn a_trial_is_transformed_like_its_scene() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let edge = N as f64;
    let rotated = |p: Point3<f64>| Point3::new(edge - p.y, p.x, p.z);
    let mirrored = |p: Point3<f64>| Point3::new(edge - p.x, p.y, p.z);
    let shifted = |p: Point3<f64>| Point3::new(p.x, p.y, p.z - 2.0);
    let moves: [(Transform, PointMap); 3] = [
        (Transform { quarter_turns: 1, ..Transform::default() }, &rotated),
        (Transform { mirror: true, ..Transform::default() }, &mirrored),
        (Transform { shift: -2, ..Transform::default() }, &shifted),
    ];
    for _ in 0..50 {
        let trial = random_trial(&mut rng);
        for (transform, expected) in moves {
            let moved: Vec<_> = points(&trial).into_iter().map(|grasp| grasp.map(expected)).collect();
            let changed = transform.trial(&trial, N);
            assert_eq!(
                (changed.share, changed.clearance),
                (trial.share, trial.clearance),
                "share and clearance stay the same"
            );
            let got = points(&changed);
            assert!(same(got[0], moved[0]), "{transform:?}: {:?} instead of {:?}", got[0], moved[0]);
            assert_eq!(got.len(), moved.len());
            assert!(moved.iter().all(|moved| got.iter().any(|got| same(*got, *moved))), "{transform:?}: {got:?}");
        }
    }
}

#[test]
fn a_volume_is_transformed_like_its_trials() {
    // One voxel differs, with the label at its centre. The transform must preserve this.
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let all = Augmentation { rotate: true, mirror: true, shift: 2 };
    for _ in 0..50 {
        let cell: [usize; 3] = std::array::from_fn(|_| rng.random_range(2..N - 2));
        let mut grid = vec![0; N.pow(3)];
        grid[(cell[0] * N + cell[1]) * N + cell[2]] = 255;
        let trial = Trial { position: Point3::from(cell.map(|c| c as f64 + 0.5)), ..random_trial(&mut rng) };
        let transform = all.draw(&mut rng);
        let mut changed = vec![0.0; N.pow(3)];
        transform.volume(&grid, N, &mut changed);
        let moved = transform.trial(&trial, N).position;
        let [x, y, z] = [moved.x, moved.y, moved.z].map(|c| c.floor() as usize);
        assert_eq!(changed.iter().sum::<f32>(), 1.0);
        assert_eq!(changed[(x * N + y) * N + z], 1.0, "{transform:?}");
        assert_eq!(transform.voxel(cell, N), Some([x, y, z]), "{transform:?}");
    }
}

#[test]
fn four_rotations_by_90_degrees_are_the_identity() {
    let scene = support::scene(3, N);
    let by_quarters = |quarter_turns| Transform { quarter_turns, ..Transform::default() };
    let mut grid = vec![0.0; N.pow(3)];
    by_quarters(4).volume(&scene.volumes[0], N, &mut grid);
    assert!(grid.iter().zip(&scene.volumes[0]).all(|(a, b)| *a == grasp_data::value(*b)));
    let trial = &scene.trials[0];
    let rotated = by_quarters(4).trial(trial, N);
    assert!((rotated.position - trial.position).norm() < 1e-12);
    assert!(rotated.rotation.angle_to(&trial.rotation) < 1e-9);
    assert!(
        (by_quarters(1).trial(trial, N).position - trial.position).norm() > 1e-3,
        "one rotation by 90° is not the identity"
    );
    let twice = by_quarters(1).trial(&by_quarters(1).trial(trial, N), N);
    assert!((twice.position - by_quarters(2).trial(trial, N).position).norm() < 1e-12);
}

#[test]
fn all_allowed_transforms_are_drawn_and_no_others() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut draw = |allowed: Augmentation| (0..200).map(|_| allowed.draw(&mut rng)).collect::<Vec<_>>();
    assert!(draw(Augmentation::default()).iter().all(|t| *t == Transform::default()));
    let drawn = draw(Augmentation { rotate: true, mirror: true, shift: 1 });
    assert!((0..4).all(|quarters| drawn.iter().any(|t| t.quarter_turns == quarters)));
    assert!([false, true].iter().all(|mirror| drawn.iter().any(|t| t.mirror == *mirror)));
    assert!((-1..=1).all(|shift| drawn.iter().any(|t| t.shift == shift)));
    assert!(drawn.iter().all(|t| t.shift.abs() <= 1 && t.quarter_turns < 4));
}
