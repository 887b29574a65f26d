//! Small scenes to train on.

use std::path::Path;

use grasp_data::{Dataset, Occupancy, Provenance, Scene, Setup, Trial, processed};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A random box in a volume of n³ voxels, with a successful grasp from above at its middle and a failed one at its
/// corner.
pub fn scene(seed: u64, n: usize) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let low: [usize; 3] = std::array::from_fn(|_| rng.random_range(2..n / 2));
    let size: [usize; 3] = std::array::from_fn(|_| rng.random_range(3..n / 3));
    let inside = |cell: [usize; 3]| (0..3).all(|axis| (low[axis]..low[axis] + size[axis]).contains(&cell[axis]));
    let inside = |i: usize| inside([i / (n * n), i / n % n, i % n]);
    let value = |i: usize| if inside(i) { 64 } else { 191 };
    let mut occupancy = Occupancy::empty(n.pow(3));
    (0..n.pow(3)).filter(|&i| inside(i)).for_each(|i| occupancy.insert(i));
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), rng.random_range(0.0..3.0));
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let at = |fraction: f64| Point3::from(std::array::from_fn(|axis| low[axis] as f64 + fraction * size[axis] as f64));
    let width = size[0].min(size[1]) as f64;
    let (position, rotation) = (at(-0.3), yaw);
    let failure = Trial { position, rotation, width: 10.0, success: false, yaws: 0, share: 0.0, clearance: 0.0 };
    Scene {
        id: format!("{seed:06x}"),
        volumes: vec![(0..n.pow(3)).map(value).collect()],
        trials: vec![
            Trial { position: at(0.5), rotation: yaw * down, width, success: true, share: 1.0, ..failure },
            failure,
        ],
        occupancy: Some(occupancy),
    }
}

/// A data set of such scenes.
// Each test file compiles this module, and not all of them use this.
#[allow(dead_code)]
pub fn dataset(scenes: u64, n: usize) -> Dataset {
    Dataset::new((0..scenes).map(|seed| scene(seed, n)).collect()).unwrap()
}

/// Their provenance.
// As above.
#[allow(dead_code)]
pub fn provenance() -> Provenance {
    Provenance {
        scene: "boxes".into(),
        objects: "boxes".into(),
        part: "all".to_owned(),
        stretch: None,
        clearance: None,
        points: 2,
        views: "all".into(),
        observations: 1,
        noise: 0.0,
        sensor: "dex".to_owned(),
        correct_depth_scale: false,
        seed: 0,
        observation_seed: None,
        network: None,
        evaluator: None,
        details: false,
        version: String::new(),
    }
}

/// Writes scenes in the format of VGN and GIGA.
// As above.
#[allow(dead_code)]
pub fn write(folder: &Path, scenes: &[Scene]) {
    let mut writer = processed::Writer::open(folder, &Setup::benchmark(provenance())).unwrap();
    for scene in scenes {
        let volume: Vec<f32> = scene.volumes[0].iter().map(|&byte| grasp_data::value(byte)).collect();
        writer.append(&scene.id, &volume, &scene.trials).unwrap();
    }
}
