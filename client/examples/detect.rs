//! Detects grasps in one depth image: `cargo run --package grasp-client --example detect -- 127.0.0.1:50051`. The
//! examples in `client/python/examples` and `client/cpp` send the same request and print the same grasps.

use std::time::Duration;

use grasp_client::{Access, Client, Depth, DepthView, DetectOptions, Error, Extrinsics, Options, Retry, Workspace, pb};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

const WIDTH: u32 = 160;
const HEIGHT: u32 = 120;
/// Intrinsic matrix, pixels.
const K: [f64; 9] = [135.0, 0.0, 79.5, 0.0, 135.0, 59.5, 0.0, 0.0, 1.0];

#[tokio::main]
async fn main() -> Result<(), Error> {
    let server = std::env::args().nth(1).unwrap_or_else(|| "127.0.0.1:50051".to_owned());
    let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
    let client = Client::connect_with(server, access).await?;

    let view = DepthView {
        depth: Depth::Metres(synthetic_image()),
        width: WIDTH,
        height: HEIGHT,
        k: K,
        extrinsics: Extrinsics::FrameFromCamera(camera_pose()),
        labels: None,
    };
    // The workspace: a cube of 0.3 m with the axes of the robot's base.
    let workspace = Workspace::default();
    let detect = DetectOptions {
        max_grasps: 5,
        // Grasps from above, at most 1 rad from the vertical, without collision of the open hand.
        approach: Some(pb::Cone { axis: Some(pb::Vector3 { x: 0.0, y: 0.0, z: -1.0 }), angle: 1.0 }),
        collision: Some(pb::CollisionCheck {
            mode: Some(pb::collision_check::Mode::Filter.into()),
            ..pb::CollisionCheck::default()
        }),
        ..DetectOptions::default()
    };
    let options =
        Options { detect, frame_id: "base".to_owned(), timeout: Some(Duration::from_secs(2)), ..Options::default() };
    let found = client.detect_from_depth(&[view], &workspace, options).await?;

    println!("{} {}: grasps in {}: {}", found.model, found.version, found.frame_id, found.grasps.len());
    for grasp in &found.grasps {
        let (at, turned, from) =
            (grasp.pose.translation.vector, grasp.pose.rotation.coords, grasp.pregrasp.translation.vector);
        println!(
            "quality {:.3} width {:.3} at {:.3} {:.3} {:.3} turned {:.3} {:.3} {:.3} {:.3} from {:.3} {:.3} {:.3}",
            grasp.quality,
            grasp.width,
            at.x,
            at.y,
            at.z,
            turned.x,
            turned.y,
            turned.z,
            turned.w,
            from.x,
            from.y,
            from.z
        );
    }
    Ok(())
}

/// The camera in the robot's base: 30° from the vertical.
fn camera_pose() -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(-0.258_819, 0.965_925_8, 0.0, 0.0));
    Isometry3::from_parts(Translation3::new(0.15, -0.15, 0.6), rotation)
}

/// What that camera sees, metres: a block of 4 × 8 × 10 cm in the middle of the workspace, on a table at z = 0.05 m.
fn synthetic_image() -> Vec<f32> {
    let (eye, low, high) = (Vector3::new(0.15, -0.15, 0.6), [0.13, 0.11, 0.05], [0.17, 0.19, 0.15]);
    let (sine, cosine) = (0.5, 0.75_f64.sqrt());
    let depth = |index: u32| {
        let (u, v) = (f64::from(index % WIDTH), f64::from(index / WIDTH));
        let (x, y) = ((u - 79.5) / 135.0, (v - 59.5) / 135.0);
        let ray = [x, sine - cosine * y, -cosine - sine * y];
        let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
        for axis in 0..3 {
            let (a, b) = ((low[axis] - eye[axis]) / ray[axis], (high[axis] - eye[axis]) / ray[axis]);
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        (if enter <= leave { enter } else { (low[2] - eye[2]) / ray[2] }) as f32
    };
    (0..WIDTH * HEIGHT).map(depth).collect()
}
