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
    let middle = Point3::new(0.15, 0.15, 0.08);
    let (polar, azimuth) = (polar.to_radians(), azimuth.to_radians());
    let direction = Vector3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
    let eye = middle + direction * 0.6;
    let up = Vector3::new(-polar.cos() * azimuth.cos(), -polar.cos() * azimuth.sin(), polar.sin());
    let axes = nalgebra::Matrix3::from_columns(&[up.cross(&direction), -up, -direction]);
    let rotation = UnitQuaternion::from_matrix(&axes);
    Isometry3::from_parts(Translation3::from(eye.coords), rotation).inverse()
}

/// The depth image of the camera: metres along its optical axis, 0 without a reading.
#[must_use]
pub fn depth(camera_from_task: &Isometry3<f64>) -> Vec<f32> {
    let task_from_camera = camera_from_task.inverse();
    let eye = task_from_camera * Point3::origin();
    let pixel = |index: usize| {
        let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
        let ray = task_from_camera * Vector3::new((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0);
        let table = (TABLE - eye.z) / ray.z;
        let mut span = (0.0_f64, f64::INFINITY);
        for axis in 0..3 {
            let [a, b] = [0, 1].map(|side| (BLOCK[side][axis] - eye[axis]) / ray[axis]);
            span = (span.0.max(a.min(b)), span.1.min(a.max(b)));
        }
        let block = if span.0 <= span.1 { span.0 } else { f64::INFINITY };
        let table = if table > 0.0 { table } else { f64::INFINITY };
        let nearest = block.min(table);
        if nearest.is_finite() { nearest as f32 } else { 0.0 }
    };
    (0..CAMERA.width * CAMERA.height).map(pixel).collect()
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
    }
}
