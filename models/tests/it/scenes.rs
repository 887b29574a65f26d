//! The shipped models, and scenes on which their outputs are compared.

use std::fs;
use std::path::{Path, PathBuf};

use grasp::Volume;
use nalgebra::Isometry3;

const N: usize = 40;
const VOXEL: f32 = 0.0075;
/// Truncation of the signed distance, metres: four voxels.
const TRUNCATION: f32 = 4.0 * VOXEL;
const TABLE: f32 = 0.05;

/// The files of a folder of the zoo, by name: `.` has the networks.
pub fn shipped(folder: &str) -> Vec<PathBuf> {
    let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("zoo").join(folder);
    let mut files: Vec<PathBuf> = fs::read_dir(zoo).unwrap().map(|file| file.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "onnx"));
    files.sort();
    assert!(!files.is_empty());
    files
}

/// Scenes with their names: blocks on a table, an empty table, and a single observed voxel.
pub fn all() -> Vec<(&'static str, Volume)> {
    let block = [[0.13, 0.11, TABLE], [0.17, 0.19, 0.15]];
    let pile = [
        [[0.08, 0.08, TABLE], [0.12, 0.16, 0.09]],
        [[0.15, 0.10, TABLE], [0.21, 0.14, 0.12]],
        [[0.10, 0.19, TABLE], [0.20, 0.22, 0.08]],
    ];
    vec![
        ("a block", volume(&[block])),
        ("three blocks", volume(&pile)),
        ("an empty table", volume(&[])),
        ("a single observed voxel", of_values(|index| if index == N.pow(3) / 2 { 0.5 } else { 0.0 })),
    ]
}

/// The volume of axis-aligned boxes `[low, high]` on the table, seen from all sides: 0 further than the truncation from
/// any surface, else the scaled distance.
fn volume(boxes: &[[[f32; 3]; 2]]) -> Volume {
    of_values(|index| {
        let point = [index / (N * N), index / N % N, index % N].map(|i| (i as f32 + 0.5) * VOXEL);
        let distances = boxes.iter().map(|[low, high]| {
            let outside = [0, 1, 2].map(|axis| (low[axis] - point[axis]).max(point[axis] - high[axis]));
            let distance = outside.map(|d| d.max(0.0)).iter().map(|d| d * d).sum::<f32>().sqrt();
            distance + outside.into_iter().fold(f32::NEG_INFINITY, f32::max).min(0.0)
        });
        let distance = distances.fold(point[2] - TABLE, f32::min) / TRUNCATION;
        if distance.abs() < 1.0 { (distance + 1.0) / 2.0 } else { 0.0 }
    })
}

/// The volume with these values, by voxel index.
fn of_values(value: impl Fn(usize) -> f32) -> Volume {
    Volume::new(N, f64::from(VOXEL), Isometry3::identity(), (0..N.pow(3)).map(value).collect()).unwrap()
}
