use std::borrow::Borrow;

use nalgebra::{Isometry3, Point3};
use thiserror::Error;

use crate::measurement::{Measurement, Sample};
use crate::surface::Field;
use crate::{DepthImage, Details, Volume, VolumeError};

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

/// Why a view measures no voxel of the workspace.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum NoMeasurement {
    /// The whole workspace has negative depth.
    #[error(
        "the workspace is behind the camera; check that the pose is not inverted and is that of the optical frame \
         (z forward)"
    )]
    Behind,
    /// No point of the workspace projects into the image.
    #[error(
        "the workspace is outside the image: its centre projects to pixel ({u:.0}, {v:.0}); check that the pose is not \
         inverted, is in metres, and is that of the optical frame (z forward)"
    )]
    Outside {
        /// Column of the projected workspace centre.
        u: f64,
        /// Row of the projected workspace centre.
        v: f64,
    },
    /// No pixel on the workspace has a valid depth.
    #[error(
        "no pixel on the workspace has a depth between 0 and {DEPTH_MAX} m; the workspace centre is at a depth of \
         {distance:.3} m; check the depth image and the camera pose"
    )]
    NoReading {
        /// Depth of the workspace centre, metres.
        distance: f64,
    },
    /// All readings on the workspace are beyond the range.
    #[error(
        "all depths on the workspace are beyond {DEPTH_MAX} m: at least {depth:.3} m, {:.1} × the {distance:.3} m of the \
         workspace centre; check the depth unit and the camera pose",
        f64::from(*depth) / distance
    )]
    Far {
        /// Smallest depth measured on the workspace, metres.
        depth: f32,
        /// Depth of the workspace centre, metres.
        distance: f64,
    },
    /// All measured surfaces are in front of the workspace.
    #[error(
        "all measured depths are in front of the workspace: at most {depth:.4} m, its centre is at {distance:.3} m; \
         check the depth unit, the camera pose and the view for occlusion"
    )]
    Hidden {
        /// Largest depth measured on the workspace, metres.
        depth: f32,
        /// Depth of the workspace centre, metres.
        distance: f64,
    },
}

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
        let mut measured = 0;
        for (row, voxels) in self.voxels.chunks_exact_mut(n).enumerate() {
            measurement.column([row / n, row % n, 0], n, |z, sample| match sample {
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
        }
        measured
    }

    /// The reason why a view [measures](Self::integrate) no voxel.
    #[must_use]
    pub fn no_measurement(&self, image: &DepthImage, camera_from_task: &Isometry3<f64>) -> NoMeasurement {
        const STEPS: usize = 16;
        let camera = image.intrinsics();
        let size = self.voxel_size * self.resolution as f64;
        let project = |point: Point3<f64>| {
            let Point3 { coords, .. } = camera_from_task * point;
            let [u, v] = [coords.x / coords.z * camera.fx + camera.cx, coords.y / coords.z * camera.fy + camera.cy];
            (coords.z, u, v)
        };
        let (distance, centre_u, centre_v) = project(Point3::from([size / 2.0; 3]));
        let grid = |step: usize| (step as f64 + 0.5) / STEPS as f64 * size;
        let points =
            (0..STEPS.pow(3)).map(|i| Point3::from([i / (STEPS * STEPS), i / STEPS % STEPS, i % STEPS].map(grid)));
        let before: Vec<_> = points.map(project).filter(|&(z, ..)| z > 0.0).collect();
        if before.is_empty() {
            return NoMeasurement::Behind;
        }
        let inside = |u: f64, v: f64| {
            let pixel = (u.round() >= 0.0 && v.round() >= 0.0).then_some((u.round() as usize, v.round() as usize));
            pixel.filter(|&(u, v)| u < camera.width && v < camera.height)
        };
        let pixels: Vec<_> = before.iter().filter_map(|&(_, u, v)| inside(u, v)).collect();
        if pixels.is_empty() {
            return NoMeasurement::Outside { u: centre_u, v: centre_v };
        }
        let readings = || {
            let depth = pixels.iter().map(|&(u, v)| image.depth()[v * camera.width + u]);
            depth.filter(|depth| *depth > 0.0 && depth.is_finite())
        };
        if let Some(depth) = readings().filter(|depth| *depth <= DEPTH_MAX).reduce(f32::max) {
            return NoMeasurement::Hidden { depth, distance };
        }
        match readings().reduce(f32::min) {
            Some(depth) => NoMeasurement::Far { depth, distance },
            None => NoMeasurement::NoReading { distance },
        }
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

    /// The fused field as a validated volume at `pose` (`T_frame_task`), with the details that `views`, which were
    /// integrated, show: images, and their `T_camera_task`.
    ///
    /// # Errors
    /// [`VolumeError::Empty`] if no surface was observed.
    pub fn detailed_volume<'a>(
        &self,
        pose: Isometry3<f64>,
        views: &[(impl Borrow<DepthImage<'a>>, Isometry3<f64>)],
    ) -> Result<Volume, VolumeError> {
        let volume = self.volume(pose)?;
        let details = Details::new(2 * self.resolution, self.voxel_size / 2.0, pose, self.details(views))?;
        Ok(volume.with_details(details))
    }

    /// The bytes of [`Details`]. Where the voxels and those around them are all free, or all hidden, so are the smaller ones
    /// in them.
    fn details<'a>(&self, views: &[(impl Borrow<DepthImage<'a>>, Isometry3<f64>)]) -> Vec<u8> {
        let (n, fine) = (self.resolution, 2 * self.resolution);
        let views: Vec<_> = views
            .iter()
            .map(|(image, pose)| Measurement::new(image.borrow(), pose, self.voxel_size / 2.0, self.truncation))
            .collect();
        let uniform = self.uniform();
        let mut bytes = vec![0; fine.pow(3)];
        let mut sums = vec![(0.0, 0.0); fine];
        for (row, bytes) in bytes.chunks_exact_mut(fine).enumerate() {
            let (x, y) = (row / fine, row % fine);
            let uniform = &uniform[(x / 2 * n + y / 2) * n..][..n];
            let mut z = 0;
            for run in uniform.chunk_by(|a, b| a == b) {
                let end = z + 2 * run.len();
                match run[0] {
                    Some(byte) => bytes[z..end].fill(byte),
                    None => {
                        let sums = &mut sums[..end - z];
                        sums.fill((0.0, 0.0));
                        for view in &views {
                            view.column([x, y, z], end - z, |index, sample| {
                                if let Sample::Distance(distance) = sample {
                                    sums[index].0 += distance;
                                    sums[index].1 += 1.0;
                                }
                            });
                        }
                        let voxel = |&(sum, weight): &(f32, f32)| Voxel { distance: sum / weight, weight };
                        bytes[z..end].iter_mut().zip(sums.iter()).for_each(|(byte, sum)| *byte = voxel(sum).detail());
                    }
                }
                z = end;
            }
        }
        bytes
    }

    /// For each voxel the byte of [`Details`] that it and all those around it have, if they are all free, or all hidden or
    /// not measured.
    fn uniform(&self) -> Vec<Option<u8>> {
        // A bit for each kind of voxel in the neighbourhood.
        const FREE: u8 = 1;
        const HIDDEN: u8 = 2;
        const NEAR: u8 = 4;
        let kind = |voxel: &Voxel| match voxel.detail() {
            Details::FREE => FREE,
            0 => HIDDEN,
            _ => NEAR,
        };
        let mut kinds: Vec<u8> = self.voxels.iter().map(kind).collect();
        // Along z, y and x: with those of the layers before and behind.
        for layer in [1, self.resolution, self.resolution.pow(2)] {
            let own = kinds.clone();
            let block = layer * self.resolution;
            for (kinds, own) in kinds.chunks_exact_mut(block).zip(own.chunks_exact(block)) {
                let add = |kinds: &mut [u8], own: &[u8]| kinds.iter_mut().zip(own).for_each(|(a, b)| *a |= b);
                add(&mut kinds[layer..], own);
                add(kinds, &own[layer..]);
            }
        }
        let uniform = |kinds| match kinds {
            FREE => Some(Details::FREE),
            HIDDEN => Some(0),
            _ => None,
        };
        kinds.into_iter().map(uniform).collect()
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

    /// The byte of the voxel in [`Details`].
    fn detail(self) -> u8 {
        match self {
            _ if self.is_near_surface() => Details::near(self.distance),
            Self { distance, weight } if weight > 0.0 && distance > 0.0 => Details::FREE,
            _ => 0,
        }
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
    fn facing() -> Isometry3<f64> {
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
    fn a_view_without_measurements_gives_the_reason() {
        let camera = Intrinsics::BENCHMARK;
        let blind = |depth: f32, pose: Isometry3<f64>| {
            let depth = vec![depth; camera.width * camera.height];
            let image = DepthImage::new(camera, &depth).unwrap();
            let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
            (fusion.integrate(&image, &pose), fusion.no_measurement(&image, &pose).to_string())
        };
        let measured = blind(0.65, facing()).0;
        assert!((20_000..=64_000).contains(&measured), "{measured}");
        let nothing = |depth, pose, expected: &str| {
            let (measured, reason) = blind(depth, pose);
            assert!(measured == 0 && reason.contains(expected), "{measured}: {reason}");
        };
        nothing(0.65, facing().inverse(), "behind the camera; check that the pose is not inverted");
        nothing(0.65, Isometry3::translation(2.0, -0.15, 0.5), "its centre projects to pixel (2106, 240)");
        nothing(
            f32::NAN,
            facing(),
            "no pixel on the workspace has a depth between 0 and 2 m; the workspace centre is at a depth of 0.650 m",
        );
        nothing(2.6, facing(), "beyond 2 m: at least 2.600 m, 4.0 × the 0.650 m of the workspace centre");
        nothing(0.000_65, facing(), "in front of the workspace: at most 0.0007 m, its centre is at 0.650 m");
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
    fn details_have_half_the_voxels_and_know_free_space() {
        let camera = Intrinsics::BENCHMARK;
        let depth = vec![0.65; camera.width * camera.height];
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        let image = DepthImage::new(camera, &depth).unwrap();
        fusion.integrate(&image, &facing());
        let volume = fusion.detailed_volume(Isometry3::identity(), &[(image, facing())]).unwrap();
        let details = volume.details().unwrap();
        assert_eq!((details.resolution(), details.voxel_size()), (80, 0.00375));
        let at = |z: usize| details.bytes()[(40 * 80 + 40) * 80 + z];
        // The wall is at z = 0.15. The truncation distance is that of the volume, 30 mm: a voxel is 16 bytes.
        let near = |distance: f64| (127.5 + distance * 127.5 / 8.0).round() as i32;
        for (z, distance) in [(39, 0.5), (40, -0.5), (37, 2.5), (43, -3.5)] {
            assert!((i32::from(at(z)) - near(distance)).abs() <= 1, "{z}: {}", at(z));
        }
        assert_eq!((at(10), at(70)), (Details::FREE, 0), "free in front, hidden behind");
        // The middle of a larger volume has its details.
        let middle = volume.clone().middle(4).unwrap();
        assert_eq!(middle.details(), volume.details());
        assert_eq!(middle.alone().details(), None);
    }

    #[test]
    fn details_are_those_of_all_voxels() {
        let camera = Intrinsics::BENCHMARK;
        // A step of 0.1 m between two walls, and a part without measurements.
        let depth: Vec<f32> = (0..camera.width * camera.height)
            .map(|pixel| [0.58, 0.68, 0.0][(pixel % camera.width / 110).saturating_sub(2).min(2)])
            .collect();
        let image = DepthImage::new(camera, &depth).unwrap();
        let poses = [facing(), Isometry3::translation(-0.1, -0.17, 0.52)];
        let views = poses.map(|pose| (&image, pose));
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        let mut all = Fusion { truncation: fusion.truncation, ..Fusion::new(2 * RESOLUTION, WORKSPACE_SIZE) };
        for pose in &poses {
            fusion.integrate(&image, pose);
            all.integrate(&image, pose);
        }
        let volume = fusion.detailed_volume(Isometry3::identity(), &views).unwrap();
        let bytes = volume.details().unwrap().bytes();
        let differ = bytes.iter().zip(&all.voxels).filter(|(byte, voxel)| byte.abs_diff(voxel.detail()) > 1).count();
        assert!(differ < bytes.len() / 2000, "{differ} of {}", bytes.len());
        let near = bytes.iter().filter(|&&byte| byte != 0 && byte != Details::FREE).count();
        assert!(near > 50_000, "{near}");
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
