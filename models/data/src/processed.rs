//! The processed format of VGN and GIGA:
//!
//! - `setup.json`: [`Setup`]; VGN's own data sets have none;
//! - `grasps.csv`: `scene_id,qx,qy,qz,qw,i,j,k,width,label,share,clearance`, one row per trial; i, j, k = position /
//!   voxel size, width in voxels, clearance in metres; VGN and GIGA have no `share` and no `clearance`, see [`Trial`];
//! - `scenes/ID.npz`: `grid`, `[1, N, N, N]` f32, the observed volume.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use npyz::WriterBuilder;
use npyz::npz::{NpzArchive, NpzWriter};
use rayon::prelude::*;

use crate::error::{At, DataError};
use crate::grasp_table::{self, LengthUnit, TableWriter};
use crate::{Scene, Setup, Trial, edge_of, finish, quantise, without_time};

const EXPECTED: &str = "`grid`, f32 [1, N, N, N] with values in [0, 1]";

/// Writes scenes in the order of their numbers.
pub struct Writer {
    scenes: PathBuf,
    table: TableWriter,
    next: Option<u64>,
}

impl Writer {
    /// Opens a folder, which is new or was written by an earlier run of the same `setup`. The last scene of that run is
    /// written again.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn open(folder: &Path, setup: &Setup) -> Result<Self, DataError> {
        setup.write_or_compare(folder)?;
        let scenes = folder.join("scenes");
        fs::create_dir_all(&scenes).at(&scenes)?;
        let (table, next) = TableWriter::open(folder, LengthUnit::Voxels)?;
        Ok(Self { scenes, table, next })
    }

    /// The number of the next scene, if the folder has scenes already.
    #[must_use]
    pub fn next(&self) -> Option<u64> {
        self.next
    }

    /// Appends a scene: its volume, `[N, N, N]` in [0, 1], then its trials in voxels. In this order the table never
    /// names a missing scene.
    ///
    /// # Errors
    /// [`DataError`] names the file. Earlier scenes are not lost.
    pub fn append(&mut self, id: &str, volume: &[f32], trials: &[Trial]) -> Result<(), DataError> {
        let path = self.scenes.join(format!("{id}.npz"));
        let partial = path.with_extension("npz.partial");
        write_volume(&partial, volume).at(&partial)?;
        fs::rename(&partial, &path).at(&path)?;
        self.table.append(id, trials)
    }
}

/// Reads every scene of a folder.
///
/// # Errors
/// [`DataError`] names the invalid file and its line.
pub fn read(folder: &Path) -> Result<Vec<Scene>, DataError> {
    let trials = grasp_table::read(folder, LengthUnit::Voxels)?.into_iter().collect::<Vec<_>>();
    trials
        .into_par_iter()
        .map(|(id, trials)| {
            let values = read_volume(&folder.join("scenes").join(format!("{id}.npz")))?;
            Ok(Scene { id, volumes: vec![quantise(&values)], trials, occupancy: None })
        })
        .collect()
}

fn write_volume(path: &Path, values: &[f32]) -> io::Result<()> {
    let edge = edge_of(values.len())
        .ok_or_else(|| io::Error::other(format!("{} values are not a cube", values.len())))? as u64;
    let mut archive = NpzWriter::create(path)?;
    let array = archive.array("grid", without_time())?;
    let mut grid = array.default_dtype().shape(&[1, edge, edge, edge]).begin_nd()?;
    grid.extend(values.iter().copied())?;
    grid.finish()?;
    finish(archive)
}

fn read_volume(path: &Path) -> Result<Vec<f32>, DataError> {
    let wrong = |reason| DataError::Scene { path: path.to_owned(), reason, expected: EXPECTED };
    let mut archive = NpzArchive::open(path).at(path)?;
    let grid = archive.by_name("grid").at(path)?.ok_or_else(|| wrong("the array `grid` is missing".to_owned()))?;
    let shape = grid.shape().to_vec();
    match shape[..] {
        [1, x, y, z] if x == y && y == z && x > 0 && grid.order() == npyz::Order::C => {}
        _ => return Err(wrong(format!("`grid` has shape {shape:?}"))),
    }
    let values = grid.into_vec::<f32>().at(path)?;
    if let Some(value) = values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
        return Err(wrong(format!("a value of `grid` is {value}")));
    }
    Ok(values)
}
