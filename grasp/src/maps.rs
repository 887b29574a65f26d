use std::ops::RangeInclusive;

use nalgebra::{Quaternion, UnitQuaternion};
use thiserror::Error;

/// Range of probabilities, with a tolerance for the rounding of low precisions.
const PROBABLE: RangeInclusive<f32> = -1e-3..=1.001;

/// Output of a network over a volume of N³ voxels. Each array is indexed `[channel][x][y][z]`, z fastest.
#[derive(Clone, Copy, Debug)]
pub struct Maps<'a> {
    /// Probability that a grasp at the voxel succeeds, `[N, N, N]`, in [0, 1].
    pub quality: &'a [f32],
    /// Orientation of the grasp, `[4, N, N, N]`: unit quaternion x, y, z, w in the volume's axes.
    pub rotation: &'a [f32],
    /// Opening, `[N, N, N]`, in voxels.
    pub width: &'a [f32],
}

/// Position of a network's grasp in its voxel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum VoxelOrigin {
    /// Index · voxel size: the convention of VGN's data and weights.
    #[default]
    Corner,
    /// (index + 0.5) · voxel size, where the TSDF is sampled. Mirroring and rotating a volume are exact with this one.
    Center,
}

impl VoxelOrigin {
    /// Offset from a voxel's index to its grasp's position, in voxels.
    #[must_use]
    pub fn offset(self) -> f64 {
        match self {
            Self::Corner => 0.0,
            Self::Center => 0.5,
        }
    }

    /// The name in model files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Corner => "corner",
            Self::Center => "center",
        }
    }
}

impl Maps<'_> {
    /// Checks the sizes and every value. Used when a model is loaded.
    ///
    /// # Errors
    /// [`DecodeError`] names the first invalid map.
    pub fn check(&self, resolution: usize) -> Result<(), DecodeError> {
        self.check_quality(resolution)?;
        (0..resolution.pow(3)).try_for_each(|index| self.rotation(index).map(drop))?;
        match self.width.iter().position(|width| !width.is_finite()) {
            Some(index) => {
                Err(DecodeError::Value { map: "width", index, value: self.width[index], needed: "must be finite" })
            }
            None => Ok(()),
        }
    }

    /// Checks the sizes and the qualities. One NaN would spread through the smoothing and silently empty a region.
    pub(crate) fn check_quality(&self, resolution: usize) -> Result<(), DecodeError> {
        let voxels = resolution.pow(3);
        for (map, values, expected) in
            [("quality", self.quality, voxels), ("rotation", self.rotation, 4 * voxels), ("width", self.width, voxels)]
        {
            if values.len() != expected {
                return Err(DecodeError::Length { map, got: values.len(), expected });
            }
        }
        // Fast path: finding the index takes longer.
        if self.quality.iter().fold(true, |all, quality| all & PROBABLE.contains(quality)) {
            return Ok(());
        }
        let wrong = self.quality.iter().position(|quality| !PROBABLE.contains(quality));
        wrong.map_or(Ok(()), |index| {
            let needed = "must be a probability; check that the network ends with a sigmoid";
            Err(DecodeError::Value { map: "quality", index, value: self.quality[index], needed })
        })
    }

    pub(crate) fn rotation(&self, index: usize) -> Result<UnitQuaternion<f64>, DecodeError> {
        let voxels = self.rotation.len() / 4;
        let [x, y, z, w] = [0, 1, 2, 3].map(|channel| f64::from(self.rotation[channel * voxels + index]));
        let unit = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6);
        unit.filter(|unit| unit.coords.iter().all(|c| c.is_finite())).ok_or_else(|| {
            let needed =
                "must be part of a unit quaternion, but the quaternion of this voxel has no finite length above 0";
            DecodeError::Value { map: "rotation", index, value: self.rotation[index], needed }
        })
    }
}

/// Why the maps cannot be decoded.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum DecodeError {
    /// A map has the wrong size.
    #[error("map `{map}` has {got} values, must have {expected}")]
    Length {
        /// Name of the map.
        map: &'static str,
        /// Number of values received.
        got: usize,
        /// Number of values required.
        expected: usize,
    },
    /// A map has an invalid value.
    #[error("map `{map}` is {value} at index {index}, {needed}")]
    Value {
        /// Name of the map.
        map: &'static str,
        /// Flat index.
        index: usize,
        /// The value.
        value: f32,
        /// Requirement on the value.
        needed: &'static str,
    },
}
