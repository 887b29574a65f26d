//! Why a view measures nothing.

use nalgebra::{Isometry3, Point3};
use thiserror::Error;

use super::{DEPTH_MAX, Fusion};
use crate::DepthImage;

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
}

#[cfg(test)]
mod tests {
    use super::super::tests::facing;
    use super::*;
    use crate::{Intrinsics, RESOLUTION, WORKSPACE_SIZE};

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
}
