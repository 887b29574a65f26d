//! What networks learn from: scenes that were looked at, with the grasps that were tried in them, on disk.
//!
//! Three forms, told apart by what a folder holds:
//!
//! - **raw** ([`raw`]): VGN's and GIGA's depth images and grasps in metres;
//! - **processed** ([`processed`]): VGN's and GIGA's volumes and grasps in voxels, a file a scene;
//! - **packed** ([`packed`]): the same in few large files that are mapped into memory and may still be growing.
//!
//! A [`Dataset`] reads the last two for training. [`Candidates`] are what the classifier of GPD learns from.

mod candidates;
mod dataset;
mod error;
pub mod packed;
pub mod processed;
pub mod raw;
mod setup;
mod table;
mod trial;

pub use candidates::Candidates;
pub use dataset::{Dataset, Form};
pub use error::DataError;
pub use setup::{Provenance, Setup};
pub use trial::{MAX_CLEARANCE, TURNS, Trial};

/// A scene as a network sees it, with what came of trying it.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Its name, unique in its folder.
    pub id: String,
    /// Each is the whole scene observed anew, with other views or other noise: `[N, N, N]`, z fastest, quantised by
    /// [`quantise`].
    pub volumes: Vec<Vec<u8>>,
    /// The grasps.
    pub trials: Vec<Trial>,
}

/// A volume's values in [0, 1] as bytes.
///
/// The error is at most 1/510, for 40³ voxels over 0.3 m a distance of 0.12 mm, where a depth camera's noise is
/// millimetres. What was not observed, 0, stays exactly 0.
#[must_use]
pub fn quantise(values: &[f32]) -> Vec<u8> {
    // The cast rounds towards zero, and takes what lies outside of [0, 255] to its ends.
    values.iter().map(|value| (value * 255.0 + 0.5) as u8).collect()
}

/// The value that a byte stands for.
#[must_use]
pub fn value(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

/// The edge of a cube of so many voxels, if it is one.
fn edge_of(voxels: usize) -> Option<usize> {
    let edge = (voxels as f64).cbrt().round() as usize;
    (edge > 0 && edge.pow(3) == voxels).then_some(edge)
}

/// Options of an archive's entry that leave the time of day out: the same data are the same bytes.
fn without_time() -> npyz::zip::write::FileOptions {
    npyz::zip::write::FileOptions::default().last_modified_time(npyz::zip::DateTime::default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantisation_errs_by_half_a_step_and_keeps_zero() {
        let values: Vec<f32> = (0..=1000).map(|i| i as f32 / 1000.0).collect();
        for (before, byte) in values.iter().zip(quantise(&values)) {
            assert!((before - value(byte)).abs() <= 1.0 / 510.0 + 1e-6, "{before}");
        }
        assert_eq!(quantise(&[0.0, 1.0]), [0, 255]);
        assert_eq!((value(0), value(255)), (0.0, 1.0));
    }

    #[test]
    fn a_cube_has_an_edge() {
        assert_eq!(edge_of(64_000), Some(40));
        assert_eq!((edge_of(63_999), edge_of(0)), (None, None));
    }
}
