use std::array;

use nalgebra::{Isometry3, Vector3};

use crate::{Details, Volume};

/// The part of a volume around a hand, in the frame of a grasp: input of a grasp evaluator.
///
/// It has slices over the plane of the closing axis and the approach, each of samples 7.5 mm apart: ±71 mm along the
/// closing axis, and along the approach from 52 mm behind the finger base to 10 mm beyond the fingertips. Along x ten
/// slices are 7.5 mm apart. The slices are:
///
/// - the hand and its way from the pre-grasp, in [`Details`]: for each x four slices, shifted by ±1.9 mm along the
///   closing axis and the approach;
/// - the surroundings, which show the extent of the object: for each x a slice, twice as wide in all directions;
/// - free space: for each x a slice with 1 where a view looked through, else 0;
/// - the heights above the bottom of the volume, as fractions of its edge: for the first and the last x.
///
/// Values are interpolated linearly. Outside of what was observed they are 0. A volume without details is sampled
/// itself, and nothing is known to be free.
#[derive(Clone, Copy, Debug)]
pub struct Patch;

/// Samples along x, the closing axis and the approach.
const NX: usize = 10;
const NY: usize = 20;
const NZ: usize = 16;

/// Samples of a slice.
const SLICE: usize = NY * NZ;

/// The first slices of the surroundings, of free space and of the heights follow those of the hand.
const SURROUNDING: usize = 4 * NX;
const FREE: usize = 5 * NX;
const HEIGHT: usize = 6 * NX;

/// Half of the distance between the samples of the details, metres.
const HALF: f64 = 0.001_875;

impl Patch {
    /// Slices, and samples along the closing axis and the approach.
    pub const SHAPE: [usize; 3] = [HEIGHT + 2, NY, NZ];

    /// Number of samples in all slices.
    pub const SIZE: usize = Self::SHAPE[0] * SLICE;

    /// All slices.
    pub const ALL: [usize; Self::SHAPE[0]] = {
        let mut slices = [0; Self::SHAPE[0]];
        let mut index = 0;
        while index < slices.len() {
            slices[index] = index;
            index += 1;
        }
        slices
    };

    /// The slices of a coarse patch, the input of a coarse evaluator: four through the hand, two of the surroundings, four
    /// of free space, and the heights.
    pub const COARSE: [usize; 12] = [
        4 * 2,
        4 * 4,
        4 * 5,
        4 * 7,
        SURROUNDING + 3,
        SURROUNDING + 6,
        FREE + 2,
        FREE + 4,
        FREE + 5,
        FREE + 7,
        HEIGHT,
        HEIGHT + 1,
    ];

    /// Slices of a coarse patch, and samples along the closing axis and the approach.
    pub const COARSE_SHAPE: [usize; 3] = [Self::COARSE.len(), NY, NZ];

    /// Writes the patch of a grasp at `pose`, which is in the frame of the volume's pose.
    ///
    /// # Panics
    /// If the length of `patch` is not [`SIZE`](Self::SIZE).
    pub fn write(volume: &Volume, pose: &Isometry3<f64>, patch: &mut [f32]) {
        Self::write_slices(volume, pose, &Self::ALL, patch);
    }

    /// Writes the coarse patch of a grasp at `pose`, which is in the frame of the volume's pose.
    ///
    /// # Panics
    /// If the length of `patch` is not the product of [`COARSE_SHAPE`](Self::COARSE_SHAPE).
    pub fn write_coarse(volume: &Volume, pose: &Isometry3<f64>, patch: &mut [f32]) {
        Self::write_slices(volume, pose, &Self::COARSE, patch);
    }

    /// Writes slices of the patch of a grasp at `pose` in details that fill a volume, mirrored along x and the closing axis
    /// as `mirrored` says: training data.
    ///
    /// # Panics
    /// If the length of `patch` is not that of the slices.
    pub fn write_mirrored(
        details: &Details,
        pose: &Isometry3<f64>,
        mirrored: [bool; 2],
        slices: &[usize],
        patch: &mut [f32],
    ) {
        let cube = (*details.pose(), details.resolution() as f64 * details.voxel_size());
        Self::write_details(details, cube, pose, mirrored, slices, patch);
    }

    fn write_slices(volume: &Volume, pose: &Isometry3<f64>, slices: &[usize], patch: &mut [f32]) {
        let cube = (*volume.pose(), volume.resolution() as f64 * volume.voxel_size());
        if let Some(details) = volume.details() {
            return Self::write_details(details, cube, pose, [false; 2], slices, patch);
        }
        let observed = volume.observed();
        let (resolution, values) = (observed.resolution(), observed.values());
        let near = Field { resolution, values, value: |value| value };
        let free = Field { resolution, values, value: |_| 0.0 };
        let axes = [(*observed.pose(), observed.voxel_size()), cube].map(|frame| Axes::new(frame, pose, [false; 2]));
        write_fields(&near, &free, &axes, slices, patch);
    }

    fn write_details(
        details: &Details,
        cube: (Isometry3<f64>, f64),
        pose: &Isometry3<f64>,
        mirrored: [bool; 2],
        slices: &[usize],
        patch: &mut [f32],
    ) {
        let (resolution, values) = (details.resolution(), details.bytes());
        let near = |byte: u8| if byte == Details::FREE { 0.0 } else { f32::from(byte) * (1.0 / 255.0) };
        let free = |byte: u8| if byte == Details::FREE { 1.0 } else { 0.0 };
        let (near, free) = (Field { resolution, values, value: near }, Field { resolution, values, value: free });
        let axes = [(*details.pose(), details.voxel_size()), cube].map(|frame| Axes::new(frame, pose, mirrored));
        write_fields(&near, &free, &axes, slices, patch);
    }
}

/// Writes `slices` of a patch. `free` is 1 in free space. The axes are those of the fields and of the cube whose edge is
/// the unit of the heights.
fn write_fields<T: Copy + Default, N: Fn(T) -> f32, F: Fn(T) -> f32>(
    near: &Field<T, N>,
    free: &Field<T, F>,
    [axes, of_cube]: &[Axes; 2],
    slices: &[usize],
    patch: &mut [f32],
) {
    assert_eq!(patch.len(), slices.len() * SLICE, "a slice has {SLICE} samples");
    for (&slice, samples) in slices.iter().zip(patch.chunks_exact_mut(SLICE)) {
        match slice {
            0..SURROUNDING => {
                let shift = |bit: usize| if slice & bit == 0 { -HALF } else { HALF };
                HAND.slice(slice / 4, [shift(2), shift(1)], axes, |line, start, step| {
                    near.interpolate(start, step, &mut samples[line..line + NZ]);
                });
            }
            SURROUNDING..FREE => SURROUNDINGS.slice(slice - SURROUNDING, [0.0; 2], axes, |line, start, step| {
                near.interpolate(start, step, &mut samples[line..line + NZ]);
            }),
            FREE..HEIGHT => HAND.slice(slice - FREE, [0.0; 2], axes, |line, start, step| {
                free.interpolate(start, step, &mut samples[line..line + NZ]);
            }),
            _ => HAND.slice((slice - HEIGHT) * (NX - 1), [0.0; 2], of_cube, |line, start, step| {
                for (k, height) in samples[line..line + NZ].iter_mut().enumerate() {
                    *height = (start.z + step.z * k as f32).clamp(0.0, 1.0);
                }
            }),
        }
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
    /// Calls `visit` for each line along the approach in slice `index`, shifted by `shift` along the closing axis and the
    /// approach: with the index of the line's first sample in the slice, its position, and the step to the next one.
    fn slice(
        &self,
        index: usize,
        [y, z]: [f64; 2],
        axes: &Axes,
        mut visit: impl FnMut(usize, Vector3<f32>, Vector3<f32>),
    ) {
        let centred = |sample: usize, samples: usize| (sample as f64 - (samples - 1) as f64 / 2.0) * self.spacing;
        let step = (axes.z * self.spacing).cast();
        for line in 0..NY {
            let at = Vector3::new(centred(index, NX), centred(line, NY) + y, self.first + z);
            visit(line * NZ, (axes.origin + axes.x * at.x + axes.y * at.y + axes.z * at.z).cast(), step);
        }
    }
}

/// The origin and the axes of a grasp in a field, in units of the field.
struct Axes {
    origin: Vector3<f64>,
    x: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
}

impl Axes {
    /// The axes of a grasp at `pose` in a frame whose unit is in metres.
    fn new((frame, unit): (Isometry3<f64>, f64), pose: &Isometry3<f64>, mirrored: [bool; 2]) -> Self {
        let pose = frame.inverse() * pose;
        let [x, y] = mirrored.map(|is_mirrored| if is_mirrored { -1.0 / unit } else { 1.0 / unit });
        let axis = |axis: Vector3<f64>, length: f64| pose.rotation * axis * length;
        Self {
            origin: pose.translation.vector / unit,
            x: axis(Vector3::x(), x),
            y: axis(Vector3::y(), y),
            z: axis(Vector3::z(), 1.0 / unit),
        }
    }
}

/// Voxels of a cube with a function to their values.
struct Field<'a, T, V> {
    resolution: usize,
    values: &'a [T],
    value: V,
}

impl<T: Copy + Default, V: Fn(T) -> f32> Field<'_, T, V> {
    /// Writes the values along a line that starts at `start`, in voxels from the corner: each linearly between the eight
    /// nearest voxel centres, and 0 beyond them.
    ///
    /// Positions are fixed-point numbers, and the voxels are read before any value is computed, because the compiler makes
    /// vector instructions of the loops without lookups.
    fn interpolate(&self, start: Vector3<f32>, step: Vector3<f32>, out: &mut [f32]) {
        const ONE: f32 = 65536.0;
        /// Farther from the corner, voxels, than every field reaches, and a longer step: so no position overflows, and those
        /// outside stay outside.
        const FAR: f32 = 8192.0;
        const LONGEST: f32 = 1024.0;
        let n = self.resolution;
        let fixed = |c: f32, most: f32| (c.clamp(-most, most) * ONE) as i32;
        let (start, step) = (start.map(|c| fixed(c - 0.5, FAR)), step.map(|c| fixed(c, LONGEST)));
        let (edge, end) = (n as i32, (n as i32 - 1) << 16);
        let (mut first, mut is_inside, mut weights) = ([0_i32; NZ], [false; NZ], [[0.0_f32; NZ]; 3]);
        for k in 0..NZ {
            let at = start + step * k as i32;
            is_inside[k] = at.iter().fold(true, |inside, &c| inside & (c >= 0) & (c < end));
            let voxel = ((at.x >> 16) * edge + (at.y >> 16)) * edge + (at.z >> 16);
            first[k] = if is_inside[k] { voxel } else { 0 };
            let weight = |c: i32| (c & 0xffff) as f32 / ONE;
            (weights[0][k], weights[1][k], weights[2][k]) = (weight(at.x), weight(at.y), weight(at.z));
        }
        let mut corners = [[T::default(); NZ]; 8];
        for k in 0..NZ {
            let near = &self.values[first[k] as usize..][..n + 2];
            let far = &self.values[first[k] as usize + n * n..][..n + 2];
            for (side, plane) in [near, far].into_iter().enumerate() {
                for (corner, voxel) in [plane[0], plane[1], plane[n], plane[n + 1]].into_iter().enumerate() {
                    corners[4 * side + corner][k] = voxel;
                }
            }
        }
        for (k, out) in out.iter_mut().take(NZ).enumerate() {
            let value = |corner: usize| (self.value)(corners[corner][k]);
            let plane: [f32; 4] = array::from_fn(|i| value(i) + weights[0][k] * (value(i + 4) - value(i)));
            let line: [f32; 2] = array::from_fn(|i| plane[i] + weights[1][k] * (plane[i + 2] - plane[i]));
            let value = line[0] + weights[2][k] * (line[1] - line[0]);
            *out = if is_inside[k] { value } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    const N: usize = 40;

    fn corner() -> Isometry3<f64> {
        Isometry3::translation(1.0, 2.0, 3.0)
    }

    /// A volume whose values rise linearly along x and z; its corner is at (1, 2, 3).
    fn ramp() -> Volume {
        let value = |index: usize| (0.01 * (index / (N * N)) as f32) + 0.005 * (index % N) as f32;
        Volume::new(N, 0.0075, corner(), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    /// Details of half the voxels, near a surface below the middle, free above.
    fn details() -> Details {
        let byte = |index: usize| if index % (2 * N) < N { (index / (4 * N * N)) as u8 } else { Details::FREE };
        Details::new(2 * N, 0.00375, corner(), (0..(2 * N).pow(3)).map(byte).collect()).unwrap()
    }

    fn down_at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI))
    }

    fn patch(volume: &Volume, pose: &Isometry3<f64>) -> Vec<f32> {
        let mut patch = vec![f32::NAN; Patch::SIZE];
        Patch::write(volume, pose, &mut patch);
        patch
    }

    fn sample(patch: &[f32], slice: usize, [j, k]: [usize; 2]) -> f64 {
        f64::from(patch[(slice * NY + j) * NZ + k])
    }

    #[test]
    fn samples_are_interpolated_in_the_frame_of_the_grasp() {
        let patch = patch(&ramp(), &down_at(1.15, 2.15, 3.2));
        let expected = |x: f64, z: f64| 0.01 * (x / 0.0075 - 0.5) + 0.005 * (z / 0.0075 - 0.5);
        for [i, j, k] in [[0, 0, 0], [9, 19, 15], [3, 7, 11]] {
            let x = 0.15 + (i as f64 - 4.5) * 0.0075;
            let z = 0.2 - (-0.0525 + k as f64 * 0.0075);
            for fine in 0..4 {
                let z = if fine % 2 == 0 { z + HALF } else { z - HALF };
                assert!((sample(&patch, 4 * i + fine, [j, k]) - expected(x, z)).abs() < 1e-4, "{i} {j} {k} {fine}");
            }
            assert_eq!(sample(&patch, FREE + i, [j, k]), 0.0, "nothing is known to be free");
            if i % 9 == 0 {
                assert!((sample(&patch, HEIGHT + i / 9, [j, k]) - z / 0.3).abs() < 1e-5, "{i} {j} {k}");
            }
        }
        for [i, j, k] in [[1, 6, 5], [8, 13, 12]] {
            let x = 0.15 + (i as f64 - 4.5) * 0.015;
            let z = 0.2 - (-0.0625 + k as f64 * 0.015);
            assert!((sample(&patch, SURROUNDING + i, [j, k]) - expected(x, z)).abs() < 1e-4, "{i} {j} {k}");
        }
    }

    #[test]
    fn details_tell_free_space_from_hidden_space() {
        let volume = ramp().with_details(details());
        let patch = patch(&volume, &down_at(1.15, 2.15, 3.15));
        // The base of the fingers is at the middle, at k = 7.
        let (above, below) = ([10, 3], [10, 12]);
        for i in 0..NX {
            assert_eq!([above, below].map(|at| sample(&patch, FREE + i, at)), [1.0, 0.0], "{i}");
            assert_eq!(sample(&patch, 4 * i, above), 0.0, "free space has no distance");
            let x = 0.15 + (i as f64 - 4.5) * 0.0075;
            let byte = sample(&patch, 4 * i, below) * 255.0;
            assert!((byte - (x / 0.00375 - 0.5)).abs() < 0.01, "{i}: {byte}");
        }
    }

    #[test]
    fn a_coarse_patch_has_slices_of_the_patch() {
        let pose = corner() * Isometry3::new(Vector3::new(0.12, 0.17, 0.15), Vector3::new(2.8, 0.3, 0.9));
        for volume in [ramp(), ramp().with_details(details())] {
            let patch = patch(&volume, &pose);
            let mut coarse = vec![f32::NAN; Patch::COARSE_SHAPE.iter().product()];
            Patch::write_coarse(&volume, &pose, &mut coarse);
            for (slice, samples) in Patch::COARSE.into_iter().zip(coarse.chunks_exact(SLICE)) {
                assert_eq!(samples, &patch[slice * SLICE..][..SLICE], "{slice}");
            }
        }
    }

    #[test]
    fn a_mirrored_patch_has_reversed_samples() {
        let (details, pose) =
            (details(), corner() * Isometry3::new(Vector3::new(0.12, 0.17, 0.15), Vector3::new(2.8, 0.3, 0.9)));
        let [plain, mirrored] = [[false, false], [true, true]].map(|mirrored| {
            let mut patch = vec![f32::NAN; Patch::SIZE];
            Patch::write_mirrored(&details, &pose, mirrored, &Patch::ALL, &mut patch);
            patch
        });
        for (slice, reversed) in
            [(4 * 2, 4 * 7 + 2), (4 * 3 + 1, 4 * 6 + 3), (SURROUNDING + 2, SURROUNDING + 7), (HEIGHT, HEIGHT + 1)]
        {
            let difference = sample(&plain, slice, [5, 9]) - sample(&mirrored, reversed, [14, 9]);
            assert!(difference.abs() < 1e-4, "{slice}: {difference}");
        }
    }

    #[test]
    fn half_a_turn_of_the_hand_reverses_x_and_y() {
        let pose = Isometry3::from_parts(
            Translation3::new(1.12, 2.17, 3.15),
            UnitQuaternion::from_euler_angles(2.8, 0.3, 0.9),
        );
        let turned = pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI);
        let [one, other] = [pose, turned].map(|pose| patch(&ramp(), &pose));
        for (slice, reversed) in [(4 * 2, 4 * 7 + 2), (SURROUNDING + 2, SURROUNDING + 7), (HEIGHT, HEIGHT + 1)] {
            let difference = sample(&one, slice, [5, 9]) - sample(&other, reversed, [14, 9]);
            assert!(difference.abs() < 1e-4, "{slice}: {difference}");
        }
    }

    #[test]
    fn outside_the_volume_nothing_was_observed() {
        let tiny = Volume::new(N, 1e-6, corner(), ramp().values().to_vec()).unwrap();
        for (volume, distance) in [5.0, -5.0, 1e6, -1e6, 1e30].map(|x| (ramp(), x)).into_iter().chain([(tiny, 1.0)]) {
            let patch = patch(&volume, &Isometry3::translation(distance, 2.15, 3.2));
            assert!(patch[..HEIGHT * SLICE].iter().all(|&value| value == 0.0), "{distance}");
        }
    }
}
