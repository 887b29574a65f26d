use grasp::{DepthImage, Intrinsics};
use nalgebra::{Isometry3, Point3, Rotation3, UnitQuaternion, Vector3};

use crate::View;

/// Smallest and largest edge of the image, pixels.
const SIZES: [usize; 2] = [48, 320];

/// Points of one pixel whose depths differ by more than this belong to different surfaces, metres.
const LAYER: f32 = 0.01;

/// An overview shows this share of the points. The others, such as a few points on the horizon, would make the rest
/// small.
const NEARLY_ALL: f64 = 0.97;

/// Range of the tangent of half the angle of view of an overview.
const TANGENTS: [f64; 2] = [0.05, 2.0];

/// Cosine of the largest angle between the z axis of the frame of a camera and the direction of its points.
const MOSTLY_ALONG: f64 = 0.7;

/// An empty pixel is filled if at least this many of its eight neighbours have depth.
const FILLED_BY: usize = 5;

/// Renders a depth image of points as a camera at `eye` sees them. Points and eye are in the task frame; the image
/// covers the workspace, a cube with an edge of `size` metres at the origin of this frame.
///
/// The image resolution follows the number of points. The depth of a pixel is the mean of its nearest points; single
/// empty pixels are filled. Returns `None` if the eye is inside the bounding sphere of the workspace or no point is in
/// view.
#[must_use]
pub fn seen_from(points: &[Point3<f64>], eye: &Point3<f64>, size: f64) -> Option<View> {
    let centre = Point3::from([size / 2.0; 3]);
    let radius = 3.0_f64.sqrt() / 2.0 * size;
    let distance = (centre - eye).norm();
    if !distance.is_finite() || distance <= radius {
        return None;
    }
    // The frustum encloses the bounding sphere of the cube: its half angle has sine radius / distance.
    let tangent = radius / (distance * distance - radius * radius).sqrt();
    render(points, look_at(eye, &centre), tangent)
}

/// Renders a depth image of nearly all points as a camera at `eye` sees them; `camera_from_task` of the view maps the
/// frame of the points into that of this camera. If the points lie along the z axis of their frame, as in a camera
/// frame, the x axis points to the right in the image; otherwise the z axis points up. Returns `None` if no point is in
/// view.
#[must_use]
pub fn overview(points: &[Point3<f64>], eye: &Point3<f64>) -> Option<View> {
    let middle = Point3::from([0, 1, 2].map(|axis| quantile(points.iter().map(|point| point[axis]), 0.5)));
    let forward = (middle - eye).try_normalize(1e-6)?;
    let up = if forward.z > MOSTLY_ALONG { -Vector3::y() } else { upwards(&forward) };
    let camera_from_frame = look_along(eye, &forward, &up);
    let in_front = points.iter().map(|point| camera_from_frame * point).filter(|p| p.z > 0.0);
    let tangent = quantile(in_front.map(|p| p.x.abs().max(p.y.abs()) / p.z), NEARLY_ALL);
    render(points, camera_from_frame, tangent.clamp(TANGENTS[0], TANGENTS[1]))
}

/// Renders the points that a camera with a square image sees. `tangent` is that of half its angle of view.
fn render(points: &[Point3<f64>], camera_from_task: Isometry3<f64>, tangent: f64) -> Option<View> {
    let projected = points.iter().filter_map(|point| {
        let p = camera_from_task * point;
        let (x, y) = (p.x / p.z / tangent, p.y / p.z / tangent);
        (p.z > 0.0 && x.abs() < 1.0 && y.abs() < 1.0).then_some((x, y, p.z as f32))
    });
    let projected: Vec<(f64, f64, f32)> = projected.collect();
    if projected.is_empty() {
        return None;
    }
    // About one point per pixel if the points cover the image.
    let edge = ((projected.len() as f64).sqrt() as usize).clamp(SIZES[0], SIZES[1]);
    let half = edge as f64 / 2.0;
    // Pixel centres are at whole numbers: the image spans -0.5 to edge - 0.5.
    let middle = half - 0.5;
    let intrinsics =
        Intrinsics { width: edge, height: edge, fx: half / tangent, fy: half / tangent, cx: middle, cy: middle };
    let pixel = |coordinate: f64| ((coordinate + 1.0) * half) as usize;

    let mut nearest = vec![f32::INFINITY; edge * edge];
    let index = |x: f64, y: f64| pixel(y).min(edge - 1) * edge + pixel(x).min(edge - 1);
    for &(x, y, z) in &projected {
        let nearest = &mut nearest[index(x, y)];
        *nearest = nearest.min(z);
    }
    // On a slanted surface the nearest point alone is biased by half a pixel towards the camera.
    let mut sums = vec![(0.0_f32, 0.0_f32); edge * edge];
    for &(x, y, z) in &projected {
        let index = index(x, y);
        if z <= nearest[index] + LAYER {
            sums[index].0 += z;
            sums[index].1 += 1.0;
        }
    }
    let depth: Vec<f32> = sums.iter().map(|&(sum, count)| if count > 0.0 { sum / count } else { 0.0 }).collect();
    let image = DepthImage::new(intrinsics, filled(&depth, edge)).ok()?;
    Some(View { image, camera_from_task, labels: None })
}

/// The quantile `share` of the values; 0 if there are none.
fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let index = (share * values.len() as f64) as usize;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(index, f64::total_cmp).1 }
}

/// Fills pixels without depth with the median of their neighbours, if enough of these have depth.
fn filled(depth: &[f32], edge: usize) -> Vec<f32> {
    let fill = |index: usize| {
        if depth[index] > 0.0 {
            return depth[index];
        }
        let (row, column) = (index / edge, index % edge);
        let rows = row.saturating_sub(1)..(row + 2).min(edge);
        let around = rows.flat_map(|row| {
            (column.saturating_sub(1)..(column + 2).min(edge)).map(move |column| depth[row * edge + column])
        });
        let mut around: Vec<f32> = around.filter(|&depth| depth > 0.0).collect();
        if around.len() < FILLED_BY {
            return 0.0;
        }
        let middle = around.len() / 2;
        *around.select_nth_unstable_by(middle, f32::total_cmp).1
    };
    (0..depth.len()).map(fill).collect()
}

/// `T_camera_task` of a camera at `eye` that looks at `target`.
fn look_at(eye: &Point3<f64>, target: &Point3<f64>) -> Isometry3<f64> {
    let forward = (target - eye).normalize();
    look_along(eye, &forward, &upwards(&forward))
}

/// The z axis, or for a vertical camera the x axis.
fn upwards(forward: &Vector3<f64>) -> Vector3<f64> {
    if forward.z.abs() > 0.99 { Vector3::x() } else { Vector3::z() }
}

/// `T_camera_frame` of a camera at `eye`. `up` points up in its image. Optical axes: z forward, x right, y down.
fn look_along(eye: &Point3<f64>, forward: &Vector3<f64>, up: &Vector3<f64>) -> Isometry3<f64> {
    // The rows of the rotation are the camera axes in the frame.
    let rotation = Rotation3::look_at_lh(forward, &-up);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Isometry3::from_parts((rotation * -eye.coords).into(), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use grasp::{Fusion, RESOLUTION, WORKSPACE_SIZE};

    /// A plane at z = 0.1 with a block of 0.1 m on it, seen from above, one point every `step` metres.
    fn scene(step: f64) -> Vec<Point3<f64>> {
        let n = (0.3 / step) as usize;
        let height = |x: f64, y: f64| if (0.1..0.2).contains(&x) && (0.1..0.2).contains(&y) { 0.2 } else { 0.1 };
        (0..n * n)
            .map(|i| {
                let (x, y) = ((i / n) as f64 * step, (i % n) as f64 * step);
                Point3::new(x, y, height(x, y))
            })
            .collect()
    }

    #[test]
    fn the_camera_looks_at_its_target() {
        for eye in [Point3::new(0.15, -0.5, 0.4), Point3::new(0.15, 0.15, 0.9), Point3::new(-0.4, 0.6, 0.15)] {
            let pose = look_at(&eye, &Point3::new(0.15, 0.15, 0.15));
            assert!((pose * eye).coords.norm() < 1e-12);
            let target = pose * Point3::new(0.15, 0.15, 0.15);
            assert!(target.x.abs() < 1e-9 && target.y.abs() < 1e-9 && target.z > 0.4, "{target}");
            let above = pose * Point3::new(0.15, 0.15, 0.2);
            assert!(above.y <= 1e-9, "higher points have smaller image y");
        }
    }

    #[test]
    fn a_cloud_is_fused_into_the_volume_of_its_surface() {
        for step in [0.001, 0.004] {
            let view = seen_from(&scene(step), &Point3::new(0.15, -0.2, 0.7), WORKSPACE_SIZE).unwrap();
            let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
            fusion.integrate(&view.image, &view.camera_from_task);
            let surface = fusion.surface();
            let on = |height: f64| surface.iter().filter(|point| (point.position.z - height).abs() < 0.002).count();
            assert!(on(0.1) > 500 && on(0.2) > 80, "{} and {} points with {step} m between", on(0.1), on(0.2));
            // Between the two heights the surface may only be at the sides of the block.
            let astray = surface.iter().filter(|point| {
                let (p, side) = (point.position, |c: f64| (c - 0.1).abs() < 0.012 || (c - 0.2).abs() < 0.012);
                (0.104..0.196).contains(&p.z) && !side(p.x) && !side(p.y)
            });
            assert_eq!(astray.count(), 0);
        }
    }

    #[test]
    fn without_points_in_view_there_is_no_image() {
        let eye = Point3::new(0.15, -0.5, 0.4);
        assert!(seen_from(&[], &eye, WORKSPACE_SIZE).is_none());
        assert!(seen_from(&[Point3::new(0.15, -5.0, 0.4)], &eye, WORKSPACE_SIZE).is_none(), "behind the camera");
        assert!(seen_from(&scene(0.01), &Point3::new(0.15, 0.15, 0.25), WORKSPACE_SIZE).is_none(), "too close");
        assert!(seen_from(&scene(0.01), &Point3::new(f64::NAN, 0.0, 0.0), WORKSPACE_SIZE).is_none());
    }
}
