use nalgebra::Isometry3;

use crate::VolumeError;

/// What views showed in and around a volume, in voxels of half the size: the input of a grasp evaluator.
///
/// Unlike a [`Volume`](crate::Volume), it tells free space from hidden space.
#[derive(Clone, Debug, PartialEq)]
pub struct Details {
    resolution: usize,
    voxel_size: f64,
    pose: Isometry3<f64>,
    bytes: Vec<u8>,
}

impl Details {
    /// The byte of free space: no surface within the truncation distance.
    pub const FREE: u8 = 255;

    /// Details from `resolution`³ bytes, indexed `[x][y][z]`, z fastest: 255 × (tsdf + 1) / 2 near a surface, else
    /// [`FREE`](Self::FREE), or 0 where nothing was measured or a surface is in front. `voxel_size` is in metres; `pose`
    /// places the corner.
    ///
    /// # Errors
    /// [`VolumeError::Length`] if the number of bytes does not fit.
    pub fn new(resolution: usize, voxel_size: f64, pose: Isometry3<f64>, bytes: Vec<u8>) -> Result<Self, VolumeError> {
        let expected = resolution.pow(3);
        if bytes.len() != expected {
            return Err(VolumeError::Length { got: bytes.len(), expected, resolution });
        }
        Ok(Self { resolution, voxel_size, pose, bytes })
    }

    /// The byte of a measured voxel near a surface; `distance` is a fraction of the truncation distance.
    pub(crate) fn near(distance: f32) -> u8 {
        // Adding a half turns truncation into rounding.
        ((distance + 1.0) * 127.5 + 0.5) as u8
    }

    /// The distance that the byte of a voxel near a surface stands for, a fraction of the truncation distance.
    pub(crate) fn distance(byte: u8) -> f32 {
        f32::from(byte) / 127.5 - 1.0
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

    /// Pose of the corner.
    #[must_use]
    pub fn pose(&self) -> &Isometry3<f64> {
        &self.pose
    }

    /// The bytes, indexed `[x][y][z]`, z fastest.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}
