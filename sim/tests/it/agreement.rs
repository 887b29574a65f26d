//! Agreement of labels with another physics engine: trials replayed in MuJoCo (`mujoco/replay.py`).

use std::fs;

use grasp_sim::export::Object;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::physics::{CONTACT_GAP, World};
use grasp_sim::trial::{Outcome, label};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::Deserialize;

#[derive(Deserialize)]
struct Scene {
    objects: Vec<Object>,
    points: Vec<Point>,
}

#[derive(Deserialize)]
struct Point {
    /// Pose at the first yaw.
    pose: [f64; 7],
    /// Outcome of each yaw: 0 blocked on the approach, 1 failed later, 2 lifted.
    mujoco: [u8; 5],
}

fn isometry(&[x, y, z, qx, qy, qz, qw]: &[f64; 7]) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz));
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

/// Contingency table of the outcomes: `table[ours][MuJoCo's]`.
fn compare(scenes: &[Scene]) -> [[usize; 3]; 3] {
    let set = ObjectSet::procedural(Split::Train);
    let pairs: Vec<(usize, usize)> = scenes
        .par_iter()
        .flat_map_iter(|scene| {
            let mut world = World::new();
            for Object { object, scale, pose } in &scene.objects {
                let known = set.listed().iter().find(|known| known.name == *object);
                world.add(known.expect("the stored scenes are of this set"), *scale, &isometry(pose));
            }
            // The steps create the contacts of resting objects.
            (0..60).for_each(|_| world.step());
            let trial = move |point: &Point, yaw: usize| {
                let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw as f64 * std::f64::consts::PI / 5.0);
                // In MuJoCo contacts start at distance 0.
                let ours = match label(&world, &(isometry(&point.pose) * turn), -CONTACT_GAP) {
                    Outcome::BlockedAtPregrasp | Outcome::BlockedOnApproach => 0,
                    Outcome::ClosedOnNothing | Outcome::LostInLift => 1,
                    Outcome::Lifted { .. } => 2,
                };
                (ours, usize::from(point.mujoco[yaw]))
            };
            scene.points.iter().flat_map(|point| (0..5).map(move |yaw| (point, yaw))).map(move |(p, yaw)| trial(p, yaw))
        })
        .collect();
    let mut table = [[0; 3]; 3];
    pairs.into_iter().for_each(|(ours, theirs)| table[ours][theirs] += 1);
    table
}

#[test]
fn labels_agree_with_mujoco() {
    let text = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/mujoco/trials.jsonl")).unwrap();
    let scenes: Vec<Scene> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let table = compare(&scenes);
    let all: usize = table.iter().flatten().sum();
    let lifted = |ours: usize, theirs: usize| (ours == 2) == (theirs == 2);
    let cells = || (0..3).flat_map(|ours| (0..3).map(move |theirs| (ours, theirs)));
    let sum = |counts: &dyn Fn(usize, usize) -> bool| -> usize {
        cells().filter(|&(ours, theirs)| counts(ours, theirs)).map(|(ours, theirs)| table[ours][theirs]).sum()
    };
    let agree = sum(&lifted) as f64 / all as f64;
    let closed = sum(&|ours, theirs| ours > 0 && theirs > 0);
    let agree_closed = sum(&|ours, theirs| ours > 0 && theirs > 0 && lifted(ours, theirs)) as f64 / closed as f64;
    println!("{all} trials, agreement {agree:.3}; {closed} that close, {agree_closed:.3}: {table:?}");
    assert!(all > 1000 && closed > 100);
    assert!(agree >= 0.99, "agreement {agree}: {table:?}");
    assert!(agree_closed >= 0.9, "agreement of those that close {agree_closed}: {table:?}");
}
