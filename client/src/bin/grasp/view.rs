use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;
use grasp::{Fusion, SurfaceMesh, SurfacePoint, Volume};
use grasp_client::Detection;
use grasp_picture::{Mesh, Picture, quality_color};
use nalgebra::{Isometry3, Point3};

use crate::record;

/// Pixels of a picture.
const SIZE: [usize; 2] = [1200, 900];

/// Grasps in a picture, the best: more hide each other.
const SHOWN: usize = 40;

/// Where what was seen goes.
#[derive(Args)]
pub(crate) struct ViewArgs {
    /// A picture (.png), or a recording that Foxglove and Rerun open (.mcap).
    #[arg(long, value_name = "FILE", default_value = "grasps.png")]
    out: PathBuf,
}

impl ViewArgs {
    /// Draws or records the observed surface and the grasps.
    pub fn write(&self, volume: &Volume, detection: &Detection) -> anyhow::Result<&Path> {
        let field = Fusion::of(volume);
        match self.out.extension().and_then(|extension| extension.to_str()) {
            Some("png") => draw(volume, field.mesh(), detection).save(&self.out)?,
            Some("mcap") => record::write(&self.out, &placed(&field.surface(), volume.pose()), detection)?,
            _ => bail!("{}: .png or .mcap is needed", self.out.display()),
        }
        Ok(&self.out)
    }
}

/// In the frame of the volume's pose.
fn placed(surface: &[SurfacePoint], pose: &Isometry3<f64>) -> Vec<SurfacePoint> {
    let point = |point: &SurfacePoint| SurfacePoint { position: pose * point.position, normal: pose * point.normal };
    surface.iter().map(point).collect()
}

/// In the volume's own frame, from a corner above it.
fn draw(volume: &Volume, mesh: SurfaceMesh, detection: &Detection) -> Picture {
    let size = volume.voxel_size() * volume.resolution() as f64;
    let [width, height] = SIZE;
    let (eye, target) = (Point3::new(1.75, -1.1, 1.8) * size, Point3::new(0.52, 0.46, 0.3) * size);
    let mut picture = Picture::looking_at(width, height, 0.46, eye, target);
    let SurfaceMesh { vertices, triangles } = mesh;
    picture.mesh(&Mesh { vertices, triangles }, &Isometry3::identity(), 1.0, [206, 204, 198]);
    for grasp in detection.grasps.iter().take(SHOWN).rev() {
        let pose = volume.pose().inverse() * grasp.pose;
        picture.gripper(&pose, grasp.width, quality_color(f64::from(grasp.quality)));
    }
    picture
}
