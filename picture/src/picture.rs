//! Shaded pictures of scenes and grasps.
//!
//! A few dozen lamps spread over the sky, most of them on one side, light the scene. Each lamp has a shadow map,
//! rendered with the depth camera. Together they give soft shadows and ambient occlusion.

use std::collections::HashMap;
use std::f64::consts::PI;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use grasp::Intrinsics;
use nalgebra::{Isometry3, Point3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use thiserror::Error;

use crate::mesh::Mesh;
use crate::raster::{Instance, View};

/// Subpixels along each side of a pixel.
const SUPERSAMPLING: usize = 2;
/// Lamps over the whole sky.
const SKY: usize = 28;
/// Lamps close together that act as the sun.
const SUN: usize = 12;
/// The sun's share of the light.
const SUN_SHARE: f64 = 0.68;
/// Pixels along each side of a lamp's shadow map.
const SHADOW_MAP: usize = 768;
/// Surfaces that meet at a smaller angle than this are shaded as one smooth surface, radians.
const CREASE: f64 = 0.7;
/// Item index of pixels without a surface.
const BACKGROUND: u32 = u32::MAX;
/// Item index of pixels that show the table.
const TABLE: u32 = u32::MAX - 1;

/// A colour: red, green and blue in sRGB, 0–255.
pub type Color = [u8; 3];

const PAPER: Color = [246, 246, 244];
const TABLE_TOP: Color = [226, 224, 220];
const GRID: Color = [196, 194, 190];
const PALETTE: [Color; 12] = [
    [214, 96, 77],
    [67, 133, 190],
    [240, 178, 66],
    [90, 160, 108],
    [150, 116, 180],
    [232, 140, 100],
    [88, 178, 190],
    [222, 200, 150],
    [190, 90, 120],
    [120, 140, 90],
    [236, 236, 230],
    [110, 122, 150],
];

/// The colour of object `index` of a scene.
pub fn object_color(index: usize) -> Color {
    PALETTE[index % PALETTE.len()]
}

/// The colour of a quality: red at 0, yellow at 0.5, green at 1.
pub fn quality_color(quality: f64) -> Color {
    let q = quality.clamp(0.0, 1.0);
    let mix = |low: f64, high: f64, t: f64| (low + (high - low) * t) as u8;
    let (red, yellow, green) = ([205.0, 40.0, 40.0], [245.0, 195.0, 50.0], [40.0, 165.0, 75.0]);
    let (from, to, t) = if q < 0.5 { (red, yellow, 2.0 * q) } else { (yellow, green, 2.0 * q - 1.0) };
    std::array::from_fn(|i| mix(from[i], to[i], t))
}

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
            view.draw(&item.instance(), |pixel, triangle| seen[pixel] = (index as u32, triangle as u32));
        }
        if let Some(height) = self.table {
            view.draw_table(height, |pixel| seen[pixel] = (TABLE, 0));
        }

        let light = Light::over(&self.items, self.table);
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

    /// Renders the picture and writes it as a PNG.
    ///
    /// # Errors
    /// [`PictureError`] if the file cannot be created or written.
    pub fn save(&self, path: &Path) -> Result<(), PictureError> {
        write(path, self.camera.width, self.camera.height, &self.pixels())
    }
}

/// Renders pictures of one size and writes them as one PNG with `columns` pictures per row.
///
/// # Errors
/// [`PictureError`] if the file cannot be created or written.
pub fn save_sheet(path: &Path, pictures: &[&Picture], columns: usize) -> Result<(), PictureError> {
    let Some(Intrinsics { width, height, .. }) = pictures.first().map(|picture| picture.camera) else {
        return Ok(());
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
    fn instance(&self) -> Instance<'_> {
        Instance { mesh: &self.mesh, pose: Isometry3::identity(), scale: 1.0, id: 0 }
    }

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

/// The lamps of a scene.
struct Light {
    lamps: Vec<Lamp>,
    centre: Point3<f64>,
    radius: f64,
}

struct Lamp {
    direction: Vector3<f64>,
    strength: f64,
    camera: Intrinsics,
    camera_from_task: Isometry3<f64>,
    depth: Vec<f32>,
}

impl Light {
    /// Lamps on a dome over the items that cast shadows.
    fn over(items: &[Item], table: Option<f64>) -> Light {
        let casters: Vec<_> = items.iter().filter(|item| !item.note).collect();
        let boxes: Vec<_> = casters.iter().flat_map(|item| <[_; 2]>::from(item.mesh.bounds())).collect();
        let (low, high) = Mesh { vertices: boxes, triangles: Vec::new() }.bounds();
        let centre = nalgebra::center(&low, &high);
        // A margin for the shadows beside the items.
        let radius = (high - low).norm() / 2.0 + 0.05;

        let spiral = |i: usize, n: usize, least: f64| {
            let z = 1.0 - (1.0 - least) * (i as f64 + 0.5) / n as f64;
            let (sin, cos) = (i as f64 * PI * (3.0 - 5f64.sqrt())).sin_cos();
            let flat = (1.0 - z * z).sqrt();
            Vector3::new(flat * cos, flat * sin, z)
        };
        let tilt = Rotation3::rotation_between(&Vector3::z(), &Vector3::new(-0.35, -0.75, 1.0)).unwrap_or_default();
        let sky = (0..SKY).map(|i| (spiral(i, SKY, 0.12), (1.0 - SUN_SHARE) / SKY as f64 * 1.6));
        let sun = (0..SUN).map(|i| (tilt * spiral(i, SUN, 0.985), SUN_SHARE / SUN as f64 * 1.25));
        let directions: Vec<_> = sky.chain(sun).collect();
        let lamp = |(direction, strength): (Vector3<f64>, f64)| {
            Lamp::new(direction, strength, centre, radius, &casters, table)
        };
        Light { lamps: directions.into_par_iter().map(lamp).collect(), centre, radius }
    }

    /// Light at a point of a surface.
    fn at(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
        // The point is lifted off the surface by more than a pixel of the shadow map, so that the surface does not
        // shade itself.
        let lifted = point + normal * (self.radius * 3.5 / SHADOW_MAP as f64);
        let from = |lamp: &Lamp| lamp.strength * normal.dot(&lamp.direction).max(0.0) * lamp.reaches(&lifted);
        0.06 + self.lamps.iter().map(from).sum::<f64>()
    }

    /// Light on an annotation: without shadows and with a high ambient part.
    fn unshaded(&self, normal: &Vector3<f64>) -> f64 {
        0.55 + 0.45 * normal.dot(&self.lamps[SKY].direction).max(0.0)
    }

    /// Specular reflection of the sun.
    fn gloss(&self, normal: &Vector3<f64>, toward_eye: &Vector3<f64>) -> f64 {
        let sun = self.lamps[SKY].direction;
        let halfway = (sun + toward_eye).normalize();
        0.12 * normal.dot(&halfway).max(0.0).powi(40)
    }

    /// The colour of the table with its grid, which fades into the background far from the scene. `footprint` is the
    /// size of a pixel on the table, metres.
    fn table(&self, point: &Point3<f64>, footprint: f64) -> Vector3<f64> {
        let to_line = |x: f64| (x / 0.05 - (x / 0.05).round()).abs() * 0.05;
        let distance = to_line(point.x).min(to_line(point.y));
        let line = (1.0 - distance / (0.0005 + footprint)).clamp(0.0, 1.0);
        let ground = linear(TABLE_TOP).lerp(&linear(GRID), line);
        let lit = ground * self.at(point, &Vector3::z());
        let away = (point - self.centre).xy().norm() / self.radius;
        lit.lerp(&linear(PAPER), ((away - 1.2) / 1.2).clamp(0.0, 1.0))
    }
}

impl Lamp {
    fn new(
        direction: Vector3<f64>,
        strength: f64,
        centre: Point3<f64>,
        radius: f64,
        casters: &[&Item],
        table: Option<f64>,
    ) -> Lamp {
        let distance = 6.0 * radius;
        let camera_from_task = toward(centre + direction * distance, centre);
        let focal = SHADOW_MAP as f64 / 2.0 * distance / (1.35 * radius);
        let middle = SHADOW_MAP as f64 / 2.0;
        let camera = Intrinsics { width: SHADOW_MAP, height: SHADOW_MAP, fx: focal, fy: focal, cx: middle, cy: middle };
        let mut view = View::new(&camera, &camera_from_task, radius, 20.0 * radius);
        for item in casters {
            view.draw(&item.instance(), |_, _| ());
        }
        // The table also shades items below it.
        if let Some(height) = table {
            view.draw_table(height, |_| ());
        }
        let depth = view.depth;
        Lamp { direction, strength, camera, camera_from_task, depth }
    }

    /// 1 if the lamp lights the point, 0 in shadow. Points outside the shadow map are lit.
    fn reaches(&self, point: &Point3<f64>) -> f64 {
        let p = self.camera_from_task * point;
        let u = (self.camera.fx * p.x / p.z + self.camera.cx).round();
        let v = (self.camera.fy * p.y / p.z + self.camera.cy).round();
        let inside = |x: f64| x >= 0.0 && x < SHADOW_MAP as f64;
        let lit = !(inside(u) && inside(v)) || p.z <= f64::from(self.depth[v as usize * SHADOW_MAP + u as usize]);
        f64::from(u8::from(lit))
    }
}

/// `T_camera_task` of a camera at `eye` that looks at `target`, with z up in its picture.
fn toward(eye: Point3<f64>, target: Point3<f64>) -> Isometry3<f64> {
    let forward = (target - eye).normalize();
    // For a vertical view any up direction works.
    let up = if forward.xy().norm() < 1e-6 { Vector3::y() } else { Vector3::z() };
    // look_at_rh has y up and z backward; the optical frame has y down and z forward.
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI) * Isometry3::look_at_rh(&eye, &target, &up)
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

/// Converts sRGB to linear light.
fn linear(color: Color) -> Vector3<f64> {
    Vector3::from(color.map(|c| (f64::from(c) / 255.0).powf(2.2)))
}

/// Converts linear light to sRGB.
fn srgb(light: Vector3<f64>) -> Color {
    light.map(|x| (x.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8).into()
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
        let light = Light::over(&picture.items, picture.table);
        let (shade, open) = (Point3::new(0.02, 0.045, 0.0), Point3::new(-0.09, -0.09, 0.0));
        assert!(light.at(&shade, &Vector3::z()) < 0.7 * light.at(&open, &Vector3::z()));
    }

    #[test]
    fn a_gripper_has_its_width_and_depth() {
        let (low, high) = fork(0.04, grasp::FINGER_DEPTH, [0.006, 0.005]).bounds();
        assert!((high.z - 0.05).abs() < 1e-12 && (high.y - 0.025).abs() < 1e-12 && (low.y + 0.025).abs() < 1e-12);
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let error = cube().save(Path::new("/nowhere/at/all.png")).unwrap_err().to_string();
        assert!(error.contains("/nowhere/at/all.png"), "{error}");
    }

    #[test]
    fn quality_goes_from_red_to_green() {
        assert!(quality_color(0.0)[0] > quality_color(0.0)[1]);
        assert!(quality_color(1.0)[1] > quality_color(1.0)[0]);
        assert_eq!(quality_color(7.0), quality_color(1.0));
    }
}
