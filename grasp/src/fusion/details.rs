//! What the fused views show in voxels of half the size.

use std::borrow::Borrow;

use nalgebra::Isometry3;
use rayon::prelude::*;

use super::{Fusion, Voxel};
use crate::measurement::{Measurement, Sample};
use crate::{DepthImage, Details, Volume, VolumeError};

impl Fusion {
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
        let write_column = |sums: &mut Vec<(f32, f32)>, (row, bytes): (usize, &mut [u8])| {
            let (x, y) = (row / fine, row % fine);
            let uniform = &uniform[(x / 2 * n + y / 2) * n..][..n];
            let mut z = 0;
            for run in uniform.chunk_by(|a, b| a == b) {
                let end = z + 2 * run.len();
                match run[0] {
                    Some(byte) => bytes[z..end].fill(byte),
                    None => {
                        sums.clear();
                        sums.resize(end - z, (0.0, 0.0));
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
        };
        bytes.par_chunks_exact_mut(fine).enumerate().for_each_init(Vec::new, write_column);
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
}

impl Voxel {
    /// The byte of the voxel in [`Details`].
    fn detail(self) -> u8 {
        match self {
            _ if self.is_near_surface() => Details::near(self.distance),
            Self { distance, weight } if weight > 0.0 && distance > 0.0 => Details::FREE,
            _ => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::facing;
    use super::*;
    use crate::{Intrinsics, RESOLUTION, WORKSPACE_SIZE};

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
}
