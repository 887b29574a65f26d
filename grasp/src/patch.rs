use nalgebra::{Isometry3, Vector3};

use crate::Volume;

/// The part of a volume around a hand, in the frame of a grasp: input of a grasp evaluator.
///
/// It has three channels of samples:
///
/// - the hand and its way from the pre-grasp: the volume's values 7.5 mm apart, over ±34 mm along x, ±71 mm along the
///   closing axis, and along the approach from 52 mm behind the finger base to 10 mm beyond the fingertips;
/// - the surroundings, which show the extent of the object: the values 15 mm apart, over ±67 mm, ±142 mm, and 112 mm
///   before and behind the fingertips;
/// - the heights of the samples of the first channel above the bottom of the volume, as fractions of its edge.
///
/// Values are interpolated linearly. Outside of what was observed around the volume they are 0.
#[derive(Clone, Copy, Debug)]
pub struct Patch;

/// Samples of one channel.
const SAMPLES: usize = Patch::SHAPE[1] * Patch::SHAPE[2] * Patch::SHAPE[3];

impl Patch {
    /// Channels, and samples along x, y and z.
    pub const SHAPE: [usize; 4] = [3, 10, 20, 16];

    /// Number of samples in all channels.
    pub const SIZE: usize = Self::SHAPE[0] * SAMPLES;

    /// Writes the patch of a grasp at `pose`, which is in the frame of the volume's pose.
    ///
    /// # Panics
    /// If the length of `patch` is not [`SIZE`](Self::SIZE).
    pub fn write(volume: &Volume, pose: &Isometry3<f64>, patch: &mut [f32]) {
        assert_eq!(patch.len(), Self::SIZE, "a patch has {} samples", Self::SIZE);
        let (hand, rest) = patch.split_at_mut(SAMPLES);
        let (surroundings, heights) = rest.split_at_mut(SAMPLES);
        let in_volume = volume.pose().inverse() * pose;
        let per_voxel = 1.0 / volume.resolution() as f32;
        let (observed, padding) = (volume.observed(), volume.padding() as f32);
        let value = |at: Vector3<f32>| interpolated(observed, at.add_scalar(padding));
        HAND.for_each(&in_volume, volume.voxel_size(), |index, at| {
            hand[index] = value(at);
            heights[index] = ((at.z + 0.5) * per_voxel).clamp(0.0, 1.0);
        });
        SURROUNDINGS.for_each(&in_volume, volume.voxel_size(), |index, at| {
            surroundings[index] = value(at);
        });
    }
}

/// A grid of samples along the axes of a grasp, centred along x and y. Lengths are in metres.
struct Grid {
    /// Distance between two samples.
    spacing: f64,
    /// First sample along the approach.
    first: f64,
}

/// 7.5 mm is the voxel size of VGN's volumes.
const HAND: Grid = Grid { spacing: 0.0075, first: -0.0525 };

const SURROUNDINGS: Grid = Grid { spacing: 0.015, first: -0.0625 };

impl Grid {
    /// Calls `visit` with the index of each sample and its position in voxels: voxel centres are at whole numbers.
    fn for_each(&self, pose: &Isometry3<f64>, voxel_size: f64, mut visit: impl FnMut(usize, Vector3<f32>)) {
        let [_, nx, ny, nz] = Patch::SHAPE;
        let scale = 1.0 / voxel_size;
        let step = |axis: Vector3<f64>| (pose.rotation * axis * (self.spacing * scale)).map(|c| c as f32);
        let [along_x, along_y, along_z] = [Vector3::x(), Vector3::y(), Vector3::z()].map(step);
        let centred = |samples: usize| -self.spacing * (samples - 1) as f64 / 2.0;
        let corner = Vector3::new(centred(nx), centred(ny), self.first);
        let corner = (pose.rotation * corner + pose.translation.vector) * scale;
        let corner = corner.map(|c| c as f32 - 0.5);
        for i in 0..nx {
            for j in 0..ny {
                let start = corner + along_x * i as f32 + along_y * j as f32;
                for k in 0..nz {
                    visit((i * ny + j) * nz + k, start + along_z * k as f32);
                }
            }
        }
    }
}

/// The value at a position in voxels, linearly between the eight nearest voxel centres; 0 beyond the volume.
fn interpolated(volume: &Volume, at: Vector3<f32>) -> f32 {
    let n = volume.resolution();
    let last = (n - 1) as f32;
    let is_inside = |c: f32| (0.0..last).contains(&c);
    if !(is_inside(at.x) && is_inside(at.y) && is_inside(at.z)) {
        return 0.0;
    }
    // Truncation rounds down, because the coordinates are not negative.
    let [x, y, z]: [u32; 3] = at.map(|c| c as u32).into();
    let [fx, fy, fz]: [f32; 3] = [at.x - x as f32, at.y - y as f32, at.z - z as f32];
    let first = (x as usize * n + y as usize) * n + z as usize;
    let (near, far) = (&volume.values()[first..], &volume.values()[first + n * n..]);
    let along_z = |line: &[f32]| line[0] + fz * (line[1] - line[0]);
    let along_y = |plane: &[f32]| {
        let (near, far) = (along_z(plane), along_z(&plane[n..]));
        near + fy * (far - near)
    };
    let (near, far) = (along_y(near), along_y(far));
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

    fn patch(pose: &Isometry3<f64>) -> Vec<f32> {
        let mut patch = vec![f32::NAN; Patch::SIZE];
        Patch::write(&ramp(), pose, &mut patch);
        patch
    }

    fn sample(patch: &[f32], channel: usize, [i, j, k]: [usize; 3]) -> f64 {
        let [_, nx, ny, nz] = Patch::SHAPE;
        f64::from(patch[((channel * nx + i) * ny + j) * nz + k])
    }

    #[test]
    fn samples_are_interpolated_in_the_frame_of_the_grasp() {
        // Straight down, closing along y.
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        let patch = patch(&Isometry3::from_parts(Translation3::new(1.15, 2.15, 3.2), down));
        let expected = |x: f64, z: f64| 0.01 * (x / 0.0075 - 0.5) + 0.005 * (z / 0.0075 - 0.5);
        for at @ [i, _, k] in [[0, 0, 0], [9, 19, 15], [3, 7, 11]] {
            let x = 0.15 + (i as f64 - 4.5) * 0.0075;
            let z = 0.2 - (-0.0525 + k as f64 * 0.0075);
            assert!((sample(&patch, 0, at) - expected(x, z)).abs() < 1e-5, "{at:?}");
            assert!((sample(&patch, 2, at) - z / 0.3).abs() < 1e-5, "{at:?}");
        }
        for at @ [i, _, k] in [[1, 6, 5], [8, 13, 12]] {
            let x = 0.15 + (i as f64 - 4.5) * 0.015;
            let z = 0.2 - (-0.0625 + k as f64 * 0.015);
            assert!((sample(&patch, 1, at) - expected(x, z)).abs() < 1e-5, "{at:?}");
        }
    }

    #[test]
    fn half_a_turn_of_the_hand_reverses_x_and_y() {
        let pose = Isometry3::from_parts(
            Translation3::new(1.12, 2.17, 3.15),
            UnitQuaternion::from_euler_angles(2.8, 0.3, 0.9),
        );
        let [one, other] =
            [pose, pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI)].map(|pose| patch(&pose));
        for channel in 0..3 {
            let difference = sample(&one, channel, [2, 5, 9]) - sample(&other, channel, [7, 14, 9]);
            assert!(difference.abs() < 1e-5, "{difference}");
        }
    }

    #[test]
    fn outside_the_volume_nothing_was_observed() {
        let patch = patch(&Isometry3::translation(5.0, 2.15, 3.2));
        assert!(patch[..2 * SAMPLES].iter().all(|&value| value == 0.0));
    }
}
