//! Shaded pictures of scenes and grasps.
//!
//! A picture is rendered with the depth camera and shaded with the light of [`Light`].

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{BufWriter, ErrorKind};
use std::path::{Path, PathBuf};

use grasp::Intrinsics;
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;
use thiserror::Error;

use crate::color::{Color, PAPER, linear, srgb};
use crate::light::Light;
use crate::mesh::Mesh;
use crate::raster::{Instance, View, toward};

/// Subpixels along each side of a pixel.
const SUPERSAMPLING: usize = 2;
/// Surfaces that meet at a smaller angle than this are shaded as one smooth surface, radians.
const CREASE: f64 = 0.7;
/// Item index of pixels without a surface.
const BACKGROUND: u32 = u32::MAX;
/// Item index of pixels that show the table.
const TABLE: u32 = u32::MAX - 1;

/// A picture file could not be written.
#[derive(Debug, Error)]
#[error("cannot write the picture {}: {source}; check that its folder exists and is writable", path.display())]
pub struct PictureError {
    path: PathBuf,
    source: png::EncodingError,
}

/// A picture that is rendered by [`Picture::save`] from the added items.
#[derive(Clone, Debug)]
pub struct Picture {
    camera: Intrinsics,
    camera_from_task: Isometry3<f64>,
    table: Option<f64>,
    /// Red, green and blue of each pixel behind the items; without it the background is white.
    background: Option<Vec<u8>>,
    items: Vec<Item>,
}

/// An item in the picture.
#[derive(Clone, Debug)]
struct Item {
    /// Mesh in the task frame.
    mesh: Mesh,
    /// One normal per corner of each triangle.
    normals: Vec<[Vector3<f64>; 3]>,
    color: Color,
    /// Whether the item is an annotation: it casts and receives no shadow.
    note: bool,
}

impl Picture {
    /// An empty picture with a camera. `camera_from_task` maps task points into the camera frame (z forward, x right, y
    /// down).
    pub fn new(camera: Intrinsics, camera_from_task: Isometry3<f64>) -> Picture {
        Picture { camera, camera_from_task, table: None, background: None, items: Vec::new() }
    }

    /// An empty picture of `width` × `height` pixels from `eye` towards `target` (task frame, metres), with a vertical
    /// field of view of `view` radians.
    pub fn looking_at(width: usize, height: usize, view: f64, eye: Point3<f64>, target: Point3<f64>) -> Picture {
        let focal = height as f64 / 2.0 / (view / 2.0).tan();
        let (cx, cy) = (width as f64 / 2.0 - 0.5, height as f64 / 2.0 - 0.5);
        let camera = Intrinsics { width, height, fx: focal, fy: focal, cx, cy };
        Picture::new(camera, toward(eye, target))
    }

    /// A picture of the 0.3 m workspace with its table, seen from above a corner.
    pub fn of_workspace(width: usize, height: usize, table: f64) -> Picture {
        let (eye, target) = (Point3::new(0.50, -0.30, 0.52), Point3::new(0.16, 0.14, 0.12));
        let mut picture = Picture::looking_at(width, height, 0.42, eye, target);
        picture.table(table);
        picture
    }

    /// Draws the items over an image: red, green and blue of each pixel, row by row.
    ///
    /// # Panics
    /// If the image does not have the size of the camera's images.
    pub fn over(&mut self, image: Vec<u8>) -> &mut Self {
        assert_eq!(image.len(), 3 * self.camera.width * self.camera.height, "the image has the size of the camera's");
        self.background = Some(image);
        self
    }

    /// Adds the table, an infinite plane at `height` (task frame, metres).
    pub fn table(&mut self, height: f64) -> &mut Self {
        self.table = Some(height);
        self
    }

    /// Adds a mesh, scaled and then transformed by `pose` into the task frame.
    pub fn mesh(&mut self, mesh: &Mesh, pose: &Isometry3<f64>, scale: f64, color: Color) -> &mut Self {
        self.add(mesh.scaled(scale).transformed(pose), color, false)
    }

    /// Adds a slender gripper, for pictures with many grasps.
    ///
    /// Its frame: z is the approach, the fingers close along y, the origin is at the base of the fingers. The fingers
    /// are `depth` metres long and `width` metres apart.
    pub fn gripper(&mut self, pose: &Isometry3<f64>, width: f64, depth: f64, color: Color) -> &mut Self {
        self.add(fork(width, depth, [0.006, 0.005]).transformed(pose), color, true)
    }

    /// Adds a solid hand in the frame of [`Picture::gripper`] with the fingers of the Panda, to highlight one grasp.
    pub fn hand(&mut self, pose: &Isometry3<f64>, width: f64, color: Color) -> &mut Self {
        let mut hand = fork(width, grasp::FINGER_DEPTH, [0.02, 0.009]);
        let palm = Mesh::cuboid(Vector3::new(0.026, 0.10, 0.018));
        let flange = Mesh::cylinder(0.011, 0.05, 24);
        hand.append(&palm.transformed(&Isometry3::translation(0.0, 0.0, -0.016)));
        hand.append(&flange.transformed(&Isometry3::translation(0.0, 0.0, -0.045)));
        self.add(hand.transformed(pose), color, false)
    }

    fn add(&mut self, mesh: Mesh, color: Color, note: bool) -> &mut Self {
        let normals = smooth_normals(&mesh);
        self.items.push(Item { mesh, normals, color, note });
        self
    }

    /// Renders the picture: red, green and blue of each pixel, row by row from the top left.
    pub fn pixels(&self) -> Vec<u8> {
        let n = SUPERSAMPLING;
        let fine = refined(&self.camera);
        let mut view = View::new(&fine, &self.camera_from_task, 0.01, 100.0);
        let mut seen = vec![(BACKGROUND, 0); view.depth.len()];
        for (index, item) in self.items.iter().enumerate() {
            view.draw(&Instance::new(&item.mesh), |pixel, triangle| seen[pixel] = (index as u32, triangle as u32));
        }
        if let Some(height) = self.table {
            view.draw_table(height, |pixel| seen[pixel] = (TABLE, 0));
        }

        let light = self.light();
        let task_from_camera = self.camera_from_task.inverse();
        let shade = |u: usize, v: usize| {
            let pixel = v * fine.width + u;
            let (item, triangle) = seen[pixel];
            if item == BACKGROUND {
                let index = 3 * (v / n * self.camera.width + u / n);
                let image = self.background.as_ref().and_then(|image| image[index..].first_chunk());
                return linear(image.copied().unwrap_or(PAPER));
            }
            let ray = Vector3::new((u as f64 - fine.cx) / fine.fx, (v as f64 - fine.cy) / fine.fy, 1.0);
            let depth = f64::from(view.depth[pixel]);
            let point = task_from_camera * Point3::from(ray * depth);
            if item == TABLE {
                return light.table(&point, depth / fine.fx);
            }
            let item = &self.items[item as usize];
            let normal = item.normal(triangle as usize, &point);
            let toward_eye = -(task_from_camera * ray);
            let normal = if normal.dot(&toward_eye) < 0.0 { -normal } else { normal };
            if item.note {
                return linear(item.color) * light.unshaded(&normal);
            }
            let gloss = light.gloss(&normal, &toward_eye.normalize());
            linear(item.color) * light.at(&point, &normal) + Vector3::repeat(gloss)
        };
        let pixel = |index: usize| {
            let (u, v) = (index % self.camera.width * n, index / self.camera.width * n);
            let sum: Vector3<f64> = (0..n * n).map(|i| shade(u + i % n, v + i / n)).sum();
            srgb(sum / (n * n) as f64)
        };
        (0..self.camera.width * self.camera.height).into_par_iter().flat_map_iter(pixel).collect()
    }

    /// The light over the items that cast shadows.
    fn light(&self) -> Light {
        let casters: Vec<_> = self.items.iter().filter(|item| !item.note).map(|item| &item.mesh).collect();
        Light::over(&casters, self.table)
    }

    /// Renders the picture and writes it as a PNG.
    ///
    /// # Errors
    /// [`PictureError`] if the file cannot be created or written.
    pub fn save(&self, path: &Path) -> Result<(), PictureError> {
        write(path, self.camera.width, self.camera.height, &self.pixels())
    }
}

/// Renders pictures of one size and writes them as one PNG with `columns` pictures per row. Without pictures, an
/// earlier file is removed.
///
/// # Errors
/// [`PictureError`] if the file cannot be created, written or removed.
pub fn save_sheet(path: &Path, pictures: &[&Picture], columns: usize) -> Result<(), PictureError> {
    let Some(Intrinsics { width, height, .. }) = pictures.first().map(|picture| picture.camera) else {
        return remove(path);
    };
    let columns = columns.clamp(1, pictures.len());
    let mut sheet = Vec::new();
    for row in pictures.chunks(columns) {
        let row: Vec<Vec<u8>> = row.iter().map(|picture| picture.pixels()).collect();
        for line in 0..height {
            for column in 0..columns {
                match row.get(column) {
                    Some(pixels) => sheet.extend_from_slice(&pixels[3 * line * width..3 * (line + 1) * width]),
                    None => sheet.extend(std::iter::repeat_n(255, 3 * width)),
                }
            }
        }
    }
    write(path, columns * width, pictures.len().div_ceil(columns) * height, &sheet)
}

fn remove(path: &Path) -> Result<(), PictureError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(PictureError { path: path.into(), source: error.into() })
        }
        _ => Ok(()),
    }
}

fn write(path: &Path, width: usize, height: usize, pixels: &[u8]) -> Result<(), PictureError> {
    let write = || -> Result<(), png::EncodingError> {
        let file = BufWriter::new(File::create(path)?);
        let mut encoder = png::Encoder::new(file, width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(pixels)?;
        writer.finish()
    };
    write().map_err(|source| PictureError { path: path.into(), source })
}

impl Item {
    /// The interpolated normal at a point of a triangle.
    fn normal(&self, triangle: usize, point: &Point3<f64>) -> Vector3<f64> {
        let [a, b, c] = self.mesh.corners(self.mesh.triangles[triangle]);
        let across = (b - a).cross(&(c - a));
        let weight = |p: Point3<f64>, q: Point3<f64>| (p - point).cross(&(q - point)).dot(&across).max(0.0);
        let [na, nb, nc] = self.normals[triangle];
        (na * weight(b, c) + nb * weight(c, a) + nc * weight(a, b))
            .try_normalize(0.0)
            .unwrap_or_else(|| across.normalize())
    }
}

/// The camera with [`SUPERSAMPLING`] times the pixels along each side.
fn refined(camera: &Intrinsics) -> Intrinsics {
    let n = SUPERSAMPLING as f64;
    // Pixel centres are whole numbers: the corner of the image is at (−½, −½) in both.
    let centre = |c: f64| (c + 0.5) * n - 0.5;
    Intrinsics {
        width: camera.width * SUPERSAMPLING,
        height: camera.height * SUPERSAMPLING,
        fx: camera.fx * n,
        fy: camera.fy * n,
        cx: centre(camera.cx),
        cy: centre(camera.cy),
    }
}

/// A gripper in the grasp frame: two fingers, a bar between them and a stem.
fn fork(width: f64, depth: f64, [breadth, thickness]: [f64; 2]) -> Mesh {
    let part =
        |size: [f64; 3], y: f64, z: f64| Mesh::cuboid(size.into()).transformed(&Isometry3::translation(0.0, y, z));
    let apart = (width + thickness) / 2.0;
    let finger = |side: f64| part([breadth, thickness, depth], side * apart, depth / 2.0);
    let bar = part([breadth, width + 2.0 * thickness, thickness], 0.0, -thickness / 2.0);
    let stem = part([breadth, thickness, 0.04], 0.0, -0.02 - thickness);
    Mesh::union([&finger(1.0), &finger(-1.0), &bar, &stem])
}

/// For each corner of each triangle, the mean normal of the surfaces that meet there smoothly.
fn smooth_normals(mesh: &Mesh) -> Vec<[Vector3<f64>; 3]> {
    let key = |p: Point3<f64>| p.coords.map(|x| (x * 1e5).round() as i64);
    let faces: Vec<_> = mesh.triangles.iter().map(|&t| mesh.area_normal(t)).collect();
    let mut around: HashMap<_, Vec<usize>> = HashMap::new();
    for (face, &triangle) in mesh.triangles.iter().enumerate() {
        for corner in mesh.corners(triangle) {
            around.entry(key(corner)).or_default().push(face);
        }
    }
    let normal = |face: usize, corner: Point3<f64>| {
        let own = faces[face];
        let smooth = |other: &Vector3<f64>| own.dot(other) > CREASE.cos() * own.norm() * other.norm();
        let sum: Vector3<f64> = around[&key(corner)].iter().map(|&i| faces[i]).filter(|n| smooth(n)).sum();
        sum.try_normalize(0.0).unwrap_or_else(Vector3::z)
    };
    let triangles = mesh.triangles.iter().enumerate();
    triangles.map(|(face, &triangle)| mesh.corners(triangle).map(|corner| normal(face, corner))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLUE: Color = [30, 60, 220];

    /// A small picture of a blue cube on the table, from above.
    fn cube() -> Picture {
        let mut picture = Picture::looking_at(64, 48, 0.6, Point3::new(0.0, 0.0, 0.5), Point3::origin());
        picture.table(0.0).mesh(
            &Mesh::cuboid(Vector3::repeat(1.0)),
            &Isometry3::translation(0.0, 0.0, 0.03),
            0.06,
            BLUE,
        );
        picture
    }

    #[test]
    fn a_picture_shows_its_items_at_their_positions() {
        let pixels = cube().pixels();
        assert_eq!(pixels.len(), 64 * 48 * 3);
        let at = |u: usize, v: usize| <Color>::try_from(&pixels[(v * 64 + u) * 3..][..3]).unwrap();
        let [red, _, blue] = at(32, 24);
        assert!(blue > 150 && red < 120, "{:?}", at(32, 24));
        let [red, green, blue] = at(4, 4);
        assert!(red.abs_diff(blue) < 20 && green > 150, "{:?}", at(4, 4));
    }

    #[test]
    fn the_lamps_cast_a_shadow() {
        let picture = cube();
        let light = picture.light();
        let (shade, open) = (Point3::new(0.02, 0.045, 0.0), Point3::new(-0.09, -0.09, 0.0));
        assert!(light.at(&shade, &Vector3::z()) < 0.7 * light.at(&open, &Vector3::z()));
    }

    #[test]
    fn a_gripper_has_its_width_and_depth() {
        let (low, high) = fork(0.04, grasp::FINGER_DEPTH, [0.006, 0.005]).bounds();
        assert!((high.z - 0.05).abs() < 1e-12 && (high.y - 0.025).abs() < 1e-12 && (low.y + 0.025).abs() < 1e-12);
    }

    #[test]
    fn a_sheet_without_pictures_replaces_an_earlier_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sheet.png");
        save_sheet(&path, &[&cube()], 3).unwrap();
        assert!(path.exists());
        for _ in 0..2 {
            save_sheet(&path, &[], 3).unwrap();
            assert!(!path.exists());
        }
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let error = cube().save(Path::new("/nowhere/at/all.png")).unwrap_err().to_string();
        assert!(error.contains("/nowhere/at/all.png"), "{error}");
    }
}
