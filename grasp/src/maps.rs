use std::ops::RangeInclusive;

use nalgebra::{Quaternion, UnitQuaternion};
use thiserror::Error;

/// Probabilities, with room for the rounding of low precisions.
pub(crate) const PROBABLE: RangeInclusive<f32> = -1e-3..=1.001;

/// A network's output over a volume of N³ voxels, each array indexed `[channel][x][y][z]`, z fastest.
#[derive(Clone, Copy, Debug)]
pub struct Maps<'a> {
    /// Probability that a grasp here succeeds, `[N, N, N]`, in [0, 1].
    pub quality: &'a [f32],
    /// Orientation of the grasp, `[4, N, N, N]`, unit quaternion x, y, z, w in the volume's axes.
    pub rotation: &'a [f32],
    /// Opening, `[N, N, N]`, in voxels.
    pub width: &'a [f32],
}

/// Where in its voxel a network's grasp stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum VoxelOrigin {
    /// At index · voxel size, the convention of VGN's data and weights.
    #[default]
    Corner,
    /// At (index + 0.5) · voxel size, where the TSDF is sampled: mirror images and turns of a volume stay exact.
    Center,
}

impl VoxelOrigin {
    /// The offset from a voxel's index to its grasp's position, in voxels.
    #[must_use]
    pub fn offset(self) -> f64 {
        match self {
            Self::Corner => 0.0,
            Self::Center => 0.5,
        }
    }

    /// As model files have it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Corner => "corner",
            Self::Center => "center",
        }
    }
}

impl Maps<'_> {
    /// Checks sizes and every value: a network whose maps pass over one volume is not broken as a whole.
    ///
    /// # Errors
    /// [`DecodeError`] names the first map that cannot be decoded.
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

    /// Checks the sizes, and the qualities: one NaN would spread through the smoothing and silently empty a region.
    pub(crate) fn check_quality(&self, resolution: usize) -> Result<(), DecodeError> {
        let voxels = resolution.pow(3);
        for (map, values, expected) in
            [("quality", self.quality, voxels), ("rotation", self.rotation, 4 * voxels), ("width", self.width, voxels)]
        {
            if values.len() != expected {
                return Err(DecodeError::Length { map, got: values.len(), expected });
            }
        }
        // Without looking for where it is, which takes longer.
        if self.quality.iter().fold(true, |all, quality| all & PROBABLE.contains(quality)) {
            return Ok(());
        }
        let wrong = self.quality.iter().position(|quality| !PROBABLE.contains(quality));
        wrong.map_or(Ok(()), |index| {
            let needed = "must be a probability; does the network end without its sigmoid?";
            Err(DecodeError::Value { map: "quality", index, value: self.quality[index], needed })
        })
    }

    /// The orientation at a voxel.
    pub(crate) fn rotation(&self, index: usize) -> Result<UnitQuaternion<f64>, DecodeError> {
        let voxels = self.rotation.len() / 4;
        let [x, y, z, w] = [0, 1, 2, 3].map(|channel| f64::from(self.rotation[channel * voxels + index]));
        let unit = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6);
        unit.filter(|unit| unit.coords.iter().all(|c| c.is_finite())).ok_or_else(|| {
            let needed = "must be the x of a unit quaternion, which has no length here";
            DecodeError::Value { map: "rotation", index, value: self.rotation[index], needed }
        })
    }
}

/// Why maps could not be decoded: the network is not what it should be.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum DecodeError {
    /// A map has the wrong size.
    #[error("the map `{map}` holds {got} values, {expected} needed")]
    Length {
        /// Which map.
        map: &'static str,
        /// Values that came.
        got: usize,
        /// Values needed.
        expected: usize,
    },
    /// A map holds what no grasp can have.
    #[error("the map `{map}` holds {value} at {index}, {needed}")]
    Value {
        /// Which map.
        map: &'static str,
        /// Flat index.
        index: usize,
        /// The value.
        value: f32,
        /// What it must be.
        needed: &'static str,
    },
}
