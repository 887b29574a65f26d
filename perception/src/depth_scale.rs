use grasp::DepthImage;
use nalgebra::{Isometry3, Matrix2, Point3, Vector2, Vector3};

/// Factors that are searched. The benchmark's noise has a standard deviation of 3.2 %, so the range covers three
/// standard deviations.
const RANGE: [f64; 2] = [0.9, 1.1];

/// Bins of the histogram over [`RANGE`]: 0.2 % each.
const BINS: usize = 100;

/// The histogram is summed over this many bins on either side: the noise of a camera spreads a plane over about 1 %.
const SPREAD: usize = 2;

/// The factor is the mean of the measured factors within this distance of it.
const NEAR: f64 = 0.01;

/// Points whose factor is this near to that of the table belong to the table, even if it is tilted.
const NEAR_PLANE: f64 = 0.025;

/// Share of the largest peak from which a smaller factor is preferred: nothing lies below the table, and the tops of
/// objects may cover more of the image.
const PREFERRED: f64 = 0.3;

/// Share of the rays to the table that must meet it, and their smallest number.
const SMALLEST_SHARE: f64 = 0.05;
const SMALLEST_COUNT: usize = 50;

/// How far beyond the workspace the table is searched for, metres: objects hide much of it inside the workspace.
const AROUND: f64 = 0.15;

/// About this many pixels of an image are used.
const PIXELS: usize = 20_000;

/// Whether to correct the scale of the depths of a request, so that the table is at its height.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DepthScale {
    /// Corrects each depth image whose table is level and at most 3 cm above or below its height. Without a table
    /// nothing is corrected.
    #[default]
    Auto,
    /// Corrects each depth image and point cloud whose table is within 10 % of its distance.
    Correct,
    /// Corrects nothing.
    Keep,
}

/// Smaller changes of the scale are not applied in [`DepthScale::Auto`]: 1.5 mm at 0.6 m, less than a measurement's
/// noise.
const NEGLIGIBLE: f64 = 0.0025;

/// Largest distance of the table from its height in [`DepthScale::Auto`], metres. A larger distance more likely means
/// that the table is at another height than the caller gave.
const LARGEST_SHIFT: f64 = 0.03;

/// Largest tilt of the table in [`DepthScale::Auto`], radians: 1.5°. A larger one is an error of the camera's pose or
/// of its intrinsics, and so is its height.
const LARGEST_TILT: f64 = 1.5 * std::f64::consts::PI / 180.0;

/// The [`image_depth_factor`] for [`DepthScale::Auto`]: 1 if the change is negligible, `None` if the error is not one
/// of scale.
#[must_use]
pub fn plausible_depth_factor(
    image: &DepthImage,
    camera_from_task: &Isometry3<f64>,
    table: f64,
    extent: [f64; 2],
) -> Option<f64> {
    let factor = image_depth_factor(image, camera_from_task, table, extent)?;
    if (factor - 1.0).abs() < NEGLIGIBLE {
        return Some(1.0);
    }
    let eye = Point3::from(camera_from_task.inverse().translation.vector);
    let is_near = measured_shift(factor, &eye, table).abs() <= LARGEST_SHIFT;
    let on_table = sampled(image, camera_from_task).filter(|point| {
        let at_factor = (table - eye.z) / (point.z - eye.z);
        is_around(&(eye + factor * (point - eye)), extent) && (at_factor - factor).abs() <= NEAR_PLANE
    });
    (is_near && tilt(on_table)? <= LARGEST_TILT).then_some(factor)
}

/// How far above its height the table was measured by a camera at `eye` whose depths need `factor`, metres.
#[must_use]
pub fn measured_shift(factor: f64, eye: &Point3<f64>, table: f64) -> f64 {
    (eye.z - table) * (1.0 - 1.0 / factor)
}

/// The angle between the z axis and the plane that fits points best along z, radians; `None` if the points lie on a
/// line.
fn tilt(points: impl Iterator<Item = Point3<f64>>) -> Option<f64> {
    let points: Vec<_> = points.collect();
    let mean = points.iter().map(|point| point.coords).sum::<Vector3<f64>>() / points.len() as f64;
    let (mut squares, mut products) = (Matrix2::zeros(), Vector2::zeros());
    for point in &points {
        let from_mean = point.coords - mean;
        squares += from_mean.xy() * from_mean.xy().transpose();
        products += from_mean.xy() * from_mean.z;
    }
    let slope = squares.try_inverse()? * products;
    Some(slope.norm().atan())
}

/// The [`depth_factor`] of an image. `camera_from_task` is `T_camera_task`; `table` and `extent` are as in that
/// function.
#[must_use]
pub fn image_depth_factor(
    image: &DepthImage,
    camera_from_task: &Isometry3<f64>,
    table: f64,
    extent: [f64; 2],
) -> Option<f64> {
    let eye = Point3::from(camera_from_task.inverse().translation.vector);
    depth_factor(sampled(image, camera_from_task), &eye, table, extent)
}

/// Points of an image in the task frame.
fn sampled(image: &DepthImage, camera_from_task: &Isometry3<f64>) -> impl Iterator<Item = Point3<f64>> {
    // Odd, so that the samples are spread over all columns.
    let every = (image.depth().len() / PIXELS) | 1;
    image.points_of_every(every, camera_from_task).map(|point| point.position)
}

/// Whether a point is in or around the workspace.
fn is_around(point: &Point3<f64>, extent: [f64; 2]) -> bool {
    [point.x, point.y].into_iter().zip(extent).all(|(at, length)| (-AROUND..=length + AROUND).contains(&at))
}

/// The factor by which the distances that a camera has measured must be multiplied, so that the table is at its height;
/// `None` if no table is seen within 10 % of its distance.
///
/// `points` are the measured points and `eye` the camera, in the task frame, metres. The table is the plane
/// z = `table`, over the rectangle from the origin to `extent` and 0.15 m around it.
#[must_use]
pub fn depth_factor(
    points: impl Iterator<Item = Point3<f64>>,
    eye: &Point3<f64>,
    table: f64,
    extent: [f64; 2],
) -> Option<f64> {
    let factors = points.filter_map(|point| {
        let ray = point - eye;
        let factor = (table - eye.z) / ray.z;
        // Written so that NaN fails.
        (factor > 0.0 && is_around(&(eye + factor * ray), extent)).then_some(factor)
    });
    let factors: Vec<f64> = factors.collect();
    let mut factor = lowest_peak(&factors)?;
    // Mean shift: the mean of the values near it moves to where they are densest.
    for _ in 0..5 {
        let near = factors.iter().filter(|value| (*value - factor).abs() <= NEAR);
        let (sum, count) = near.fold((0.0, 0), |(sum, count), value| (sum + value, count + 1));
        if count < SMALLEST_COUNT || (count as f64) < SMALLEST_SHARE * factors.len() as f64 {
            return None;
        }
        factor = sum / count as f64;
    }
    Some(factor)
}

/// The smallest factor at which many rays agree.
fn lowest_peak(factors: &[f64]) -> Option<f64> {
    let [low, high] = RANGE;
    let width = (high - low) / BINS as f64;
    let mut bins = [0_usize; BINS];
    for factor in factors.iter().filter(|factor| (low..high).contains(*factor)) {
        // The last bin contains values that rounding would put above it.
        bins[(((factor - low) / width) as usize).min(BINS - 1)] += 1;
    }
    let around = |bin: usize| bin.saturating_sub(SPREAD)..(bin + SPREAD + 1).min(BINS);
    let sums: Vec<usize> = (0..BINS).map(|bin| bins[around(bin)].iter().sum()).collect();
    let largest = *sums.iter().max().filter(|count| **count > 0)?;
    let is_peak = |bin: &usize| {
        let highest = sums[around(*bin)].iter().max();
        highest == Some(&sums[*bin]) && sums[*bin] as f64 >= PREFERRED * largest as f64
    };
    let peak = (0..BINS).find(is_peak)?;
    Some(low + (peak as f64 + 0.5) * width)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    const EYE: Point3<f64> = Point3::new(0.15, -0.37, 0.4);
    const EXTENT: [f64; 2] = [0.3; 2];

    /// What a camera at [`EYE`] sees of a table at z = `table` with a box of `size` on it, with its distances divided
    /// by `factor` and a noise of about `noise` metres on them.
    fn seen(table: f64, size: Vector3<f64>, factor: f64, noise: f64) -> Vec<Point3<f64>> {
        let at = |i: i32, n: i32| f64::from(i) / f64::from(n);
        let targets = (0..120 * 120).map(|i| Point3::new(at(i / 120, 120), at(i % 120, 120), table));
        let targets = targets.map(|p| Point3::new(1.2 * p.x - 0.45, 1.2 * p.y - 0.45, p.z));
        targets
            .enumerate()
            .map(|(i, target)| {
                let ray = target - EYE;
                // The nearest of the table, the top and the front of the box.
                let top = (table + size.z - EYE.z) / ray.z;
                let front = (0.15 - size.y / 2.0 - EYE.y) / ray.y;
                let is_on = |t: f64| {
                    let p = EYE + t * ray;
                    let within = |at: f64, length: f64| (at - 0.15).abs() <= length / 2.0 + 1e-9;
                    t > 0.0
                        && within(p.x, size.x)
                        && within(p.y, size.y)
                        && (-1e-9..=size.z + 1e-9).contains(&(p.z - table))
                };
                let t = [top, front].into_iter().filter(|t| is_on(*t)).fold(1.0, f64::min);
                // Deterministic noise: sines of the index, whose sum is about normally distributed.
                let sines = [12.9898, 78.233, 37.719].map(|frequency: f64| (frequency * i as f64).sin());
                let t = t / factor + noise * sines.iter().sum::<f64>() / ray.norm();
                EYE + t * ray
            })
            .collect()
    }

    fn found(points: &[Point3<f64>]) -> Option<f64> {
        depth_factor(points.iter().copied(), &EYE, 0.05, EXTENT)
    }

    #[test]
    fn the_factor_of_the_distances_is_found() {
        let block = Vector3::new(0.1, 0.08, 0.12);
        for factor in [0.92, 0.97, 1.0, 1.02, 1.08] {
            for (noise, tolerance) in [(0.0, 5e-4), (0.004, 2e-3)] {
                let found = found(&seen(0.05, block, factor, noise)).unwrap();
                assert!((found - factor).abs() < tolerance, "{factor}, noise {noise}: {found}");
            }
        }
    }

    #[test]
    fn the_top_of_a_flat_box_is_not_taken_for_the_table() {
        // The box covers more of the image than the table around it.
        let tray = Vector3::new(0.5, 0.5, 0.025);
        let factor = found(&seen(0.05, tray, 1.03, 0.001)).unwrap();
        assert!((factor - 1.03).abs() < 2e-3, "{factor}");
    }

    #[test]
    fn without_a_table_at_about_its_height_there_is_no_factor() {
        let block = Vector3::new(0.1, 0.08, 0.12);
        assert_eq!(found(&seen(-0.3, block, 1.0, 0.0)), None, "the floor");
        assert_eq!(found(&[]), None);
        assert_eq!(found(&[Point3::new(f64::NAN, 0.1, 0.05), EYE, EYE + Vector3::x()]), None);
    }

    #[test]
    fn the_tilt_of_a_plane_is_measured() {
        let level = (0..400).map(|i| Point3::new(f64::from(i % 20) * 0.03, f64::from(i / 20) * 0.03, 0.05));
        let tilted = |degrees: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), degrees.to_radians());
            tilt(level.clone().map(move |point| turn * point)).unwrap().to_degrees()
        };
        assert!(tilted(0.0) < 1e-6 && (tilted(2.0) - 2.0).abs() < 1e-6);
        assert_eq!(tilt(level.take(2)), None);
    }
}
