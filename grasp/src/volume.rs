use std::sync::Arc;

use nalgebra::Isometry3;
use thiserror::Error;

use crate::{Details, ObjectMap, Region, RequestError};

/// A validated truncated signed distance field over a cube: the input of a network.
///
/// Values are in [0, 1]: 0.5 on the surface, larger in front of it, smaller behind it, and exactly 0 where nothing was
/// observed or no surface is within the truncation distance. This is `(tsdf + 1) / 2`, the convention of VGN's released
/// code.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    resolution: usize,
    voxel_size: f64,
    pose: Isometry3<f64>,
    values: Vec<f32>,
    hidden: Option<Vec<bool>>,
    objects: Option<Arc<ObjectMap>>,
    /// The larger volume with the same voxels of which this one is the middle.
    surroundings: Option<Arc<Volume>>,
    details: Option<Arc<Details>>,
}

/// Why an array is not a valid [`Volume`].
#[derive(Clone, Debug, Error, PartialEq)]
pub enum VolumeError {
    /// The resolution is out of range.
    #[error("resolution is {0}, must be from 1 to {max}", max = Volume::MAX_RESOLUTION)]
    Resolution(usize),
    /// The voxel size is not positive or not finite.
    #[error("voxel_size is {0}, must be a positive number of metres")]
    VoxelSize(f64),
    /// The number of values does not fit the resolution.
    #[error("data has {got} values, a resolution of {resolution} needs {resolution}³ = {expected}")]
    Length {
        /// Number of values received.
        got: usize,
        /// Number of values required.
        expected: usize,
        /// Voxels along an edge.
        resolution: usize,
    },
    /// A value is NaN or infinite.
    #[error("data[{index}] is {value}, every value must be finite")]
    NotFinite {
        /// Flat index, z fastest.
        index: usize,
        /// The invalid value.
        value: f32,
    },
    /// A value is outside [0, 1].
    #[error("data[{index}] is {value}, every value must lie in [0, 1] (0.5 = surface, 0 = unobserved)")]
    OutOfRange {
        /// Flat index, z fastest.
        index: usize,
        /// The invalid value.
        value: f32,
    },
    /// All values are 0: no surface was observed.
    #[error("data is all zero: nothing was observed; check the camera's extrinsics and the workspace pose")]
    Empty,
}

impl VolumeError {
    /// The name of the invalid field in requests.
    #[must_use]
    pub fn field(&self) -> &'static str {
        match self {
            Self::Resolution(_) => "resolution",
            Self::VoxelSize(_) => "voxel_size",
            Self::Length { .. } | Self::NotFinite { .. } | Self::OutOfRange { .. } | Self::Empty => "data",
        }
    }
}

impl From<VolumeError> for RequestError {
    fn from(error: VolumeError) -> Self {
        Self::of_field(format!("volume.{}", error.field()), &format!("volume.{error}"))
    }
}

impl Volume {
    /// Largest supported resolution: 256³ f32 values take 64 MiB.
    pub const MAX_RESOLUTION: usize = 256;

    /// Validates an array of `resolution`³ values indexed `[x][y][z]`, z fastest.
    ///
    /// `voxel_size` is in metres; `pose` (`T_frame_volume`) places the volume's corner in the caller's frame.
    ///
    /// # Errors
    /// [`VolumeError`] names the first invalid field, with its value.
    pub fn new(
        resolution: usize,
        voxel_size: f64,
        pose: Isometry3<f64>,
        values: Vec<f32>,
    ) -> Result<Self, VolumeError> {
        if resolution == 0 || resolution > Self::MAX_RESOLUTION {
            return Err(VolumeError::Resolution(resolution));
        }
        if !(voxel_size.is_finite() && voxel_size > 0.0) {
            return Err(VolumeError::VoxelSize(voxel_size));
        }
        let expected = resolution.pow(3);
        if values.len() != expected {
            return Err(VolumeError::Length { got: values.len(), expected, resolution });
        }
        if !values.iter().fold(true, |ok, v| ok & (0.0..=1.0).contains(v)) {
            return Err(first_bad_value(&values));
        }
        if values.iter().fold(true, |zero, &v| zero & (v == 0.0)) {
            return Err(VolumeError::Empty);
        }
        Ok(Self {
            resolution,
            voxel_size,
            pose,
            values,
            hidden: None,
            objects: None,
            surroundings: None,
            details: None,
        })
    }

    /// The volume with its hidden voxels: those that lie behind a surface in a view and were not measured by any view.
    pub(crate) fn with_hidden(self, hidden: Vec<bool>) -> Self {
        Self { hidden: Some(hidden), ..self }
    }

    /// The volume with its details.
    pub(crate) fn with_details(self, details: Details) -> Self {
        Self { details: Some(Arc::new(details)), ..self }
    }

    /// What the views showed in and around the volume, in voxels of half the size. `None` if only the volume is known.
    #[must_use]
    pub fn details(&self) -> Option<&Details> {
        self.observed().details.as_deref()
    }

    /// The volume with the objects in it.
    #[must_use]
    pub fn with_objects(self, objects: Option<Arc<ObjectMap>>) -> Self {
        Self { objects, ..self }
    }

    /// The middle of the volume, without `padding` voxels on each side. The collision check and the patches of an
    /// evaluator read what was observed around it, too. `None` if nothing was observed in it.
    #[must_use]
    pub fn middle(self, padding: usize) -> Option<Self> {
        let resolution = self.resolution.checked_sub(2 * padding)?;
        let offset = padding as f64 * self.voxel_size;
        let pose = self.pose * Isometry3::translation(offset, offset, offset);
        let values = middle(&self.values, self.resolution, padding);
        let hidden = self.hidden.as_ref().map(|hidden| middle(hidden, self.resolution, padding));
        let inner = Self::new(resolution, self.voxel_size, pose, values).ok()?;
        Some(Self { hidden, surroundings: Some(Arc::new(self)), ..inner })
    }

    /// The volume without what was observed around it, and without objects.
    #[must_use]
    pub fn alone(self) -> Self {
        Self { objects: None, surroundings: None, ..self }
    }

    /// All that was observed: the volume itself, or the larger one of which it is the middle.
    #[must_use]
    pub(crate) fn observed(&self) -> &Self {
        self.surroundings.as_deref().unwrap_or(self)
    }

    /// Voxels along an edge.
    #[must_use]
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// Edge of a voxel, metres.
    #[must_use]
    pub fn voxel_size(&self) -> f64 {
        self.voxel_size
    }

    /// `T_frame_volume`: pose of the volume's corner in the caller's frame.
    #[must_use]
    pub fn pose(&self) -> &Isometry3<f64> {
        &self.pose
    }

    /// The values, indexed `[x][y][z]`, z fastest.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// For each voxel, whether it lies behind a surface in a view and was not measured by any view. `None` if the volume
    /// was not fused from views.
    #[must_use]
    pub fn hidden(&self) -> Option<&[bool]> {
        self.hidden.as_deref()
    }

    /// The region whose points are at least `margin` from the vertical sides, metres.
    #[must_use]
    pub fn within(&self, margin: f64) -> Region {
        let size = self.resolution as f64 * self.voxel_size;
        Region { frame: self.pose, lower: [margin, margin, 0.0], upper: [size - margin, size - margin, size] }
    }

    /// Whether surfaces were observed higher than `height`, metres above the bottom.
    #[must_use]
    pub fn has_surface_above(&self, height: f64) -> bool {
        /// Fewer voxels behind a surface are noise.
        const FEWEST: usize = 4;
        let first = (height / self.voxel_size + 0.5).max(0.0) as usize;
        let columns = self.values.chunks_exact(self.resolution);
        let behind = columns.flat_map(|column| column.iter().skip(first)).filter(|value| (1e-6..0.5).contains(*value));
        behind.take(FEWEST).count() == FEWEST
    }

    /// The objects in the volume, if they are known.
    #[must_use]
    pub fn objects(&self) -> Option<&ObjectMap> {
        self.objects.as_deref()
    }
}

/// The values of a cube of `resolution`³ without `padding` on each side.
pub(crate) fn middle<T: Copy>(values: &[T], resolution: usize, padding: usize) -> Vec<T> {
    let inner = padding..resolution - padding;
    let columns = inner.clone().flat_map(|x| inner.clone().map(move |y| (x * resolution + y) * resolution));
    columns.flat_map(|column| &values[column + inner.start..column + inner.end]).copied().collect()
}

/// Finds the index of the error. Slower than the check, so it runs only after the check has failed.
fn first_bad_value(values: &[f32]) -> VolumeError {
    for (index, &value) in values.iter().enumerate() {
        if !value.is_finite() {
            return VolumeError::NotFinite { index, value };
        }
        if !(0.0..=1.0).contains(&value) {
            return VolumeError::OutOfRange { index, value };
        }
    }
    VolumeError::Empty
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(resolution: usize, voxel_size: f64, values: Vec<f32>) -> Result<Volume, VolumeError> {
        Volume::new(resolution, voxel_size, Isometry3::identity(), values)
    }

    #[test]
    fn each_error_names_the_field_and_its_value() {
        assert_eq!(volume(0, 0.1, vec![]), Err(VolumeError::Resolution(0)));
        assert_eq!(volume(257, 0.1, vec![]), Err(VolumeError::Resolution(257)));
        assert_eq!(volume(2, -0.1, vec![0.5; 8]), Err(VolumeError::VoxelSize(-0.1)));
        assert_eq!(volume(2, 0.1, vec![0.5; 7]), Err(VolumeError::Length { got: 7, expected: 8, resolution: 2 }));
        assert_eq!(volume(1, 0.1, vec![1.5]), Err(VolumeError::OutOfRange { index: 0, value: 1.5 }));
        assert_eq!(volume(1, 0.1, vec![-0.5]), Err(VolumeError::OutOfRange { index: 0, value: -0.5 }));
        assert!(matches!(volume(1, 0.1, vec![f32::NAN]), Err(VolumeError::NotFinite { index: 0, .. })));
        assert_eq!(volume(2, 0.1, vec![0.0; 8]), Err(VolumeError::Empty));
        assert!(volume(2, 0.1, vec![0.5; 8]).is_ok());
    }
}
