//! `grasp table`: finds the table in a depth image or a point cloud, without a server.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use grasp::{TABLE_HEIGHT, WORKSPACE_SIZE};
use grasp_client::Extrinsics;
use grasp_perception::{Cloud, FoundTable, Frame, Tabletop, View, Workspace, overview};
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use serde_json::{Value, json};

use crate::camera::Camera;
use crate::files::in_file;
use crate::image::{self, Scale};
use crate::numbers::{Numbers, rounded};
use crate::overlay::Overlay;
use crate::{UnitFlag, cloud, show};

#[derive(Args)]
pub(crate) struct Table {
    /// Depth image, with --intrinsics: PNG, TIFF or .npy with 16 bits per pixel, or TIFF, EXR or .npy with floats in
    /// metres. Or point cloud, with --camera-position: PCD, PLY, .npy or .npz.
    file: PathBuf,

    /// Intrinsics of the camera, formats as for `grasp detect`.
    #[arg(long, value_name = "FILE|NUMBERS", required_unless_present = "camera_position", allow_hyphen_values = true)]
    intrinsics: Option<String>,

    /// The image is rectified already, as for `grasp detect`.
    #[arg(long, conflicts_with = "camera_position")]
    rectified: bool,

    /// Camera position of the point cloud in the frame of its points, metres: 0,0,0 for points in the camera frame.
    #[arg(long, value_name = "X,Y,Z", conflicts_with = "intrinsics", allow_hyphen_values = true)]
    camera_position: Option<Numbers<3>>,

    /// Unit of the depths, metres. Default: that of the file of the intrinsics, or else 0.001 for integers and 1 for
    /// floats.
    #[arg(long, value_name = "METRES", value_parser = image::parse_scale, conflicts_with = "camera_position", allow_hyphen_values = true)]
    depth_scale: Option<f64>,

    /// Unit of the points, metres: 0.001 for millimetres. Default: 0.001 for integers and 1 for floats.
    #[arg(long, value_name = "METRES", value_parser = image::parse_scale, conflicts_with = "intrinsics", allow_hyphen_values = true)]
    cloud_scale: Option<f64>,

    /// Direction of gravity in the camera frame (z forward, x right, y down), or in the frame of the points: the
    /// reversed reading of an accelerometer at rest. Without it a wall that fills the image is taken for a table.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    gravity: Option<Numbers<3>>,

    /// Height of the table above the bottom of the workspace, metres.
    #[arg(long, value_name = "METRES", default_value_t = TABLE_HEIGHT)]
    table_height: f64,

    /// Write the pose of the workspace in the frame of the camera, or of the points, to this file: JSON, for
    /// `--workspace` of the other commands.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,

    /// Draw the workspace and the table over the depth image, or the rendered points: PNG.
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
}

impl Table {
    pub fn unit(&self) -> UnitFlag {
        let flag = if self.camera_position.is_some() { "--cloud-scale" } else { "--depth-scale" };
        UnitFlag { flag, given: self.cloud_scale.or(self.depth_scale) }
    }

    pub fn run(&self, as_json: bool) -> anyhow::Result<()> {
        let gravity = self.gravity.map(|Numbers(gravity)| {
            Unit::try_new(Vector3::from(gravity), 1e-9).context("--gravity is 0,0,0; it must be a direction")
        });
        let gravity = gravity.transpose()?;
        let mut place = Workspace { find_table: true, gravity, ..Workspace::default() };
        let (found, view) = self.find(&mut place)?;
        let FoundTable { frame_from_task, tabletop, objects, .. } = found;
        let workspace = pose_json(&frame_from_task);
        if let Some(path) = &self.out {
            fs::write(path, format!("{workspace:#}\n")).with_context(|| path.display().to_string())?;
        }
        if let Some(path) = &self.picture {
            let mut overlay = Overlay::of_depth(view.image.depth(), view.intrinsics(), tabletop.camera_from_task);
            overlay.workspace(self.table_height).save(path)?;
        }
        let frame = if self.camera_position.is_some() { "points" } else { "camera" };
        show::print(&if as_json {
            format!("{:#}", json(&tabletop, objects, workspace))
        } else {
            text(&tabletop, objects, &frame_from_task, frame)
        })?;
        Ok(())
    }

    /// The table in the file, and the image in which it was searched for. The caller's frame is that of the camera, or
    /// of the points.
    fn find(&self, workspace: &mut Workspace) -> anyhow::Result<(FoundTable, View)> {
        let (height, edge) = (self.table_height, WORKSPACE_SIZE);
        if let Some(Numbers(eye)) = self.camera_position {
            let points =
                cloud::read(&self.file, self.cloud_scale)?.into_iter().map(|point| Point3::from(point).cast::<f64>());
            let points = points.filter(|point| point.iter().all(|c| c.is_finite())).collect();
            let cloud = Cloud { points, eye: Point3::from(eye), labels: None };
            let seen = overview(&cloud.points, &cloud.eye);
            let seen = seen.context("--camera-position must be the position from which the points were seen")?;
            let found = in_file(&self.file, |_| Ok(workspace.find_table_in_cloud(&cloud, height, edge)?))?;
            return Ok((found, seen));
        }
        let camera = Camera::read(self.intrinsics.as_deref().unwrap_or_default(), self.rectified)?;
        let scale = Scale { given: self.depth_scale, of_camera: camera.depth_scale };
        let view = camera.view(&self.file, scale, None, Extrinsics::FrameFromCamera(Isometry3::identity()))?;
        let mut frame: Frame = in_file(&self.file, |_| Ok(grasp_proto::frame(&(&view).into())?))?;
        let found = in_file(&self.file, |_| Ok(workspace.find_table_in_frame(&mut frame, true, height, edge)?))?;
        Ok((found, frame.in_task(&Isometry3::identity())?))
    }
}

fn pose_json(pose: &Isometry3<f64>) -> Value {
    let (position, rotation) = (pose.translation.vector.map(rounded), pose.rotation.coords.map(rounded));
    json!({ "position": position.as_slice(), "orientation": rotation.as_slice() })
}

fn json(table: &Tabletop, objects: usize, workspace: Value) -> Value {
    json!({
        "workspace": workspace,
        "distance": table.distance,
        "angle": table.angle,
        "share": table.share,
        "deviation": table.deviation,
        "tilt": table.tilt,
        "objects": objects,
    })
}

fn text(table: &Tabletop, objects: usize, frame_from_task: &Isometry3<f64>, frame: &str) -> String {
    let mut text = format!(
        "table: {:.3} m from the camera, whose optical axis is {:.1}° from the table's normal\n\
         on the table: {:.0} % of the image, {:.1} mm from the plane (RMS)\n\
         objects on it: {objects}",
        table.distance,
        table.angle.to_degrees(),
        table.share * 100.0,
        table.deviation * 1e3
    );
    if let Some(tilt) = table.tilt {
        text += &format!("\ntilt against gravity: {:.1}°", tilt.to_degrees());
    }
    let (p, q) = (frame_from_task.translation.vector, frame_from_task.rotation.coords);
    let numbers: Vec<String> = p.iter().chain(&q).map(|number| format!("{number:.5}")).collect();
    text + &format!("\nworkspace in the frame of the {frame} (x, y, z, qx, qy, qz, qw): {}", numbers.join(","))
}
