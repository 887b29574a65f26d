//! Training data on disk: observed scenes with the grasp trials in them.
//!
//! There are three formats, distinguished by the files of a folder:
//!
//! - **raw** ([`raw`]): VGN's and GIGA's depth images and grasps in metres;
//! - **processed** ([`processed`]): VGN's and GIGA's volumes and grasps in voxels, one file per scene;
//! - **packed** ([`packed`]): the same in a few large files, which are mapped into memory and may still grow.
//!
//! A [`Dataset`] reads the last two for training. [`Candidates`] are the training data of GPD's classifier.

use std::fs::File;
use std::io::{self, BufWriter};

use npyz::npz::NpzWriter;

mod candidates;
mod dataset;
mod error;
mod grasp_table;
mod occupancy;
pub mod packed;
pub mod processed;
pub mod raw;
mod setup;
mod trial;

pub use candidates::Candidates;
pub use dataset::{DataFormat, Dataset};
pub use error::DataError;
pub use occupancy::Occupancy;
pub use setup::{Provenance, Setup};
pub use trial::{DISTINCT_YAWS, MAX_CLEARANCE, Trial};

/// A scene with its observed volumes and its trials.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Name, unique in its folder.
    pub id: String,
    /// Volumes `[N, N, N]`, z fastest, quantised by [`quantise`]. Each is an observation of the whole scene with other
    /// views or other noise.
    pub volumes: Vec<Vec<u8>>,
    /// The grasp trials.
    pub trials: Vec<Trial>,
    /// The voxels inside the objects, if they are known. The formats of VGN and GIGA do not store them.
    pub occupancy: Option<Occupancy>,
}

/// The name of scene `number` in the formats of VGN and GIGA. It begins with a letter, because their code reads names of
/// digits as integers and then fails.
#[must_use]
pub fn scene_id(number: u64) -> String {
    format!("s{number:08}")
}

/// The number of a scene from its [name](scene_id); also without the letter, as in data of earlier versions.
#[must_use]
pub fn scene_number(id: &str) -> Option<u64> {
    id.strip_prefix('s').unwrap_or(id).parse().ok()
}

/// Quantises the values of a volume, in [0, 1], to bytes.
///
/// The error is at most 1/510, which is 0.12 mm for 40³ voxels over 0.3 m. The noise of depth cameras is in the order
/// of millimetres. Unobserved voxels stay exactly 0.
#[must_use]
pub fn quantise(values: &[f32]) -> Vec<u8> {
    // The cast truncates, and saturates at 0 and 255.
    values.iter().map(|value| (value * 255.0 + 0.5) as u8).collect()
}

/// The value of a quantised byte.
#[must_use]
pub fn value(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

/// The edge of a cube of `voxels` voxels, if there is one.
fn edge_of(voxels: usize) -> Option<usize> {
    let edge = (voxels as f64).cbrt().round() as usize;
    (edge > 0 && edge.pow(3) == voxels).then_some(edge)
}

/// Writes the end of an archive. Dropping the writer would ignore errors, such as a full disk.
fn finish(mut archive: NpzWriter<BufWriter<File>>) -> io::Result<()> {
    archive.zip_writer().finish()?.into_inner().map_err(io::IntoInnerError::into_error)?;
    Ok(())
}

/// Options of an archive entry without the time of day, so that the same data give the same bytes.
fn without_time() -> npyz::zip::write::FileOptions {
    npyz::zip::write::FileOptions::default().last_modified_time(npyz::zip::DateTime::default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantisation_error_is_half_a_step_and_zero_is_exact() {
        let values: Vec<f32> = (0..=1000).map(|i| i as f32 / 1000.0).collect();
        for (before, byte) in values.iter().zip(quantise(&values)) {
            assert!((before - value(byte)).abs() <= 1.0 / 510.0 + 1e-6, "{before}");
        }
        assert_eq!(quantise(&[0.0, 1.0]), [0, 255]);
        assert_eq!((value(0), value(255)), (0.0, 1.0));
    }

    #[test]
    fn edge_of_returns_the_edge_of_a_cube() {
        assert_eq!(edge_of(64_000), Some(40));
        assert_eq!((edge_of(63_999), edge_of(0)), (None, None));
    }
}
