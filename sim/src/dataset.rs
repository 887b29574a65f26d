//! Labelled scenes on disk, in the processed format of VGN and GIGA:
//!
//! - `setup.json`: the recipe;
//! - `grasps.csv`: `scene_id,qx,qy,qz,qw,i,j,k,width,label`, a row a trial; i, j, k = position / voxel size, width in
//!   voxels;
//! - `scenes/ID.npz`: `grid`, `[1, 40, 40, 40]` f32, the observed volume.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use grasp::{RESOLUTION, WORKSPACE_SIZE};
use npyz::WriterBuilder;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::label::LabelledScene;

const HEADER: &str = "scene_id,qx,qy,qz,qw,i,j,k,width,label\n";

/// What `setup.json` says: everything it takes to make the same data again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Setup {
    /// `pile` or `packed`.
    pub scene: String,
    /// `train` or `test`, our own objects, or the folder they came from.
    pub objects: String,
    /// Grasp points a scene.
    pub points: usize,
    /// Where the scenes were looked at from.
    pub views: String,
    /// Whether the depth images carried the benchmark's noise.
    pub noise: bool,
    /// Seed of the data set; scene numbers select its streams.
    pub seed: u64,
}

/// Why a data set could not be written.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// The file system said no.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The folder holds data of another recipe.
    #[error("{path} was written with other settings ({found}); use another folder, or the same settings")]
    OtherSetup {
        /// The setup file.
        path: PathBuf,
        /// What it holds.
        found: String,
    },
}

trait At<T> {
    fn at(self, path: &Path) -> Result<T, DatasetError>;
}

impl<T, E: Into<io::Error>> At<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, DatasetError> {
        self.map_err(|source| DatasetError::Io { path: path.to_owned(), source: source.into() })
    }
}

/// Writes scenes in the order of their numbers, so that a run that was cut off goes on where it stopped.
pub struct DatasetWriter {
    dir: PathBuf,
    grasps: File,
    next: u64,
}

impl DatasetWriter {
    /// Opens `dir`, new or left by an earlier run of the same `setup`, whose unfinished last scene is made again.
    ///
    /// # Errors
    /// [`DatasetError`] names the file.
    pub fn open(dir: &Path, setup: &Setup) -> Result<Self, DatasetError> {
        let scenes = dir.join("scenes");
        fs::create_dir_all(&scenes).at(&scenes)?;
        check_setup(&dir.join("setup.json"), setup)?;

        let path = dir.join("grasps.csv");
        let mut grasps =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).at(&path)?;
        let (kept, next) = last_scene(&grasps).at(&path)?;
        grasps.set_len(kept).at(&path)?;
        grasps.seek(SeekFrom::End(0)).at(&path)?;
        if kept == 0 {
            grasps.write_all(HEADER.as_bytes()).at(&path)?;
        }
        Ok(Self { dir: dir.to_owned(), grasps, next })
    }

    /// Number of the first scene that is not there yet.
    #[must_use]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Appends a scene: its volume first, then its trials in one write, so that what the table names is there.
    ///
    /// # Errors
    /// [`DatasetError`] names the file; nothing written before is lost.
    pub fn append(&mut self, number: u64, scene: &LabelledScene) -> Result<(), DatasetError> {
        let id = format!("{number:08}");
        let path = self.dir.join("scenes").join(format!("{id}.npz"));
        let partial = path.with_extension("npz.partial");
        write_volume(&partial, &scene.volume).at(&partial)?;
        fs::rename(&partial, &path).at(&path)?;

        let voxel_size = WORKSPACE_SIZE / RESOLUTION as f64;
        let mut rows = String::new();
        for trial in &scene.trials {
            let q = trial.grasp.pose.rotation.coords;
            let p = trial.grasp.pose.translation.vector / voxel_size;
            let width = trial.grasp.width / voxel_size;
            let label = u8::from(trial.success);
            rows += &format!(
                "{id},{:.7},{:.7},{:.7},{:.7},{:.5},{:.5},{:.5},{width:.5},{label}\n",
                q.x, q.y, q.z, q.w, p.x, p.y, p.z
            );
        }
        let table = self.dir.join("grasps.csv");
        self.grasps.write_all(rows.as_bytes()).at(&table)?;
        self.next = number + 1;
        Ok(())
    }

    /// Passes over a scene in which nothing can be seen.
    pub fn skip(&mut self, number: u64) {
        self.next = number + 1;
    }
}

fn check_setup(path: &Path, setup: &Setup) -> Result<(), DatasetError> {
    match fs::read_to_string(path) {
        Ok(found) => match serde_json::from_str::<Setup>(&found) {
            Ok(same) if same == *setup => Ok(()),
            _ => Err(DatasetError::OtherSetup { path: path.to_owned(), found: found.trim().to_owned() }),
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let text = serde_json::to_string_pretty(setup).map_err(io::Error::from).at(path)?;
            fs::write(path, text + "\n").at(path)
        }
        Err(source) => Err(DatasetError::Io { path: path.to_owned(), source }),
    }
}

/// Length of the table without the rows of its last scene, which may be unfinished, and that scene's number.
fn last_scene(table: &File) -> io::Result<(u64, u64)> {
    let mut reader = BufReader::new(table);
    let mut line = String::new();
    let (mut offset, mut start, mut last) = (0, 0, None);
    while reader.read_line(&mut line)? > 0 {
        // A row without its end may be cut anywhere, even in its scene's number: it goes with the scene before it.
        if line.ends_with('\n')
            && let Some(number) = line.split(',').next().and_then(|id| id.parse::<u64>().ok())
            && last != Some(number)
        {
            last = Some(number);
            start = offset;
        }
        offset += line.len() as u64;
        line.clear();
    }
    Ok(last.map_or((0, 0), |number| (start, number)))
}

fn write_volume(path: &Path, values: &[f32]) -> io::Result<()> {
    let mut archive = npyz::npz::NpzWriter::create(path)?;
    let n = RESOLUTION as u64;
    let mut grid = archive
        .array("grid", npyz::zip::write::FileOptions::default())?
        .default_dtype()
        .shape(&[1, n, n, n])
        .begin_nd()?;
    grid.extend(values.iter().copied())?;
    grid.finish()
}

#[cfg(test)]
mod tests {
    use grasp::Grasp;
    use nalgebra::Isometry3;

    use super::*;
    use crate::label::Trial;

    fn setup() -> Setup {
        Setup { scene: "pile".into(), objects: "train".into(), points: 2, views: "side".into(), noise: false, seed: 1 }
    }

    fn scene() -> LabelledScene {
        let grasp = Grasp { pose: Isometry3::translation(0.075, 0.15, 0.0375), width: 0.06, quality: 1.0 };
        LabelledScene { volume: vec![0.5; RESOLUTION.pow(3)], trials: vec![Trial { grasp, success: true }; 2] }
    }

    #[test]
    fn an_interrupted_run_goes_on_without_a_lost_or_doubled_scene() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer = DatasetWriter::open(dir.path(), &setup()).unwrap();
        for number in [0, 1, 3] {
            writer.append(number, &scene()).unwrap();
        }
        let whole = fs::read_to_string(dir.path().join("grasps.csv")).unwrap();
        assert!(
            whole.contains("\n00000001,0.0000000,0.0000000,0.0000000,1.0000000,10.00000,20.00000,5.00000,8.00000,1\n")
        );

        // Cut off anywhere: in a row, between two, or in a scene's number.
        for length in HEADER.len()..whole.len() {
            fs::write(dir.path().join("grasps.csv"), &whole[..length]).unwrap();
            let mut writer = DatasetWriter::open(dir.path(), &setup()).unwrap();
            let next = writer.next();
            for number in [0, 1, 3].into_iter().filter(|&number| number >= next) {
                writer.append(number, &scene()).unwrap();
            }
            assert_eq!(fs::read_to_string(dir.path().join("grasps.csv")).unwrap(), whole, "cut after {length} bytes");
        }
    }

    #[test]
    fn another_recipe_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        DatasetWriter::open(dir.path(), &setup()).unwrap();
        let other = Setup { seed: 2, ..setup() };
        assert!(matches!(DatasetWriter::open(dir.path(), &other), Err(DatasetError::OtherSetup { .. })));
    }
}
