//! `grasp table`: finds the table in a depth image, without a server.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use grasp::{DepthImage, Tabletop};
use grasp_client::{Extrinsics, Workspace};
use grasp_proto::TABLE_HEIGHT;
use nalgebra::{Isometry3, Unit, Vector3};
use serde_json::{Value, json};

use crate::files::in_file;
use crate::numbers::Numbers;
use crate::overlay::Overlay;
use crate::scene::{depth_view, metres};
use crate::{image, pose, show};

#[derive(Args)]
pub(crate) struct Table {
    /// Depth image: 16-bit PNG or u16 .npy, or f32 .npy in metres.
    image: PathBuf,

    /// Intrinsic matrix of the camera: 3×3 .npy, JSON or YAML of ROS's CameraInfo, JSON of Open3D or of RealSense, or
    /// the numbers FX,FY,CX,CY.
    #[arg(long, value_name = "FILE|NUMBERS")]
    intrinsics: String,

    /// Unit of integer depths, metres.
    #[arg(long, value_name = "METRES", default_value_t = image::MILLIMETRE)]
    depth_scale: f32,

    /// Direction of gravity in the camera frame (z forward, x right, y down): the reversed reading of an accelerometer
    /// at rest. Without it a wall that fills the image is taken for a table.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    gravity: Option<Numbers<3>>,

    /// Height of the table above the bottom of the workspace, metres.
    #[arg(long, value_name = "METRES", default_value_t = TABLE_HEIGHT)]
    table_height: f64,

    /// Write the pose of the workspace in the camera frame to this file: JSON, for `--workspace` of the other commands.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,

    /// Draw the workspace and the table over the depth image: PNG.
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
}

impl Table {
    pub fn run(&self, as_json: bool) -> anyhow::Result<()> {
        let k = pose::intrinsics(&self.intrinsics)?;
        let (depth, width, height) = image::read(&self.image, self.depth_scale)?;
        let view = grasp_client::DepthView {
            depth,
            width,
            height,
            k,
            extrinsics: Extrinsics::FrameFromCamera(Isometry3::identity()),
            labels: None,
        };
        let gravity = self.gravity.map(|Numbers(gravity)| {
            Unit::try_new(Vector3::from(gravity), 1e-9).context("--gravity is 0,0,0; it must be a direction")
        });
        let seen = depth_view(&view, &Workspace::default());
        let found = in_file(&self.image, |_| {
            let image = DepthImage::new(seen.intrinsics, &seen.depth)?;
            Ok(Tabletop::find(&image, gravity.transpose()?, self.table_height)?)
        })?;
        let workspace = pose_json(&found.camera_from_task);
        if let Some(path) = &self.out {
            fs::write(path, format!("{workspace:#}\n")).with_context(|| path.display().to_string())?;
        }
        if let Some(path) = &self.picture {
            let mut overlay = Overlay::of_depth(&metres(&view.depth), seen.intrinsics, found.camera_from_task);
            overlay.workspace(self.table_height).save(path)?;
        }
        show::print(&if as_json { format!("{:#}", json(&found, workspace)) } else { text(&found) })?;
        Ok(())
    }
}

fn pose_json(pose: &Isometry3<f64>) -> Value {
    json!({ "position": pose.translation.vector.as_slice(), "orientation": pose.rotation.coords.as_slice() })
}

fn json(table: &Tabletop, workspace: Value) -> Value {
    json!({
        "workspace": workspace,
        "distance": table.distance,
        "angle": table.angle,
        "share": table.share,
        "deviation": table.deviation,
        "tilt": table.tilt,
    })
}

fn text(table: &Tabletop) -> String {
    let mut text = format!(
        "table: {:.3} m from the camera, whose optical axis is {:.1}° from the table's normal\n\
         on the table: {:.0} % of the image, {:.1} mm from the plane (RMS)",
        table.distance,
        table.angle.to_degrees(),
        table.share * 100.0,
        table.deviation * 1e3
    );
    if let Some(tilt) = table.tilt {
        text += &format!("\ntilt against gravity: {:.1}°", tilt.to_degrees());
    }
    let (p, q) = (table.camera_from_task.translation.vector, table.camera_from_task.rotation.coords);
    let numbers: Vec<String> = p.iter().chain(&q).map(|number| format!("{number:.5}")).collect();
    text + &format!("\nworkspace in the camera frame (x, y, z, qx, qy, qz, qw): {}", numbers.join(","))
}
