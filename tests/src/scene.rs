//! A synthetic scene: a block on a table, and its depth images.

use grasp::Intrinsics;
use grasp_client::{Depth, DepthView, Extrinsics};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// Height of the table, metres.
pub const TABLE: f64 = 0.05;

/// The intrinsics of the camera, with small images for speed.
pub const CAMERA: Intrinsics = Intrinsics { width: 160, height: 120, fx: 135.0, fy: 135.0, cx: 79.5, cy: 59.5 };

/// A block that stands on the table in the middle of the workspace: the corners of its box, metres.
pub const BLOCK: [[f64; 3]; 2] = [[0.13, 0.11, TABLE], [0.17, 0.19, 0.15]];

/// `T_camera_task` of a camera that looks at the middle of the workspace from 0.6 m. `polar` is the angle from the
/// vertical, `azimuth` that about it, degrees.
#[must_use]
pub fn camera(polar: f64, azimuth: f64) -> Isometry3<f64> {
    camera_at(Point3::new(0.15, 0.15, 0.08), 0.6, polar, azimuth)
}

/// `T_camera_task` of a camera that looks at `middle` from `distance` metres.
#[must_use]
pub fn camera_at(middle: Point3<f64>, distance: f64, polar: f64, azimuth: f64) -> Isometry3<f64> {
    let (polar, azimuth) = (polar.to_radians(), azimuth.to_radians());
    let direction = Vector3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
    let eye = middle + direction * distance;
    let up = Vector3::new(-polar.cos() * azimuth.cos(), -polar.cos() * azimuth.sin(), polar.sin());
    let axes = nalgebra::Matrix3::from_columns(&[up.cross(&direction), -up, -direction]);
    let rotation = UnitQuaternion::from_matrix(&axes);
    Isometry3::from_parts(Translation3::from(eye.coords), rotation).inverse()
}

/// The depth image of the camera: metres along its optical axis, 0 without a reading.
#[must_use]
pub fn depth(camera_from_task: &Isometry3<f64>) -> Vec<f32> {
    seen(&[BLOCK], &CAMERA, camera_from_task).into_iter().map(|(depth, _)| depth).collect()
}

/// What each pixel of a camera shows of a table with boxes: the depth in metres, 0 without a reading, and the number of
/// the box, counted from 1; 0 for the table.
#[must_use]
pub fn seen(boxes: &[[[f64; 3]; 2]], camera: &Intrinsics, camera_from_task: &Isometry3<f64>) -> Vec<(f32, u16)> {
    let task_from_camera = camera_from_task.inverse();
    let eye = task_from_camera * Point3::origin();
    let pixel = |index: usize| {
        let (u, v) = ((index % camera.width) as f64, (index / camera.width) as f64);
        let ray = task_from_camera * Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
        let distance = |corners: &[[f64; 3]; 2]| {
            let mut span = (0.0_f64, f64::INFINITY);
            for axis in 0..3 {
                let [a, b] = [0, 1].map(|side| (corners[side][axis] - eye[axis]) / ray[axis]);
                span = (span.0.max(a.min(b)), span.1.min(a.max(b)));
            }
            (span.0 <= span.1).then_some(span.0)
        };
        let table = Some((TABLE - eye.z) / ray.z).filter(|table| *table > 0.0).map(|table| (table, 0));
        let boxes = boxes.iter().zip(1..).filter_map(|(corners, number)| Some((distance(corners)?, number)));
        let nearest = boxes.chain(table).min_by(|(a, _), (b, _)| a.total_cmp(b));
        nearest.map_or((0.0, 0), |(distance, number)| (distance as f32, number))
    };
    (0..camera.width * camera.height).map(pixel).collect()
}

/// The view of a table with boxes as a client sends it, with the numbers of the boxes as labels.
#[must_use]
pub fn labelled(boxes: &[[[f64; 3]; 2]], camera_from_task: &Isometry3<f64>) -> DepthView {
    let (depth, labels) = seen(boxes, &CAMERA, camera_from_task).into_iter().unzip();
    DepthView { depth: Depth::Metres(depth), labels: Some(labels), ..view(camera_from_task) }
}

/// The depth image as a client sends it.
#[must_use]
pub fn view(camera_from_task: &Isometry3<f64>) -> DepthView {
    let Intrinsics { width, height, fx, fy, cx, cy } = CAMERA;
    DepthView {
        depth: Depth::Metres(depth(camera_from_task)),
        width: width as u32,
        height: height as u32,
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        extrinsics: Extrinsics::CameraFromTask(*camera_from_task),
        labels: None,
    }
}
