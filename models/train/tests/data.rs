//! Reading data sets, and changing scenes together with their grasps.

mod support;

use std::fs;

use grasp_train::{Augmentation, Dataset, Label, Transform};
use half::f16;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const N: usize = 16;

#[test]
fn a_data_set_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = [folder.path().join("pile"), folder.path().join("packed")];
    let scenes: Vec<_> = (0..5).map(|seed| support::scene(seed, N)).collect();
    support::write(&first, &scenes[..3], N);
    support::write(&second, &scenes[3..], N);
    let dataset = Dataset::read(&[first, second]).unwrap();
    assert_eq!(dataset.resolution, N);
    assert_eq!(dataset.grasps(), (10, 5));
    for (read, written) in dataset.scenes.iter().zip(&scenes) {
        assert_eq!((&read.id, &read.grid), (&written.id, &written.grid));
        for (read, written) in read.labels.iter().zip(&written.labels) {
            assert!((read.position - written.position).norm() < 1e-12);
            assert!(read.rotation.angle_to(&written.rotation) < 1e-6);
            assert_eq!((read.width, read.success), (written.width, written.success));
        }
    }
}

#[test]
fn what_cannot_be_read_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let error = || Dataset::read(&[folder.path().to_owned()]).unwrap_err().to_string();
    assert!(error().contains("grasps.csv: No such file"), "{}", error());

    support::write(folder.path(), &[support::scene(1, N)], N);
    let csv = folder.path().join("grasps.csv");
    let good = fs::read_to_string(&csv).unwrap();
    let line = good.lines().nth(2).unwrap();
    for (bad, said) in [
        (line.replace("000001", "000009"), "000009.npz"),
        ("000001,0,0,0,1,1,2,3,4,2".to_owned(), "line 4: label is 2"),
        ("000001,0,0,0,0.5,1,2,3,4,1".to_owned(), "line 4: the quaternion has length 0.5"),
        ("000001,0,0,0,1,nan,2,3,4,1".to_owned(), "line 4: i is NaN"),
        ("000001,0,0,0,1,one,2,3,4,1".to_owned(), "line 4:"),
        ("000001,0,0,0".to_owned(), "line 4:"),
    ] {
        fs::write(&csv, format!("{good}{bad}\n")).unwrap();
        assert!(error().contains(said), "{bad}: {}", error());
    }
    let raw = good.replace("i,j,k", "x,y,z");
    fs::write(&csv, raw).unwrap();
    assert!(error().contains("missing field `i`") && error().contains("in voxels"), "{}", error());
    fs::write(&csv, good.lines().next().unwrap()).unwrap();
    assert!(error().contains("holds no grasps"), "{}", error());
    fs::write(&csv, &good).unwrap();
    fs::write(folder.path().join("scenes/000001.npz"), "no archive").unwrap();
    assert!(error().contains("000001.npz"), "{}", error());
}

#[test]
fn scenes_stay_on_their_side_of_the_split() {
    let few = support::dataset(200, 8 * 2);
    let many = support::dataset(400, 8 * 2);
    let (training, held_out) = few.split(0.1);
    assert_eq!(training.len() + held_out.len(), 200);
    assert!((8..=35).contains(&held_out.len()), "{} of 200", held_out.len());
    assert!(held_out.iter().all(|scene| many.split(0.1).1.contains(scene)));
    assert_eq!(few.split(0.0).1, [0_usize; 0]);
}

fn random_label(rng: &mut ChaCha8Rng) -> Label {
    let position = Point3::from(std::array::from_fn(|_| rng.random_range(0.0..N as f64)));
    let rotation = UnitQuaternion::from_euler_angles(
        rng.random_range(-3.0..3.0),
        rng.random_range(-1.5..1.5),
        rng.random_range(-3.0..3.0),
    );
    Label { position, rotation, width: 5.0, success: true }
}

/// Points that fix a grasp up to its symmetry: the finger base and the two fingertips, in either order.
fn points(label: &Label) -> [Point3<f64>; 3] {
    let pose = Isometry3::from_parts(Translation3::from(label.position), label.rotation);
    let mut tips = [-1.0, 1.0].map(|side| pose * Point3::new(0.0, side * label.width / 2.0, 6.0));
    tips.sort_by(|a, b| a.x.total_cmp(&b.x));
    [label.position, tips[0], tips[1]]
}

/// Where a point of a scene goes when the scene is changed.
type Move<'a> = &'a dyn Fn(Point3<f64>) -> Point3<f64>;

#[test]
fn a_changed_label_is_the_label_of_the_changed_scene() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let edge = N as f64;
    let turned = |p: Point3<f64>| Point3::new(edge - p.y, p.x, p.z);
    let mirrored = |p: Point3<f64>| Point3::new(edge - p.x, p.y, p.z);
    let shifted = |p: Point3<f64>| Point3::new(p.x, p.y, p.z - 2.0);
    let moves: [(Transform, Move); 3] = [
        (Transform { turns: 1, ..Transform::default() }, &turned),
        (Transform { mirror: true, ..Transform::default() }, &mirrored),
        (Transform { shift: -2, ..Transform::default() }, &shifted),
    ];
    for _ in 0..50 {
        let label = random_label(&mut rng);
        for (transform, expected) in moves {
            let mut moved = points(&label).map(expected);
            moved[1..].sort_by(|a, b| a.x.total_cmp(&b.x));
            for (got, expected) in points(&transform.label(&label, N)).iter().zip(&moved) {
                assert!((got - expected).norm() < 1e-9, "{transform:?}: {got} instead of {expected}");
            }
        }
    }
}

#[test]
fn the_grid_moves_with_the_label() {
    // One voxel is different; the label stands at its centre, and so it must afterwards.
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let all = Augmentation { turns: true, mirror: true, shift: 2 };
    for _ in 0..50 {
        let cell: [usize; 3] = std::array::from_fn(|_| rng.random_range(2..N - 2));
        let mut grid = vec![f16::ZERO; N.pow(3)];
        grid[(cell[0] * N + cell[1]) * N + cell[2]] = f16::ONE;
        let label = Label { position: Point3::from(cell.map(|c| c as f64 + 0.5)), ..random_label(&mut rng) };
        let transform = all.draw(&mut rng);
        let mut changed = vec![0.0; N.pow(3)];
        transform.grid(&grid, N, &mut changed);
        let moved = transform.label(&label, N).position;
        let [x, y, z] = [moved.x, moved.y, moved.z].map(|c| c.floor() as usize);
        assert_eq!(changed.iter().sum::<f32>(), 1.0);
        assert_eq!(changed[(x * N + y) * N + z], 1.0, "{transform:?}");
    }
}

#[test]
fn four_turns_are_none() {
    let scene = support::scene(3, N);
    let turn = |turns| Transform { turns, ..Transform::default() };
    let mut grid = vec![0.0; N.pow(3)];
    turn(4).grid(&scene.grid, N, &mut grid);
    assert!(grid.iter().zip(&scene.grid).all(|(a, b)| *a == b.to_f32()));
    let label = &scene.labels[0];
    let turned = turn(4).label(label, N);
    assert!((turned.position - label.position).norm() < 1e-12);
    assert!(turned.rotation.angle_to(&label.rotation) < 1e-9);
    assert!((turn(1).label(label, N).position - label.position).norm() > 1e-3, "one turn is not none");
    let twice = turn(1).label(&turn(1).label(label, N), N);
    assert!((twice.position - turn(2).label(label, N).position).norm() < 1e-12);
}

#[test]
fn every_allowed_change_is_drawn_and_no_other() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut draw = |allowed: Augmentation| (0..200).map(|_| allowed.draw(&mut rng)).collect::<Vec<_>>();
    assert!(draw(Augmentation::default()).iter().all(|t| *t == Transform::default()));
    let drawn = draw(Augmentation { turns: true, mirror: true, shift: 1 });
    assert!((0..4).all(|turns| drawn.iter().any(|t| t.turns == turns)));
    assert!([false, true].iter().all(|mirror| drawn.iter().any(|t| t.mirror == *mirror)));
    assert!((-1..=1).all(|shift| drawn.iter().any(|t| t.shift == shift)));
    assert!(drawn.iter().all(|t| t.shift.abs() <= 1 && t.turns < 4));
}
