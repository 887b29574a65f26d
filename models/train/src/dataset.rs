use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use half::f16;
use nalgebra::{Point3, Quaternion, UnitQuaternion};
use npyz::npz::NpzArchive;
use rayon::prelude::*;
use serde::Deserialize;
use sha2::{Digest, Sha256};
use thiserror::Error;

/// A grasp that was tried, in the volume's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Label {
    /// Where, in voxels (position / voxel size, not rounded).
    pub position: Point3<f64>,
    /// Orientation of the grasp frame.
    pub rotation: UnitQuaternion<f64>,
    /// Opening, voxels; meaningful for successes only.
    pub width: f64,
    /// Whether it held.
    pub success: bool,
}

/// A volume and the grasps that were tried in it.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Its name, unique in its folder.
    pub id: String,
    /// `[N, N, N]`, z fastest. Half precision: its step, 0.0005, is far below the noise of a depth camera.
    pub grid: Vec<f16>,
    /// The grasps.
    pub labels: Vec<Label>,
}

/// Scenes of one resolution, all in memory.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// N: voxels along an edge.
    pub resolution: usize,
    /// By folder and name.
    pub scenes: Vec<Scene>,
}

/// What is wrong with a data set; always names the file.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// A file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the file system said.
        source: io::Error,
    },
    /// A line of `grasps.csv` cannot be understood.
    #[error(
        "{}, line {line}: {reason}; the columns must be scene_id,qx,qy,qz,qw,i,j,k,width,label, with i, j, k and width \
         in voxels",
        path.display()
    )]
    Row {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is wrong.
        reason: String,
    },
    /// A scene's volume cannot be used.
    #[error("{}: {reason}; it must hold `grid`, f32 [1, N, N, N] with values in [0, 1]", path.display())]
    Grid {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// There is nothing to learn from.
    #[error("{}: holds no grasps", .0.display())]
    Empty(PathBuf),
}

/// A line of `grasps.csv`.
#[derive(Deserialize)]
struct Row {
    scene_id: String,
    qx: f64,
    qy: f64,
    qz: f64,
    qw: f64,
    i: f64,
    j: f64,
    k: f64,
    width: f64,
    label: f64,
}

impl Dataset {
    /// Reads folders in the processed format of VGN and GIGA: `grasps.csv` and `scenes/ID.npz`.
    ///
    /// # Errors
    /// [`DatasetError`] names the file, and the line, that cannot be used.
    pub fn read(folders: &[PathBuf]) -> Result<Self, DatasetError> {
        let mut scenes = Vec::new();
        for folder in folders {
            let labels: Vec<_> = read_labels(&folder.join("grasps.csv"))?.into_iter().collect();
            if labels.is_empty() {
                return Err(DatasetError::Empty(folder.clone()));
            }
            let read = |(id, labels): (String, Vec<Label>)| -> Result<_, DatasetError> {
                let path = folder.join("scenes").join(format!("{id}.npz"));
                let grid = read_grid(&path)?;
                Ok((path, Scene { id, grid, labels }))
            };
            scenes.extend(labels.into_par_iter().map(read).collect::<Result<Vec<_>, _>>()?);
        }
        let voxels = scenes.first().map_or(0, |(_, scene)| scene.grid.len());
        if let Some((path, scene)) = scenes.iter().find(|(_, scene)| scene.grid.len() != voxels) {
            let reason = format!("it has {} voxels, the scenes before it {voxels}", scene.grid.len());
            return Err(DatasetError::Grid { path: path.clone(), reason });
        }
        let scenes = scenes.into_iter().map(|(_, scene)| scene).collect();
        Ok(Self { resolution: (voxels as f64).cbrt().round() as usize, scenes })
    }

    /// How many grasps there are, and how many of them succeeded.
    #[must_use]
    pub fn grasps(&self) -> (usize, usize) {
        let labels = || self.scenes.iter().flat_map(|scene| &scene.labels);
        (labels().count(), labels().filter(|label| label.success).count())
    }

    /// Sixteen hexadecimal digits that change when a scene's name or a grasp of it does, and with the order of the
    /// scenes. Their volumes, a thousand times as much, are left out: who makes them anew tries other grasps, too.
    pub(crate) fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        for scene in &self.scenes {
            // With their lengths, so that no two data sets are the same bytes.
            hash.update((scene.id.len() as u64).to_le_bytes());
            hash.update(&scene.id);
            hash.update((scene.labels.len() as u64).to_le_bytes());
            for Label { position, rotation, width, success } in &scene.labels {
                for number in position.coords.iter().chain(rotation.coords.iter()).chain([width]) {
                    hash.update(number.to_le_bytes());
                }
                hash.update([u8::from(*success)]);
            }
        }
        hash.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// Indices of the scenes to learn from and of those held out: about `fraction` of them, chosen by a hash of the
    /// scene's name, so that a scene stays on its side when others are added.
    #[must_use]
    pub fn split(&self, fraction: f64) -> (Vec<usize>, Vec<usize>) {
        (0..self.scenes.len()).partition(|&index| {
            let hash = Sha256::digest(&self.scenes[index].id);
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
    }
}

fn read_labels(path: &Path) -> Result<BTreeMap<String, Vec<Label>>, DatasetError> {
    let file = File::open(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    let mut reader = csv::Reader::from_reader(file);
    let mut labels: BTreeMap<String, Vec<Label>> = BTreeMap::new();
    // The header is line 1.
    for (line, row) in (2..).zip(reader.deserialize::<Row>()) {
        let row = row.map_err(|error| wrong(path, line, error.to_string()))?;
        let id = row.scene_id.clone();
        let label = row.check().map_err(|reason| wrong(path, line, reason))?;
        labels.entry(id).or_default().push(label);
    }
    Ok(labels)
}

fn wrong(path: &Path, line: u64, reason: String) -> DatasetError {
    DatasetError::Row { path: path.to_owned(), line, reason }
}

impl Row {
    fn check(self) -> Result<Label, String> {
        let Self { qx, qy, qz, qw, i, j, k, width, label, .. } = self;
        for (name, value) in [("i", i), ("j", j), ("k", k), ("width", width)] {
            if !value.is_finite() {
                return Err(format!("{name} is {value}"));
            }
        }
        let rotation = Quaternion::new(qw, qx, qy, qz);
        if !(0.999..1.001).contains(&rotation.norm()) {
            return Err(format!("the quaternion has length {}", rotation.norm()));
        }
        let success = match label {
            0.0 => false,
            1.0 => true,
            _ => return Err(format!("label is {label}, must be 0 or 1")),
        };
        Ok(Label {
            position: Point3::new(i, j, k),
            rotation: UnitQuaternion::from_quaternion(rotation),
            width,
            success,
        })
    }
}

fn read_grid(path: &Path) -> Result<Vec<f16>, DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let wrong = |reason: String| DatasetError::Grid { path: path.to_owned(), reason };
    let mut archive = NpzArchive::open(path).map_err(io)?;
    let grid = archive.by_name("grid").map_err(io)?.ok_or_else(|| wrong("it holds no `grid`".to_owned()))?;
    let shape = grid.shape().to_vec();
    match shape[..] {
        [1, x, y, z] if x == y && y == z && x > 0 && grid.order() == npyz::Order::C => {}
        _ => return Err(wrong(format!("`grid` has shape {shape:?}"))),
    }
    let values = grid.into_vec::<f32>().map_err(io)?;
    if let Some(value) = values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
        return Err(wrong(format!("`grid` holds {value}")));
    }
    Ok(values.into_iter().map(f16::from_f32).collect())
}
