//! Small scenes to train on.

use std::fs;
use std::path::Path;

use grasp_train::{Dataset, Label, Scene};
use half::f16;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use npyz::WriterBuilder;
use npyz::npz::NpzWriter;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A box somewhere in a volume of n³ voxels, grasped from above at its middle and, in vain, at its corner.
pub fn scene(seed: u64, n: usize) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let low: [usize; 3] = std::array::from_fn(|_| rng.random_range(2..n / 2));
    let size: [usize; 3] = std::array::from_fn(|_| rng.random_range(3..n / 3));
    let inside = |cell: [usize; 3]| (0..3).all(|axis| (low[axis]..low[axis] + size[axis]).contains(&cell[axis]));
    let value = |i: usize| if inside([i / (n * n), i / n % n, i % n]) { 0.25 } else { 0.75 };
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), rng.random_range(0.0..3.0));
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let at = |fraction: f64| Point3::from(std::array::from_fn(|axis| low[axis] as f64 + fraction * size[axis] as f64));
    let width = size[0].min(size[1]) as f64;
    Scene {
        id: format!("{seed:06x}"),
        grid: (0..n.pow(3)).map(|i| f16::from_f32(value(i))).collect(),
        labels: vec![
            Label { position: at(0.5), rotation: yaw * down, width, success: true },
            Label { position: at(-0.3), rotation: yaw, width: 10.0, success: false },
        ],
    }
}

/// A data set of such scenes.
// Every test file compiles this module for itself; not all of them call this.
#[allow(dead_code)]
pub fn dataset(scenes: u64, n: usize) -> Dataset {
    Dataset { resolution: n, scenes: (0..scenes).map(|seed| scene(seed, n)).collect() }
}

/// Writes scenes as VGN and GIGA do.
// As above.
#[allow(dead_code)]
pub fn write(folder: &Path, scenes: &[Scene], n: usize) {
    fs::create_dir_all(folder.join("scenes")).unwrap();
    let mut csv = "scene_id,qx,qy,qz,qw,i,j,k,width,label\n".to_owned();
    for scene in scenes {
        for label in &scene.labels {
            let [x, y, z, w]: [f64; 4] = label.rotation.coords.into();
            let [i, j, k]: [f64; 3] = label.position.coords.into();
            let success = u8::from(label.success);
            csv += &format!("{},{x},{y},{z},{w},{i},{j},{k},{},{success}\n", scene.id, label.width);
        }
        let mut npz = NpzWriter::create(folder.join("scenes").join(format!("{}.npz", scene.id))).unwrap();
        let edge = n as u64;
        let array = npz.array("grid", Default::default()).unwrap();
        let mut writer = array.default_dtype().shape(&[1, edge, edge, edge]).begin_nd().unwrap();
        writer.extend(scene.grid.iter().map(|value| value.to_f32())).unwrap();
        writer.finish().unwrap();
    }
    fs::write(folder.join("grasps.csv"), csv).unwrap();
}
