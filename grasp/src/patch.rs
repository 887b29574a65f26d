use nalgebra::{Isometry3, Vector3};

use crate::Volume;

/// The part of a volume around a hand, in the frame of a grasp: input of a grasp evaluator.
///
/// The samples cover the hand and its way from the pre-grasp: ±34 mm along x, ±71 mm along the closing axis, and along
/// the approach from 52 mm behind the finger base to 10 mm beyond the fingertips. Each sample has two channels: the
/// volume's value, interpolated linearly, and its height above the bottom of the volume, as a fraction of the edge.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Patch {
    values: Vec<u8>,
}

/// Distance between two samples, metres: the voxel size of VGN's volumes.
const SPACING: f64 = 0.0075;

/// First sample along the approach, metres.
const FIRST: f64 = -0.0525;

impl Patch {
    /// Channels, and samples along x, y and z.
    pub const SHAPE: [usize; 4] = [2, 10, 20, 16];

    /// The patch of a grasp at `pose`, which is in the frame of the volume's pose. Outside the volume the value is 0,
    /// as where nothing was observed.
    #[must_use]
    pub fn of(volume: &Volume, pose: &Isometry3<f64>) -> Self {
        let [_, nx, ny, nz] = Self::SHAPE;
        let in_volume = volume.pose().inverse() * pose;
        // In voxels, so that voxel centres are at whole numbers.
        let scale = 1.0 / volume.voxel_size();
        let step = |axis: Vector3<f64>| (in_volume.rotation * axis * (SPACING * scale)).map(|c| c as f32);
        let [along_x, along_y, along_z] = [Vector3::x(), Vector3::y(), Vector3::z()].map(step);
        let corner = Vector3::new(-SPACING * (nx - 1) as f64 / 2.0, -SPACING * (ny - 1) as f64 / 2.0, FIRST);
        let corner = (in_volume.rotation * corner + in_volume.translation.vector) * scale;
        let corner = corner.map(|c| c as f32 - 0.5);
        let mut values = vec![0; Self::SHAPE.iter().product()];
        let (tsdf, heights) = values.split_at_mut(nx * ny * nz);
        let per_voxel = 1.0 / volume.resolution() as f32;
        for (index, (value, height)) in tsdf.iter_mut().zip(heights).enumerate() {
            let (i, j, k) = (index / (ny * nz), index / nz % ny, index % nz);
            let at = corner + along_x * i as f32 + along_y * j as f32 + along_z * k as f32;
            *value = quantized(interpolated(volume, at));
            *height = quantized((at.z + 0.5) * per_voxel);
        }
        Self { values }
    }

    /// The samples, [`SHAPE`](Self::SHAPE); 255 stands for 1.
    #[must_use]
    pub fn values(&self) -> &[u8] {
        &self.values
    }
}

fn quantized(value: f32) -> u8 {
    // The conversion saturates at 0 and 255.
    (value * 255.0).round() as u8
}

/// The value at a position in voxels, linearly between the eight nearest voxel centres; 0 beyond the volume.
fn interpolated(volume: &Volume, at: Vector3<f32>) -> f32 {
    let n = volume.resolution();
    let values = volume.values();
    let cell = at.map(f32::floor);
    let [fx, fy, fz]: [f32; 3] = (at - cell).into();
    let [x, y, z]: [i32; 3] = cell.map(|c| c as i32).into();
    let last = n as i32 - 1;
    if [x, y, z].iter().any(|&c| c < 0 || c >= last) {
        return 0.0;
    }
    let first = (x as usize * n + y as usize) * n + z as usize;
    let along_z = |index: usize| values[index] + fz * (values[index + 1] - values[index]);
    let along_y = |index: usize| {
        let (near, far) = (along_z(index), along_z(index + n));
        near + fy * (far - near)
    };
    let (near, far) = (along_y(first), along_y(first + n * n));
    near + fx * (far - near)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    const N: usize = 40;

    /// A volume whose values rise linearly along x and z; its corner is at (1, 2, 3).
    fn ramp() -> Volume {
        let value = |index: usize| (0.01 * (index / (N * N)) as f32) + 0.005 * (index % N) as f32;
        Volume::new(N, 0.0075, Isometry3::translation(1.0, 2.0, 3.0), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    fn sample(patch: &Patch, channel: usize, [i, j, k]: [usize; 3]) -> f64 {
        let [_, nx, ny, nz] = Patch::SHAPE;
        f64::from(patch.values()[((channel * nx + i) * ny + j) * nz + k]) / 255.0
    }

    #[test]
    fn samples_are_interpolated_in_the_frame_of_the_grasp() {
        // Straight down, closing along y.
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        let pose = Isometry3::from_parts(Translation3::new(1.15, 2.15, 3.2), down);
        let patch = Patch::of(&ramp(), &pose);
        for at @ [i, _, k] in [[0, 0, 0], [9, 19, 15], [3, 7, 11]] {
            let x = 0.15 + (i as f64 - 4.5) * 0.0075;
            let z = 0.2 - (-0.0525 + k as f64 * 0.0075);
            let expected = 0.01 * (x / 0.0075 - 0.5) + 0.005 * (z / 0.0075 - 0.5);
            assert!((sample(&patch, 0, at) - expected).abs() < 0.003, "{at:?}");
            assert!((sample(&patch, 1, at) - z / 0.3).abs() < 0.003, "{at:?}");
        }
    }

    #[test]
    fn half_a_turn_of_the_hand_reverses_x_and_y() {
        let pose = Isometry3::from_parts(
            Translation3::new(1.12, 2.17, 3.15),
            UnitQuaternion::from_euler_angles(2.8, 0.3, 0.9),
        );
        let turned = pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI);
        let [one, other] = [pose, turned].map(|pose| Patch::of(&ramp(), &pose));
        for channel in 0..2 {
            let difference = sample(&one, channel, [2, 5, 9]) - sample(&other, channel, [7, 14, 9]);
            assert!(difference.abs() < 0.005, "{difference}");
        }
    }

    #[test]
    fn outside_the_volume_nothing_was_observed() {
        let patch = Patch::of(&ramp(), &Isometry3::translation(5.0, 2.15, 3.2));
        assert!(patch.values()[..10 * 20 * 16].iter().all(|&value| value == 0));
    }
}
