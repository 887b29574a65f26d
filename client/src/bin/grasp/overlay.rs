//! Pictures over an image of the camera.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use grasp::{Intrinsics, WORKSPACE_SIZE};
use grasp_client::Detection;
use grasp_picture::{Picture, quality_color};
use nalgebra::Isometry3;

use crate::drawing::{SHOWN, frame};
use crate::files::in_file;

/// A picture of the task frame over an image of the camera.
pub(crate) struct Overlay(Picture);

impl Overlay {
    /// Over a depth image, metres: bright is near, black has no depth. The grey levels span the depths of the image.
    pub fn of_depth(depth: &[f32], camera: Intrinsics, camera_from_task: Isometry3<f64>) -> Self {
        let mut valid: Vec<f32> = depth.iter().copied().filter(|depth| *depth > 0.0 && depth.is_finite()).collect();
        valid.sort_by(f32::total_cmp);
        let at = |share: f64| valid.get((valid.len() as f64 * share) as usize).copied().unwrap_or(1.0);
        let (near, far) = (at(0.01), at(0.95));
        let grey = |&depth: &f32| {
            let share = ((far - depth) / (far - near).max(1e-3)).clamp(0.0, 1.0);
            let level = if depth > 0.0 { 40.0 + 190.0 * share } else { 0.0 };
            [level as u8; 3]
        };
        let mut picture = Picture::new(camera, camera_from_task);
        picture.over(depth.iter().flat_map(grey).collect());
        Self(picture)
    }

    /// Over a colour image, PNG, of the same camera.
    pub fn of_color(path: &Path, camera: Intrinsics, camera_from_task: Isometry3<f64>) -> anyhow::Result<Self> {
        let pixels = in_file(path, |path| color(path, &camera))?;
        let mut picture = Picture::new(camera, camera_from_task);
        picture.over(pixels);
        Ok(Self(picture))
    }

    /// Adds the edges of the workspace and the outline of the table at `height`, metres.
    pub fn workspace(&mut self, height: f64) -> &mut Self {
        frame(&mut self.0, WORKSPACE_SIZE, Some(height));
        self
    }

    /// Adds the best grasps, which are in the frame of `frame_from_task`. `depth` is the length of the fingers, metres.
    pub fn grasps(&mut self, detection: &Detection, frame_from_task: &Isometry3<f64>, depth: f64) -> &mut Self {
        for grasp in detection.grasps.iter().take(SHOWN).rev() {
            let pose = frame_from_task.inverse() * grasp.pose;
            self.0.gripper(&pose, grasp.width, depth, quality_color(f64::from(grasp.quality)));
        }
        self
    }

    pub fn save(&self, path: &Path) -> anyhow::Result<()> {
        Ok(self.0.save(path)?)
    }
}

/// Red, green and blue of each pixel.
fn color(path: &Path, camera: &Intrinsics) -> anyhow::Result<Vec<u8>> {
    let mut decoder = png::Decoder::new(BufReader::new(File::open(path)?));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().context("not a PNG file")?;
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    let info = reader.next_frame(&mut bytes)?;
    let (width, height) = (info.width as usize, info.height as usize);
    ensure!(
        (width, height) == (camera.width, camera.height),
        "{width} × {height} pixels, but the depth image has {} × {}; align the colour image to the depth image",
        camera.width,
        camera.height
    );
    let pixels = bytes[..info.buffer_size()].iter().copied();
    Ok(match info.color_type {
        png::ColorType::Rgb => pixels.collect(),
        png::ColorType::Rgba => bytes.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
        png::ColorType::Grayscale => pixels.flat_map(|level| [level; 3]).collect(),
        png::ColorType::GrayscaleAlpha => bytes.chunks_exact(2).flat_map(|p| [p[0]; 3]).collect(),
        png::ColorType::Indexed => bail!("the palette could not be expanded; save the image as RGB"),
    })
}
