//! Data augmentation: scenes are rotated, mirrored and shifted together with their grasps.
//!
//! The value of a voxel belongs to the point (index + 0.5) voxels, and the position of a grasp is not rounded. Rotating
//! both about the vertical axis of the cube is therefore exact. Which voxel a grasp belongs to depends on the voxel
//! origin of the network. (VGN's code rotates indices about 20, which shifts the volume by a voxel relative to the
//! grasps.)

use grasp_data::{DISTINCT_YAWS, Trial};
use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use serde::Serialize;

/// The allowed transforms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Augmentation {
    /// Rotations about z by multiples of 90°.
    // The name in checkpoints and in the metadata of models.
    #[serde(rename = "turns")]
    pub rotate: bool,
    /// Mirror images, x reversed.
    pub mirror: bool,
    /// Maximum shift along z, voxels.
    pub shift: u32,
}

/// A transform: mirrored, then rotated, then shifted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Transform {
    /// Rotations by 90° about z, counter-clockwise seen from above.
    pub quarter_turns: u32,
    /// Whether x is reversed.
    pub mirror: bool,
    /// Shift upwards, voxels.
    pub shift: i32,
}

impl Augmentation {
    /// Draws one of the allowed transforms uniformly.
    pub fn draw(self, rng: &mut impl Rng) -> Transform {
        let shift = self.shift as i32;
        Transform {
            quarter_turns: if self.rotate { rng.random_range(0..4) } else { 0 },
            mirror: self.mirror && rng.random(),
            shift: if shift > 0 { rng.random_range(-shift..=shift) } else { 0 },
        }
    }
}

impl Transform {
    /// Writes the transformed volume to `out`. Both are `[N, N, N]`: `volume` is quantised, `out` is in [0, 1]. Voxels
    /// that are shifted in from outside are unobserved: 0.
    pub fn volume(self, volume: &[u8], n: usize, out: &mut [f32]) {
        for x in 0..n {
            for y in 0..n {
                // The column of the original volume that this column comes from, by the inverse transform.
                let (mut from_x, mut from_y) = (x, y);
                for _ in 0..self.quarter_turns {
                    (from_x, from_y) = (from_y, n - 1 - from_x);
                }
                if self.mirror {
                    from_x = n - 1 - from_x;
                }
                let column = &volume[(from_x * n + from_y) * n..][..n];
                for (z, value) in out[(x * n + y) * n..][..n].iter_mut().enumerate() {
                    let from_z = usize::try_from(z as i64 - i64::from(self.shift)).ok();
                    *value = from_z.and_then(|z| column.get(z)).map_or(0.0, |&byte| grasp_data::value(byte));
                }
            }
        }
    }

    /// The voxel that a voxel of the original volume is moved to; `None` outside the volume. `n` is N.
    #[must_use]
    pub fn voxel(self, [mut x, mut y, z]: [usize; 3], n: usize) -> Option<[usize; 3]> {
        if self.mirror {
            x = n - 1 - x;
        }
        for _ in 0..self.quarter_turns {
            (x, y) = (n - 1 - y, x);
        }
        let z = usize::try_from(z as i64 + i64::from(self.shift)).ok().filter(|&z| z < n)?;
        Some([x, y, z])
    }

    /// The trial in the transformed scene. `n` is N, the voxels along an edge of the volume.
    #[must_use]
    pub fn trial(self, trial: &Trial, n: usize) -> Trial {
        let edge = n as f64;
        let Trial { mut position, mut rotation, mut yaws, .. } = *trial;
        if self.mirror {
            position.x = edge - position.x;
            // The mirror image of a rotation about an axis is the inverse rotation about the mirrored axis. The hand is
            // symmetric in x: its x axis is the negative of the mirrored axis; the approach (z) and the closing axis
            // (y) are the mirrored axes.
            let [x, y, z, w]: [f64; 4] = rotation.coords.into();
            rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, x, -y, -z));
            // Mirroring reverses the direction of the yaws.
            yaws = (1..DISTINCT_YAWS).fold(0, |mirrored, k| mirrored | (yaws >> k & 1) << (DISTINCT_YAWS - k));
        }
        for _ in 0..self.quarter_turns {
            position = Point3::new(edge - position.y, position.x, position.z);
            rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2) * rotation;
        }
        position.z += f64::from(self.shift);
        Trial { position, rotation, yaws, ..*trial }
    }
}
