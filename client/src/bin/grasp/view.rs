use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use clap::Args;
use grasp::{FINGER_DEPTH, SurfaceMesh, SurfacePoint, TABLE_HEIGHT, Volume};
use grasp_client::Detection;
use grasp_picture::{Mesh, Picture, quality_color};
use nalgebra::{Isometry3, Point3};

use crate::drawing::{SHOWN, frame};
use crate::overlay::Overlay;
use crate::record;
use crate::scene::Scene;

/// Width and height of the picture, pixels.
const SIZE: [usize; 2] = [1200, 900];

/// Output of `grasp view`.
#[derive(Args)]
pub(crate) struct ViewArgs {
    /// Output file: a picture (.png), or a recording for Foxglove and Rerun (.mcap).
    #[arg(long, value_name = "FILE", default_value = "grasps.png")]
    out: PathBuf,

    /// Draw the grasps over this colour image, PNG, which is aligned to the first depth image.
    #[arg(long, value_name = "FILE")]
    color: Option<PathBuf>,
}

impl ViewArgs {
    /// Checks the output file and the kind of the observation, before the request is sent.
    pub fn check(&self, scene: &Scene) -> anyhow::Result<()> {
        let extension = self.out.extension().and_then(|extension| extension.to_str());
        match (&self.color, extension) {
            (_, Some("png")) | (None, Some("mcap")) => {}
            (Some(_), _) => bail!("--out {}: the extension must be .png with --color", self.out.display()),
            (None, _) => bail!("--out {}: the extension must be .png or .mcap", self.out.display()),
        }
        ensure!(self.color.is_none() || matches!(scene, Scene::Depth(..)), "--color needs depth images");
        Ok(())
    }

    /// Draws the grasps over the colour image, if one is given. Returns the path of the picture.
    pub fn write_over_color(
        &self,
        scene: &Scene,
        depth: Option<f64>,
        detection: &Detection,
    ) -> anyhow::Result<Option<&Path>> {
        let Some(color) = &self.color else { return Ok(None) };
        let (view, pose) = scene.first_view(detection)?;
        let mut overlay = Overlay::of_color(color, view.intrinsics(), view.camera_from_task)?;
        overlay.grasps(detection, &pose, depth.unwrap_or(FINGER_DEPTH)).save(&self.out)?;
        Ok(Some(&self.out))
    }

    /// Draws or records the observed surface and the grasps. `table` is the height of the table above the volume's
    /// bottom and `depth` the length of the fingers, metres; `None` means the default.
    pub fn write(
        &self,
        volume: &Volume,
        table: Option<f64>,
        depth: Option<f64>,
        detection: &Detection,
    ) -> anyhow::Result<&Path> {
        let (table, depth) = (table.unwrap_or(TABLE_HEIGHT), depth.unwrap_or(FINGER_DEPTH));
        if self.out.extension().is_some_and(|extension| extension == "mcap") {
            record::write(&self.out, &placed(&volume.surface(), volume.pose()), depth, detection)?;
        } else {
            draw(volume, table, depth, detection).save(&self.out)?;
        }
        Ok(&self.out)
    }
}

/// The surface points in the frame of `pose`.
fn placed(surface: &[SurfacePoint], pose: &Isometry3<f64>) -> Vec<SurfacePoint> {
    let point = |point: &SurfacePoint| SurfacePoint { position: pose * point.position, normal: pose * point.normal };
    surface.iter().map(point).collect()
}

/// Draws in the task frame. The camera is above a corner and sees the whole workspace.
fn draw(volume: &Volume, table: f64, depth: f64, detection: &Detection) -> Picture {
    let size = volume.voxel_size() * volume.resolution() as f64;
    let [width, height] = SIZE;
    let (eye, target) = (Point3::new(1.75, -1.1, 1.8) * size, Point3::new(0.5, 0.5, 0.4) * size);
    let mut picture = Picture::looking_at(width, height, 0.68, eye, target);
    frame(&mut picture, size, table);
    let SurfaceMesh { vertices, triangles } = volume.mesh();
    picture.mesh(&Mesh { vertices, triangles }, &Isometry3::identity(), 1.0, [206, 204, 198]);
    for grasp in detection.grasps.iter().take(SHOWN).rev() {
        let pose = volume.pose().inverse() * grasp.pose;
        picture.gripper(&pose, grasp.width, depth, quality_color(f64::from(grasp.quality)));
    }
    picture
}
