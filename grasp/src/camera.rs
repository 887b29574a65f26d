use std::borrow::Cow;

use nalgebra::{Isometry3, Point3};
use thiserror::Error;

use crate::{DEPTH_MAX, SurfacePoint};

/// Intrinsics of a pinhole camera, in pixels; pixel centres are at whole numbers. Optical axes: z forward, x right, y
/// down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point along u, pixels.
    pub cx: f64,
    /// Principal point along v, pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// The camera of the benchmark: 640×480 pixels, focal length 540 pixels.
    pub const BENCHMARK: Self = Self { width: 640, height: 480, fx: 540.0, fy: 540.0, cx: 320.0, cy: 240.0 };
}

/// A depth image that fits its intrinsics: metres along the optical axis, row by row; 0, negative or NaN where there is no
/// measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthImage<'a> {
    intrinsics: Intrinsics,
    depth: Cow<'a, [f32]>,
}

/// The probable unit of a depth image, judged by its median.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Metres, or no valid pixel.
    Metres,
    /// The median is from 100 to 10,000: beyond the range of depth cameras, so probably millimetres.
    Millimetres,
    /// The median is another number above 20.
    Far,
    /// The median is below 0.02: closer than depth cameras measure, so probably metres divided by 1000.
    Thousandths,
}

/// Why a depth image is invalid.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CameraError {
    /// The number of pixels does not fit the intrinsics.
    #[error("depth has {got} pixels, {width}×{height} needs {expected}")]
    Length {
        /// Number of pixels received.
        got: usize,
        /// Number of pixels required.
        expected: usize,
        /// Image width.
        width: usize,
        /// Image height.
        height: usize,
    },
    /// A focal length is not positive or a number is not finite.
    #[error("{name} is {value}, must be a finite number of pixels{bound}", bound = if *.positive { " above 0" } else { "" })]
    Intrinsics {
        /// Name of the intrinsic.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Whether it must be positive.
        positive: bool,
    },
}

impl<'a> DepthImage<'a> {
    /// Checks that the image fits the intrinsics.
    ///
    /// # Errors
    /// [`CameraError`] names the invalid value.
    pub fn new(intrinsics: Intrinsics, depth: impl Into<Cow<'a, [f32]>>) -> Result<Self, CameraError> {
        let depth = depth.into();
        let Intrinsics { width, height, fx, fy, cx, cy } = intrinsics;
        for (name, value, positive) in [("fx", fx, true), ("fy", fy, true), ("cx", cx, false), ("cy", cy, false)] {
            if !value.is_finite() || (positive && value <= 0.0) {
                return Err(CameraError::Intrinsics { name, value, positive });
            }
        }
        let expected = width * height;
        if depth.len() != expected || expected == 0 {
            return Err(CameraError::Length { got: depth.len(), expected, width, height });
        }
        Ok(Self { intrinsics, depth })
    }

    /// The camera's intrinsics.
    #[must_use]
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The pixels, row by row.
    #[must_use]
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Multiplies the depths by a factor.
    pub fn scale(&mut self, factor: f64) {
        self.depth.to_mut().iter_mut().for_each(|depth| *depth *= factor as f32);
    }

    /// The probable unit of the image, from the median of the valid pixels.
    #[must_use]
    pub fn unit(&self) -> Unit {
        /// Step between sampled pixels. More samples would not change the result.
        const EVERY: usize = 61;
        let mut sample: Vec<f32> =
            self.depth.iter().step_by(EVERY).copied().filter(|depth| depth.is_finite() && *depth > 0.0).collect();
        if sample.is_empty() {
            return Unit::Metres;
        }
        let (middle, count) = (sample.len() / 2, sample.len());
        // Beyond 20 m, some renderers have pixels without a surface; then others are nearer.
        let is_far = sample.iter().filter(|depth| **depth <= 20.0).count() * 20 < count;
        match sample.select_nth_unstable_by(middle, f32::total_cmp).1 {
            median if (100.0..=10_000.0).contains(median) && is_far => Unit::Millimetres,
            median if *median > 20.0 && is_far => Unit::Far,
            median if *median < 0.02 => Unit::Thousandths,
            _ => Unit::Metres,
        }
    }

    /// The point that a pixel shows, in the camera frame, metres; `None` outside the image or without a depth of at most
    /// [`DEPTH_MAX`].
    #[must_use]
    pub fn point(&self, u: usize, v: usize) -> Option<Point3<f64>> {
        let Intrinsics { width, height, fx, fy, cx, cy } = self.intrinsics;
        let depth = (u < width && v < height).then(|| self.depth[v * width + u])?;
        let z = (f32::MIN_POSITIVE..=DEPTH_MAX).contains(&depth).then_some(f64::from(depth))?;
        Some(Point3::new((u as f64 - cx) / fx * z, (v as f64 - cy) / fy * z, z))
    }

    /// Back-projects every pixel with a depth of at most [`DEPTH_MAX`] to a point of the task frame. The normal is the
    /// direction towards the camera. `camera_from_task` is `T_camera_task`.
    pub fn points(&self, camera_from_task: &Isometry3<f64>) -> impl Iterator<Item = SurfacePoint> {
        self.points_of_every(1, camera_from_task)
    }

    /// As [`points`](Self::points), of one in `every` pixels.
    pub fn points_of_every(
        &self,
        every: usize,
        camera_from_task: &Isometry3<f64>,
    ) -> impl Iterator<Item = SurfacePoint> {
        let Intrinsics { width, fx, fy, cx, cy, .. } = self.intrinsics;
        let task_from_camera = camera_from_task.inverse();
        let eye = Point3::from(task_from_camera.translation.vector);
        let pixels = self.depth.iter().enumerate().step_by(every);
        pixels.filter(|(_, depth)| (f32::MIN_POSITIVE..=DEPTH_MAX).contains(*depth)).map(move |(pixel, &depth)| {
            let (u, v, z) = ((pixel % width) as f64, (pixel / width) as f64, f64::from(depth));
            let position = task_from_camera * Point3::new((u - cx) / fx * z, (v - cy) / fy * z, z);
            SurfacePoint { position, normal: (eye - position).normalize() }
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn the_unit_is_judged_by_the_median() {
        let intrinsics = Intrinsics::BENCHMARK;
        let unit = |depth: f32| {
            let pixels: Vec<f32> = (0..640 * 480).map(|i| if i % 3 == 0 { f32::NAN } else { depth }).collect();
            DepthImage::new(intrinsics, &pixels).unwrap().unit()
        };
        assert_eq!([0.3, 2.0, 0.05].map(unit), [Unit::Metres; 3]);
        assert_eq!([350.0, 1800.0].map(unit), [Unit::Millimetres; 2]);
        assert_eq!([60.0, 600_000.0].map(unit), [Unit::Far; 2]);
        assert_eq!([0.0006, 0.002].map(unit), [Unit::Thousandths; 2]);
        assert_eq!(unit(0.0), Unit::Metres, "an image without measurements counts as metres");
    }

    #[test]
    fn pixels_are_back_projected() {
        let intrinsics = Intrinsics { width: 3, height: 2, fx: 2.0, fy: 2.0, cx: 1.0, cy: 0.0 };
        let depth = [0.0, f32::NAN, 0.5, -1.0, 1.0, 2.5];
        // The camera is at (1, 0, 0) of the task frame, with parallel axes.
        let camera_from_task = Isometry3::translation(-1.0, 0.0, 0.0);
        let image = DepthImage::new(intrinsics, &depth).unwrap();
        let points: Vec<SurfacePoint> = image.points(&camera_from_task).collect();
        let positions: Vec<_> = points.iter().map(|point| point.position).collect();
        assert_eq!(
            positions,
            [Point3::new(1.25, 0.0, 0.5), Point3::new(1.0, 0.5, 1.0)],
            "pixels without depth are skipped"
        );
        assert!(
            (points[1].normal - Vector3::new(0.0, -0.5, -1.0).normalize()).norm() < 1e-12,
            "the normal points to the camera"
        );
    }
}
