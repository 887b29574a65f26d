mod details;
mod no_measurement;

use nalgebra::Isometry3;
use rayon::prelude::*;

use crate::measurement::{Measurement, Sample};
use crate::surface::Field;
use crate::{DepthImage, Volume, VolumeError};

pub use no_measurement::NoMeasurement;

/// Largest valid depth, metres, as in VGN's perception code.
pub const DEPTH_MAX: f32 = 2.0;

/// Truncation distance in voxels (VGN: 4 voxels = 0.03 m at 40³).
pub const TRUNCATION_VOXELS: f64 = 4.0;

/// Voxels whose |truncated distance| reaches this are read out as 0, like unobserved voxels (constant from Open3D).
pub(crate) const NEAR_SURFACE: f32 = 0.98;

/// Fuses depth images into a truncated signed distance field over a cube. Every view has the same weight, unless the
/// field [forgets](Self::forgetting).
#[derive(Clone, Debug)]
pub struct Fusion {
    resolution: usize,
    voxel_size: f64,
    truncation: f32,
    voxels: Vec<Voxel>,
    /// By this factor the weight of the earlier views decreases with each measurement, if the field forgets.
    decay: Option<f32>,
}

/// Signed distance as a fraction of the truncation distance, in [-1, 1], and the number of views that measured it, or
/// [`HIDDEN`].
#[derive(Clone, Copy, Debug, Default)]
struct Voxel {
    distance: f32,
    weight: f32,
}

/// Weight of a voxel that no view has measured, and that lies behind a surface in at least one.
const HIDDEN: f32 = -1.0;

/// Difference between a measurement and the field, as a fraction of the truncation distance, from which they contradict
/// each other: beyond the noise of depth cameras.
const CONTRADICTION: f32 = 0.5;

impl Fusion {
    /// An empty field of `resolution`³ voxels over a cube with an edge of `size` metres.
    #[must_use]
    pub fn new(resolution: usize, size: f64) -> Self {
        Self::of_voxels(resolution, size / resolution as f64)
    }

    /// An empty field of `resolution`³ voxels with an edge of `voxel_size` metres.
    #[must_use]
    pub fn of_voxels(resolution: usize, voxel_size: f64) -> Self {
        Self {
            resolution,
            voxel_size,
            truncation: (TRUNCATION_VOXELS * voxel_size) as f32,
            voxels: vec![Voxel::default(); resolution.pow(3)],
            decay: None,
        }
    }

    /// The field, which now forgets: the weight of a voxel's measurement halves with every `half_life` further
    /// measurements of this voxel, and with every one that contradicts it. So objects that have moved disappear from the
    /// field, and what is out of view remains.
    #[must_use]
    pub fn forgetting(self, half_life: f64) -> Self {
        Self { decay: Some(0.5_f64.powf(1.0 / half_life) as f32), ..self }
    }

    /// Adds one view. `camera_from_task` (`T_camera_task`) maps points of the cube's frame into the camera frame.
    ///
    /// Returns the number of measured voxels. If it is 0, [`no_measurement`](Self::no_measurement) gives the reason.
    pub fn integrate(&mut self, image: &DepthImage, camera_from_task: &Isometry3<f64>) -> usize {
        let (n, decay) = (self.resolution, self.decay);
        let measurement = Measurement::new(image, camera_from_task, self.voxel_size, self.truncation);
        let integrate_column = |column: [usize; 2], voxels: &mut [Voxel]| {
            let mut measured = 0;
            measurement.column([column[0], column[1], 0], n, |z, sample| match sample {
                Sample::Hidden => voxels[z].hide(),
                Sample::Distance(distance) => {
                    let voxel = &mut voxels[z];
                    let weight = voxel.weight.max(0.0);
                    let weight = decay.map_or(weight, |decay| decay * weight * voxel.support(distance));
                    voxel.distance = (voxel.distance * weight + distance) / (weight + 1.0);
                    voxel.weight = weight + 1.0;
                    measured += 1;
                }
            });
            measured
        };
        let integrate_layer = |(x, voxels): (usize, &mut [Voxel])| -> usize {
            voxels.chunks_exact_mut(n).enumerate().map(|(y, voxels)| integrate_column([x, y], voxels)).sum()
        };
        self.voxels.par_chunks_exact_mut(n * n).enumerate().map(integrate_layer).sum()
    }

    /// Share of the voxels that a view has measured, also as free space, without those of `padding` on each side.
    #[must_use]
    pub fn measured(&self, padding: usize) -> f64 {
        let voxels = crate::volume::middle(&self.voxels, self.resolution, padding);
        voxels.iter().filter(|voxel| voxel.weight > 0.0).count() as f64 / voxels.len() as f64
    }

    /// Share of an image's surface in the cube that lies in space which the fused views saw as free. `None` if fewer
    /// than 100 of the sampled pixels are in measured space.
    #[must_use]
    pub fn contradicted(&self, image: &DepthImage, camera_from_task: &Isometry3<f64>) -> Option<f64> {
        /// About this many pixels are sampled.
        const SAMPLES: usize = 5000;
        const FEWEST: usize = 100;
        /// Distance in front of a surface from which space counts as free, metres: beyond the noise of depth cameras.
        const FREE: f32 = 0.024;
        if self.voxels.iter().all(|voxel| voxel.weight <= 0.0) {
            return None;
        }
        // With small voxels no distance is as large.
        let free = FREE.min(0.8 * self.truncation);
        let size = self.voxel_size * self.resolution as f64;
        // Odd, so that the sampled pixels are not in few columns.
        let every = (image.depth().len() / SAMPLES) | 1;
        let (mut compared, mut contradicted) = (0_usize, 0_usize);
        for point in image.points_of_every(every, camera_from_task) {
            if !point.position.iter().all(|c| (0.0..size).contains(c)) {
                continue;
            }
            let [x, y, z]: [usize; 3] = point.position.coords.map(|c| (c / self.voxel_size) as usize).into();
            let index = (x * self.resolution + y) * self.resolution + z;
            // Rounding may reach the upper side of the cube.
            let Some(voxel) = self.voxels.get(index).filter(|voxel| voxel.weight > 0.0) else { continue };
            compared += 1;
            contradicted += usize::from(voxel.distance * self.truncation > free);
        }
        (compared >= FEWEST).then(|| contradicted as f64 / compared as f64)
    }

    /// The input values of a network, `[N, N, N]`, indexed `[x][y][z]`: `(tsdf + 1) / 2` near an observed surface, else
    /// 0.
    #[must_use]
    pub fn values(&self) -> Vec<f32> {
        self.voxels
            .iter()
            .map(|voxel| if voxel.is_near_surface() { (voxel.distance + 1.0) * 0.5 } else { 0.0 })
            .collect()
    }

    /// The fused field as a validated volume at `pose` (`T_frame_task`).
    ///
    /// # Errors
    /// [`VolumeError::Empty`] if no surface was observed.
    pub fn volume(&self, pose: Isometry3<f64>) -> Result<Volume, VolumeError> {
        let hidden = self.voxels.iter().map(|voxel| voxel.weight == HIDDEN).collect();
        Ok(Volume::new(self.resolution, self.voxel_size, pose, self.values())?.with_hidden(hidden))
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
}

impl Field for Fusion {
    fn resolution(&self) -> usize {
        self.resolution
    }

    fn voxel_size(&self) -> f64 {
        self.voxel_size
    }

    fn distance(&self, index: usize) -> f32 {
        self.voxels[index].distance
    }

    fn near_surface(&self, index: usize) -> Option<f32> {
        let voxel = self.voxels[index];
        voxel.is_near_surface().then_some(voxel.distance)
    }
}

impl Voxel {
    /// Notes that the voxel lies behind a surface.
    fn hide(&mut self) {
        if self.weight == 0.0 {
            self.weight = HIDDEN;
        }
    }

    /// The factor by which a measurement changes the weight of those before it: a half if it contradicts them.
    fn support(self, sample: f32) -> f32 {
        let is_free = |distance: f32| distance >= NEAR_SURFACE;
        let contradicts = is_free(sample) != is_free(self.distance) || (sample - self.distance).abs() > CONTRADICTION;
        if contradicts { 0.5 } else { 1.0 }
    }

    fn is_near_surface(self) -> bool {
        self.weight > 0.0 && self.distance < NEAR_SURFACE && self.distance >= -NEAR_SURFACE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Intrinsics, RESOLUTION, WORKSPACE_SIZE};

    /// A camera at the origin of its frame looking along +z of the task frame from 0.5 m below the cube.
    pub(super) fn facing() -> Isometry3<f64> {
        Isometry3::translation(-0.15, -0.15, 0.5)
    }

    #[test]
    fn a_wall_is_reconstructed_at_its_position() {
        let camera = Intrinsics::BENCHMARK;
        let depth = vec![0.65; camera.width * camera.height];
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        fusion.integrate(&DepthImage::new(camera, &depth).unwrap(), &facing());
        let values = fusion.values();
        // The wall is at z = 0.15, the boundary between voxels 19 and 20: centre 19 lies half a voxel in front, centre
        // 20 half a voxel behind.
        let at = |z: usize| values[(20 * 40 + 20) * 40 + z];
        assert!((at(19) - (0.5 + 0.5 / 8.0)).abs() < 1e-3, "{}", at(19));
        assert!((at(20) - (0.5 - 0.5 / 8.0)).abs() < 1e-3, "{}", at(20));
        assert_eq!(at(5), 0.0, "free space beyond the truncation distance is 0");
        assert_eq!(at(35), 0.0, "occluded space is 0");
    }

    #[test]
    fn a_volume_has_the_surface_of_its_field() {
        let camera = Intrinsics::BENCHMARK;
        let depth = vec![0.65; camera.width * camera.height];
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        fusion.integrate(&DepthImage::new(camera, &depth).unwrap(), &facing());
        let (surface, expected) = (fusion.volume(Isometry3::identity()).unwrap().surface(), fusion.surface());
        assert!(surface.len() == expected.len() && surface.len() > 500, "{} points", surface.len());
        let worst = surface.iter().zip(&expected).map(|(a, b)| (a.position - b.position).norm()).fold(0.0, f64::max);
        assert!(worst < 1e-6 && surface.iter().all(|point| point.normal.z < -0.99), "{worst}");
    }

    #[test]
    fn space_behind_a_surface_is_hidden() {
        let camera = Intrinsics::BENCHMARK;
        // The left half of the image shows a wall at z = 0.15, the right half has no measurement.
        let depth: Vec<f32> = (0..camera.width * camera.height)
            .map(|pixel| if pixel % camera.width < camera.width / 2 { 0.65 } else { 0.0 })
            .collect();
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        fusion.integrate(&DepthImage::new(camera, &depth).unwrap(), &facing());
        let volume = fusion.volume(Isometry3::identity()).unwrap();
        let hidden = |x: usize, z: usize| volume.hidden().unwrap()[(x * 40 + 20) * 40 + z];
        assert_eq!([5, 19, 22, 25, 38].map(|z| hidden(10, z)), [false, false, false, true, true]);
        assert!(!hidden(30, 38), "nothing is known where there is no measurement");
    }

    #[test]
    fn a_field_that_forgets_drops_what_has_moved() {
        let camera = Intrinsics::BENCHMARK;
        let wall = |depth: f32| vec![depth; camera.width * camera.height];
        let (near, far) = (wall(0.6), wall(0.7));
        let crossing = |fusion: &Fusion| {
            let values = fusion.values();
            let column = &values[(20 * 40 + 20) * 40..][..40];
            (1..40).filter(|&z| column[z - 1] >= 0.5 && column[z] > 0.0 && column[z] < 0.5).collect::<Vec<_>>()
        };
        let fused = |forgets: bool| {
            let fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
            let mut fusion = if forgets { fusion.forgetting(10.0) } else { fusion };
            let mut add = |depth: &[f32], times: usize| {
                let image = DepthImage::new(camera, depth).unwrap();
                (0..times).for_each(|_| _ = fusion.integrate(&image, &facing()));
            };
            add(&near, 20);
            add(&far, 6);
            fusion
        };
        // The wall moved from z = 0.1 to z = 0.2, which lies between the voxels 26 and 27.
        assert_eq!(crossing(&fused(true)), [27]);
        assert_ne!(crossing(&fused(false)), [27]);
    }

    #[test]
    fn a_field_that_forgets_keeps_what_stands_still() {
        let camera = Intrinsics::BENCHMARK;
        let depth = vec![0.65; camera.width * camera.height];
        let image = DepthImage::new(camera, &depth).unwrap();
        let fused = |mut fusion: Fusion| {
            (0..10).for_each(|_| _ = fusion.integrate(&image, &facing()));
            fusion.values()
        };
        let fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        let (kept, plain) = (fused(fusion.clone().forgetting(5.0)), fused(fusion));
        assert!(kept.iter().zip(&plain).all(|(a, b)| (a - b).abs() < 1e-4));
    }

    #[test]
    fn invalid_depth_is_ignored() {
        let camera = Intrinsics::BENCHMARK;
        for invalid in [0.0, -1.0, f32::NAN, f32::INFINITY, 2.5] {
            let depth = vec![invalid; camera.width * camera.height];
            let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
            fusion.integrate(&DepthImage::new(camera, &depth).unwrap(), &facing());
            assert_eq!(fusion.volume(Isometry3::identity()), Err(VolumeError::Empty), "{invalid}");
        }
    }
}
