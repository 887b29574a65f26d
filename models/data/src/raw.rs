//! The raw format of VGN and GIGA:
//!
//! - `setup.json`: [`Setup`], with the camera's intrinsics;
//! - `grasps.csv`: `scene_id,qx,qy,qz,qw,x,y,z,width,label,share,clearance`, one row per trial, lengths in metres;
//!   VGN and GIGA have no `share` and no `clearance`, see [`Trial`];
//! - `scenes/ID.npz`: `depth_imgs` `[n, height, width]` f32, metres, 0 without a measurement, and `extrinsics`
//!   `[n, 7]`, `T_camera_task` as qx, qy, qz, qw, tx, ty, tz.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use npyz::WriterBuilder;
use npyz::npz::{NpzArchive, NpzWriter};

use crate::error::{At, DataError};
use crate::grasp_table::{self, LengthUnit, TableWriter};
use crate::{Setup, Trial, finish, without_time};

const EXPECTED: &str = "`depth_imgs`, f32 [n, height, width], and `extrinsics`, [n, 7]";

/// A depth image with its camera pose.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Metres along the optical axis, row by row; 0 where there is no measurement.
    pub depth: Vec<f32>,
    /// `T_camera_task`.
    pub camera_from_task: Isometry3<f64>,
}

/// Writes scenes in the order of their numbers.
pub struct Writer {
    scenes: PathBuf,
    table: TableWriter,
    next: Option<u64>,
    image: [usize; 2],
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
        let (table, next) = TableWriter::open(folder, LengthUnit::Metres)?;
        Ok(Self { scenes, table, next, image: [setup.intrinsic.height, setup.intrinsic.width] })
    }

    /// The number of the next scene, if the folder has scenes already.
    #[must_use]
    pub fn next(&self) -> Option<u64> {
        self.next
    }

    /// Appends a scene: its views, then its trials in metres. In this order the table never names a missing scene.
    ///
    /// # Errors
    /// [`DataError`] names the file. Earlier scenes are not lost.
    pub fn append(&mut self, id: &str, views: &[View], trials: &[Trial]) -> Result<(), DataError> {
        let path = self.scenes.join(format!("{id}.npz"));
        let partial = path.with_extension("npz.partial");
        write_views(&partial, views, self.image).at(&partial)?;
        fs::rename(&partial, &path).at(&path)?;
        self.table.append(id, trials)
    }
}

/// A reader of a folder. The table is in memory; views are read scene by scene, because all of them may be larger than
/// the memory.
pub struct Reader {
    folder: PathBuf,
    setup: Setup,
    trials: BTreeMap<String, Vec<Trial>>,
}

impl Reader {
    /// Opens a folder.
    ///
    /// # Errors
    /// [`DataError`] names the invalid file and its line.
    pub fn open(folder: &Path) -> Result<Self, DataError> {
        let setup = Setup::read(folder)?;
        Ok(Self { folder: folder.to_owned(), setup, trials: grasp_table::read(folder, LengthUnit::Metres)? })
    }

    /// The setup of the folder.
    #[must_use]
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// Each scene's name and its trials, in metres.
    pub fn trials(&self) -> impl Iterator<Item = (&str, &[Trial])> {
        self.trials.iter().map(|(id, trials)| (id.as_str(), trials.as_slice()))
    }

    /// Reads a scene's views.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn views(&self, id: &str) -> Result<Vec<View>, DataError> {
        let path = self.folder.join("scenes").join(format!("{id}.npz"));
        let wrong = |reason| DataError::Scene { path: path.clone(), reason, expected: EXPECTED };
        let [height, width] = [self.setup.intrinsic.height, self.setup.intrinsic.width];
        let mut archive = NpzArchive::open(&path).at(&path)?;
        let mut array = |name: &str| {
            let found = archive.by_name(name).at(&path)?;
            let array = found.ok_or_else(|| wrong(format!("the array `{name}` is missing")))?;
            let shape = array.shape().to_vec();
            if array.order() != npyz::Order::C {
                return Err(wrong(format!("`{name}` is stored in Fortran order")));
            }
            // VGN stores both arrays as f32; some tools write f64.
            let values = match array.dtype().descr().trim_matches('\'') {
                "<f8" => array.into_vec::<f64>().at(&path)?.into_iter().map(|value| value as f32).collect(),
                _ => array.into_vec::<f32>().at(&path)?,
            };
            Ok((shape, values))
        };
        let (shape, depth) = array("depth_imgs")?;
        let (poses, extrinsics) = array("extrinsics")?;
        let views = extrinsics.len() / 7;
        if poses != [views as u64, 7] || views == 0 {
            return Err(wrong(format!("`extrinsics` has shape {poses:?}")));
        }
        if shape != [views as u64, height as u64, width as u64] {
            return Err(wrong(format!(
                "`depth_imgs` has shape {shape:?}, but there are {views} poses of a {width}×{height} camera"
            )));
        }
        let images = depth.chunks_exact(height * width).map(<[f32]>::to_vec);
        images
            .zip(extrinsics.chunks_exact(7))
            .map(|(depth, pose)| {
                let [qx, qy, qz, qw, tx, ty, tz] = std::array::from_fn(|i| f64::from(pose[i]));
                let rotation = Quaternion::new(qw, qx, qy, qz);
                if !(0.999..1.001).contains(&rotation.norm()) {
                    return Err(wrong(format!("a quaternion of `extrinsics` has length {}", rotation.norm())));
                }
                let rotation = UnitQuaternion::from_quaternion(rotation);
                Ok(View { depth, camera_from_task: Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation) })
            })
            .collect()
    }
}

fn write_views(path: &Path, views: &[View], [height, width]: [usize; 2]) -> io::Result<()> {
    let mut archive = NpzWriter::create(path)?;
    // Compressed, like numpy.savez_compressed: a depth image shrinks to a tenth.
    let options = || without_time().compression_method(npyz::zip::CompressionMethod::Deflated);
    let count = views.len() as u64;
    let array = archive.array("depth_imgs", options())?;
    let mut images = array.default_dtype().shape(&[count, height as u64, width as u64]).begin_nd()?;
    for view in views {
        images.extend(view.depth.iter().copied())?;
    }
    images.finish()?;
    let mut extrinsics = archive.array("extrinsics", options())?.default_dtype().shape(&[count, 7]).begin_nd()?;
    for view in views {
        let (q, t) = (view.camera_from_task.rotation.coords, view.camera_from_task.translation.vector);
        extrinsics.extend([q.x, q.y, q.z, q.w, t.x, t.y, t.z].map(|number| number as f32))?;
    }
    extrinsics.finish()?;
    finish(archive)
}
