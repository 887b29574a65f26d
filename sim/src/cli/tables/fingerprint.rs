//! Hashes of what the results depend on. If a hash changes, its runs are repeated.

use std::path::{Path, PathBuf};
use std::{fs, io};

use anyhow::Context;
use grasp::{Grasp, Maps, RESOLUTION, Volume, WORKSPACE_SIZE, decode};
use grasp_sim::camera::DepthNoise;
use grasp_sim::label::SceneConfig;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::tables::{EPSILON, VIEWS};
use nalgebra::Isometry3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};

use super::params;
use crate::cli::{Scene, parse_views};

/// Hash of two labelled scenes, which changes with the simulator.
pub(super) fn simulator() -> String {
    let scenes = [Scene::Pile, Scene::Packed].map(|scene| {
        let config = SceneConfig {
            kind: scene.kind(),
            objects: ObjectSet::procedural(Split::PileTest),
            points: 10,
            views: parse_views(VIEWS[0].0).expect("the paper's view is one"),
            observations: 1,
            noise: DepthNoise::BENCHMARK,
            seed: 1,
        };
        config.label(1)
    });
    // Only numbers, so that types and fields can be renamed.
    let seen = scenes.iter().flatten().flat_map(|scene| &scene.observations).flat_map(|seen| &seen.volume);
    let trials = scenes.iter().flatten().flat_map(|scene| &scene.points).flat_map(|point| {
        let own = [point.share, point.clearance, f32::from(u8::from(point.success()))].map(f64::from);
        [numbers(&point.grasp), own.to_vec(), point.lifted.map(|lifted| f64::from(u8::from(lifted))).to_vec()].concat()
    });
    digest(&format!("{:?} {:?}", seen.collect::<Vec<_>>(), trials.collect::<Vec<_>>()))
}

/// Hash of the grasps in a random volume with random maps, which changes with the decoder.
pub(super) fn decoding() -> String {
    /// Edge of the blocks of constant quality, voxels. Smoothing would flatten independent voxels.
    const BLOCK: usize = 8;
    let blocks = RESOLUTION / BLOCK;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut draw = |count: usize| (0..count).map(|_| rng.random()).collect::<Vec<f32>>();
    let (coarse, values) = (draw(blocks.pow(3)), draw(RESOLUTION.pow(3)));
    let width: Vec<f32> = draw(RESOLUTION.pow(3)).iter().map(|width| 10.0 * width).collect();
    let block =
        |i: usize| [i / (RESOLUTION * RESOLUTION), i / RESOLUTION % RESOLUTION, i % RESOLUTION].map(|c| c / BLOCK);
    let quality: Vec<f32> =
        (0..RESOLUTION.pow(3)).map(block).map(|[x, y, z]| coarse[(x * blocks + y) * blocks + z]).collect();
    let rotation = [[0.5; RESOLUTION.pow(3)]; 4].concat();
    let maps = Maps { quality: &quality, rotation: &rotation, width: &width };
    let voxel_size = WORKSPACE_SIZE / RESOLUTION as f64;
    let volume = Volume::new(RESOLUTION, voxel_size, Isometry3::identity(), values).expect("values in [0, 1]");
    let found = [true, false].map(|forced| {
        let decoded = decode(&volume, &maps, &params(EPSILON, forced)).expect("maps of the volume's size");
        decoded.grasps
    });
    digest(&format!("{:?}", found.iter().flatten().map(numbers).collect::<Vec<_>>()))
}

fn numbers(grasp: &Grasp) -> Vec<f64> {
    let Grasp { pose, width, quality } = grasp;
    let (position, rotation) = (pose.translation.vector, pose.rotation.coords);
    [position.as_slice(), rotation.as_slice(), &[*width, f64::from(*quality)]].concat()
}

pub(super) fn digest(text: &str) -> String {
    Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// SHA-256 of a file.
pub(super) fn hash(path: &Path) -> anyhow::Result<String> {
    let bytes = fs::read(path).with_context(|| path.display().to_string())?;
    Ok(Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Hash of a folder's files with one of these extensions, with their names.
pub(super) fn hash_folder(folder: &Path, extensions: &[&str]) -> anyhow::Result<String> {
    let files: io::Result<Vec<PathBuf>> =
        fs::read_dir(folder).and_then(|files| files.map(|file| Ok(file?.path())).collect());
    let mut files = files.with_context(|| folder.display().to_string())?;
    files.retain(|path| extensions.iter().any(|extension| path.extension().is_some_and(|own| own == *extension)));
    files.sort();
    let hashes = files.iter().map(|path| Ok(format!("{:?} {}", path.file_name(), hash(path)?)));
    Ok(digest(&hashes.collect::<anyhow::Result<Vec<_>>>()?.join("\n")))
}
