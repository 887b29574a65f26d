//! Draws the frames that `docs/conventions.md` is about: `docs/gripper.png` and `docs/frames.png`.
//!
//! ```sh
//! cargo run --release -p grasp-picture --example frames
//! ```

use std::error::Error;
use std::f64::consts::{FRAC_PI_2, PI};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use grasp::{FINGER_DEPTH, Hand, Intrinsics, MAX_OPENING, WORKSPACE_SIZE};
use grasp_picture::{Color, Mesh, Picture, object_color};
use nalgebra::{Isometry3, Point2, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};
use png::{BitDepth, ColorType, Compression, Encoder, Filter};

const DOCS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs");
/// Pixels.
const SIZE: [usize; 2] = [1060, 660];
/// Of a small letter, pixels.
const LETTER: f64 = 13.5;
/// Height of the table in the workspace, metres.
const TABLE: f64 = 0.05;

/// What [`Picture`] leaves where nothing is.
const PAPER: Color = [246, 246, 244];
const INK: Color = [50, 53, 60];
const RED: Color = [205, 45, 40];
const GREEN: Color = [30, 140, 55];
const BLUE: Color = [45, 90, 215];
const VIOLET: Color = [130, 60, 160];

fn main() -> Result<(), Box<dyn Error>> {
    gripper().save("gripper.png")?;
    frames().save("frames.png")
}

/// The Panda hand as the boxes that the collision check has of it; the approach points up for once.
fn gripper() -> Sheet {
    let Hand { finger_width: thick, depth, height: breadth, palm: [low, high], .. } = Hand::PANDA;
    // Turned into the sun.
    let mut sheet = Sheet::new(0.31, [-0.18, -0.52, 0.36], [0.014, 0.0, 0.027]);
    sheet.frame = Isometry3::rotation(-FRAC_PI_2 * Vector3::z());
    let half = MAX_OPENING / 2.0;
    // Of the palm, what is near the fingers.
    let [low, high] = [Vector3::new(low[0], low[1], -0.024), Vector3::from(high)];
    sheet.block(low, high, [226, 227, 230]);
    for side in [-1.0, 1.0] {
        let middle = Vector3::new(0.0, side * (half + thick / 2.0), depth / 2.0);
        let size = Vector3::new(breadth, thick, depth) / 2.0;
        sheet.block(middle - size, middle + size, [168, 174, 184]);
    }
    sheet.axes(&Isometry3::identity(), 0.07, 0.0018);
    sheet.ball([0.0, 0.0, FINGER_DEPTH], 0.0036, [250, 200, 60]);

    sheet.name([0.07, 0.0, 0.0], [1.1, 1.2], 0.0, RED, "x");
    sheet.name([0.0, 0.07, 0.0], [0.7, 1.9], 0.0, GREEN, "y  closing");
    sheet.name([0.0, 0.0, 0.07], [0.9, 0.1], 0.0, BLUE, "z  approach");
    sheet.name([0.0, 0.0, 0.0], [-0.1, 2.7], 1.0, INK, "finger base");
    sheet.name([0.0, 0.0, FINGER_DEPTH], [-1.1, 0.5], 1.0, INK, "TCP");
    sheet.name([0.0316, -0.09, -0.014], [0.0, 0.5], 0.0, INK, "palm");
    let front = breadth / 2.0;
    let (over, top) = (depth + 0.032, depth + 0.006);
    sheet.measure([0.0, -half, over], [0.0, half, over], [-2.7, -2.0], 0.5, "max_opening  0.08 m");
    sheet.measure([front, -half - thick, top], [front, -half, top], [-2.0, -1.6], 0.8, "finger_width  0.0264 m");
    sheet.measure([front, half + thick, top], [-front, half + thick, top], [1.2, -0.2], 0.0, "finger_breadth  0.021 m");
    let beside = half + thick + 0.010;
    sheet.measure([front, beside, 0.004], [front, beside, depth], [1.2, 0.4], 0.0, "finger_depth  0.05 m");
    sheet
}

/// The workspace, the table in it, a camera, and the frame in which it and the grasps are told.
fn frames() -> Sheet {
    let mut sheet = Sheet::new(0.365, [0.75, -1.42, 0.98], [0.095, 0.06, 0.216]);
    let size = WORKSPACE_SIZE;
    let along_z = |x: f64, y: f64, z: f64, turn: f64| Isometry3::new(Vector3::new(x, y, z), Vector3::z() * turn);
    sheet.block(Vector3::new(-0.36, -0.04, TABLE - 0.014), Vector3::new(0.34, 0.34, TABLE), [228, 224, 216]);
    let things = [
        (Mesh::cuboid(Vector3::new(0.045, 0.06, 0.12)), along_z(0.10, 0.20, TABLE + 0.06, 0.4), 2),
        (Mesh::cylinder(0.026, 0.10, 96), along_z(0.215, 0.19, TABLE + 0.05, 0.0), 1),
        (Mesh::sphere(0.032, 96), along_z(0.17, 0.085, TABLE + 0.032, 0.0), 0),
    ];
    for (mesh, pose, color) in things {
        sheet.solid.mesh(&mesh, &pose, 1.0, object_color(color));
    }
    // Down on the cylinder, the fingertips 3 cm below its top.
    let grasp = Isometry3::new(Vector3::new(0.215, 0.19, TABLE + 0.07 + FINGER_DEPTH), Vector3::x() * PI);
    sheet.solid.gripper(&grasp, 0.06, FINGER_DEPTH, GREEN);
    sheet.cube(size);

    let camera = looking_at([-0.25, 0.27, 0.38], [0.16, 0.15, 0.08]);
    sheet.depth_camera(&camera);
    let base = along_z(-0.25, -0.01, TABLE, 0.0);
    for pose in [Isometry3::identity(), camera, base] {
        sheet.axes(&pose, 0.09, 0.0024);
    }
    let [task, eye, base] = [Isometry3::identity(), camera, base].map(|pose| pose.translation.vector.into());
    sheet.arrow(base, task, [-1.4, 2.2], 1.0, "T_frame_task");
    sheet.arrow(base, eye, [-1.2, 0.5], 1.0, "T_frame_camera");
    sheet.arrow(eye, task, [-0.4, -7.6], 0.0, "T_camera_task");
    sheet.name(task, [-1.1, 2.0], 1.0, INK, "task frame");
    sheet.name(base, [-0.8, 2.2], 1.0, INK, "frame_id");
    sheet.name(eye, [0.0, -3.3], 0.5, INK, "camera");
    sheet.name([size, size, 0.0], [0.8, 0.8], 0.0, INK, "z = 0");
    sheet.name([size, size, TABLE], [1.5, 0.0], 0.0, INK, "table z = 0.05 m");
    sheet.name([size, size, size], [0.9, 0.2], 0.0, INK, "workspace 0.3 m");
    sheet
}

/// A picture, frames over it, lines and words over both. Positions are in `frame`, metres, offsets in letters.
struct Sheet {
    camera: Intrinsics,
    camera_from_task: Isometry3<f64>,
    solid: Picture,
    /// Lines between the picture and the frames.
    under: Vec<Stroke>,
    frames: Picture,
    strokes: Vec<Stroke>,
    /// In that of the picture.
    frame: Isometry3<f64>,
}

/// Lines of one colour, pixels.
struct Stroke {
    lines: Vec<Vec<Point2<f64>>>,
    width: f64,
    color: Color,
}

impl Sheet {
    /// Seen from `eye`, `view` radians from top to bottom.
    fn new(view: f64, eye: [f64; 3], target: [f64; 3]) -> Self {
        let [width, height] = SIZE;
        let focal = height as f64 / 2.0 / (view / 2.0).tan();
        let (cx, cy) = (width as f64 / 2.0 - 0.5, height as f64 / 2.0 - 0.5);
        let camera = Intrinsics { width, height, fx: focal, fy: focal, cx, cy };
        let camera_from_task = looking_at(eye, target).inverse();
        let picture = Picture::new(camera, camera_from_task);
        Self {
            camera,
            camera_from_task,
            solid: picture.clone(),
            frames: picture,
            under: Vec::new(),
            strokes: Vec::new(),
            frame: Isometry3::identity(),
        }
    }

    /// A box between two corners.
    fn block(&mut self, low: Vector3<f64>, high: Vector3<f64>, color: Color) {
        self.solid.mesh(&Mesh::cuboid(high - low), &(self.frame * Translation3::from((low + high) / 2.0)), 1.0, color);
    }

    fn ball(&mut self, at: [f64; 3], radius: f64, color: Color) {
        self.frames.mesh(&Mesh::sphere(radius, 48), &(self.frame * Translation3::from(at)), 1.0, color);
    }

    /// A frame: x red, y green, z blue.
    fn axes(&mut self, pose: &Isometry3<f64>, length: f64, radius: f64) {
        let (neck, wide) = (length - 8.0 * radius, 2.2 * radius);
        let arrow = Mesh::lathe(&[(radius, 0.0), (radius, neck), (wide, neck), (0.0, length)], 48);
        let quarter = FRAC_PI_2;
        let turns = [
            (Rotation3::from_axis_angle(&Vector3::y_axis(), quarter), RED),
            (Rotation3::from_axis_angle(&Vector3::x_axis(), -quarter), GREEN),
            (Rotation3::identity(), BLUE),
        ];
        for (turn, color) in turns {
            self.frames.mesh(&arrow, &(self.frame * pose * UnitQuaternion::from(turn)), 1.0, color);
        }
        self.frames.mesh(&Mesh::sphere(1.7 * radius, 32), &(self.frame * pose), 1.0, PAPER);
    }

    /// The edges of a cube of the task frame; thin on the sheet where the table hides them.
    fn cube(&mut self, size: f64) {
        for (x, y) in [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)] {
            let next = |z| [size - y, x, z];
            self.rod([x, y, 0.0], [x, y, size]);
            self.rod([x, y, size], next(size));
            self.rod([x, y, 0.0], next(0.0));
            let hidden = [([x, y, 0.0], [x, y, TABLE]), ([x, y, 0.0], next(0.0))];
            for (from, to) in hidden {
                let ends = [from, to].map(|end| self.project(end));
                self.under.push(Stroke { lines: dashes(ends), width: 1.2, color: INK });
            }
        }
    }

    fn rod(&mut self, from: [f64; 3], to: [f64; 3]) {
        let [from, to] = [from, to].map(Vector3::from);
        let size = (to - from).map(|edge| edge.abs() + 0.0018);
        self.solid.mesh(&Mesh::cuboid(size), &Translation3::from((from + to) / 2.0).into(), 1.0, INK);
    }

    /// A camera, and the edges of what it sees as far as the table.
    fn depth_camera(&mut self, pose: &Isometry3<f64>) {
        let body = Mesh::cuboid(Vector3::new(0.09, 0.024, 0.024));
        self.solid.mesh(&body, &(pose * Translation3::new(0.0, 0.0, -0.014)), 1.0, [120, 126, 136]);
        for x in [-0.03, 0.0, 0.03] {
            let lens = Mesh::cylinder(0.008, 0.006, 48);
            self.solid.mesh(&lens, &(pose * Translation3::new(x, 0.0, 0.0)), 1.0, [40, 42, 48]);
        }
        let eye = pose.translation.vector;
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| {
            let ray = pose * Vector3::new(0.28 * x, 0.21 * y, 1.0);
            let far = ((TABLE - eye.z) / ray.z).clamp(0.0, 1.0);
            self.project((eye + far * ray).into())
        });
        let eye = self.project(eye.into());
        let lines = (0..4).flat_map(|i| [vec![eye, corners[i]], vec![corners[i], corners[(i + 1) % 4]]]).collect();
        self.under.push(Stroke { lines, width: 1.2, color: [150, 160, 190] });
    }

    /// From one frame to another, with a name at its middle.
    fn arrow(&mut self, from: [f64; 3], to: [f64; 3], offset: [f64; 2], anchor: f64, words: &str) {
        let [from, to] = [from, to].map(|end| self.project(end));
        let along = (to - from).normalize();
        let (from, to) = (from + along * 14.0, to - along * 16.0);
        let across = Vector2::new(-along.y, along.x);
        let head = [1.0, -1.0].map(|side| to - along * 16.0 + across * 6.0 * side);
        self.draw(vec![vec![from, to], vec![head[0], to, head[1]]], 2.2, VIOLET);
        let middle = nalgebra::center(&from, &to) + LETTER * Vector2::from(offset);
        self.write(middle, anchor, VIOLET, words);
    }

    /// Where a point is on the sheet.
    fn project(&self, point: [f64; 3]) -> Point2<f64> {
        let p = self.camera_from_task * self.frame * Point3::from(point);
        Point2::new(p.x / p.z * self.camera.fx + self.camera.cx, p.y / p.z * self.camera.fy + self.camera.cy)
    }

    /// Words beside a point; `anchor` of their width is left of where the offset leads.
    fn name(&mut self, at: [f64; 3], offset: [f64; 2], anchor: f64, color: Color, words: &str) {
        let at = self.project(at) + LETTER * Vector2::from(offset);
        self.write(at, anchor, color, words);
    }

    /// A length, with its name at its middle.
    fn measure(&mut self, from: [f64; 3], to: [f64; 3], offset: [f64; 2], anchor: f64, words: &str) {
        let [a, b] = [from, to].map(|end| self.project(end));
        let across = (b - a).yx().component_mul(&Vector2::new(-1.0, 1.0)).normalize() * 7.0;
        let lines = vec![vec![a, b], vec![a - across, a + across], vec![b - across, b + across]];
        self.draw(lines, 2.0, INK);
        self.write(nalgebra::center(&a, &b) + LETTER * Vector2::from(offset), anchor, INK, words);
    }

    fn draw(&mut self, lines: Vec<Vec<Point2<f64>>>, width: f64, color: Color) {
        self.strokes.push(Stroke { lines: lines.clone(), width: width + 5.0, color: PAPER });
        self.strokes.push(Stroke { lines, width, color });
    }

    fn write(&mut self, at: Point2<f64>, anchor: f64, color: Color, words: &str) {
        let unit = LETTER / 4.0;
        let glyphs: Vec<_> = words.chars().map(glyph).collect();
        let width: f64 = glyphs.iter().map(|(_, width)| width + GAP).sum::<f64>() - GAP;
        let mut pen = -anchor * width;
        let mut lines = Vec::new();
        for (strokes, width) in glyphs {
            let place = |p: Point2<f64>| at + Vector2::new(p.x + pen, -p.y) * unit;
            lines.extend(strokes.into_iter().map(|line| line.into_iter().map(place).collect()));
            pen += width + GAP;
        }
        self.draw(lines, 2.3, color);
    }

    fn save(&self, name: &str) -> Result<(), Box<dyn Error>> {
        let Intrinsics { width, height, .. } = self.camera;
        let mut pixels = self.solid.pixels();
        self.under.iter().for_each(|stroke| stroke.paint(&mut pixels, width, height));
        for (under, over) in pixels.chunks_exact_mut(3).zip(self.frames.pixels().chunks_exact(3)) {
            if over != PAPER {
                under.copy_from_slice(over);
            }
        }
        self.strokes.iter().for_each(|stroke| stroke.paint(&mut pixels, width, height));
        // No eye sees it, and the file is a quarter smaller.
        pixels.iter_mut().for_each(|value| *value &= !1);
        let file = BufWriter::new(File::create(Path::new(DOCS).join(name))?);
        let mut encoder = Encoder::new(file, width as u32, height as u32);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::High);
        encoder.set_filter(Filter::Adaptive);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&pixels)?;
        Ok(writer.finish()?)
    }
}

impl Stroke {
    fn paint(&self, pixels: &mut [u8], width: usize, height: usize) {
        let reach = self.width / 2.0 + 1.0;
        let mut cover = vec![0.0_f64; width * height];
        for segment in self.lines.iter().flat_map(|line| line.windows(2)) {
            let [a, b] = [segment[0], segment[1]];
            let range = |a: f64, b: f64, size: usize| {
                let clamp = |x: f64| x.clamp(0.0, size as f64) as usize;
                clamp((a.min(b) - reach).floor())..clamp((a.max(b) + reach).ceil())
            };
            for v in range(a.y, b.y, height) {
                for u in range(a.x, b.x, width) {
                    let p = Point2::new(u as f64, v as f64);
                    let along = b - a;
                    let t = ((p - a).dot(&along) / along.norm_squared().max(1e-9)).clamp(0.0, 1.0);
                    let distance = (p - (a + along * t)).norm();
                    let cover = &mut cover[v * width + u];
                    *cover = cover.max((self.width / 2.0 + 0.5 - distance).clamp(0.0, 1.0));
                }
            }
        }
        for (pixel, cover) in pixels.chunks_exact_mut(3).zip(cover) {
            for (value, ink) in pixel.iter_mut().zip(self.color) {
                *value = (f64::from(*value) * (1.0 - cover) + f64::from(ink) * cover).round() as u8;
            }
        }
    }
}

/// `T_task_camera` of a camera at `eye`: z forward, x right, y down.
fn looking_at(eye: [f64; 3], target: [f64; 3]) -> Isometry3<f64> {
    let flip = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
    (flip * Isometry3::look_at_rh(&eye.into(), &target.into(), &Vector3::z())).inverse()
}

/// Parts of a line.
fn dashes([from, to]: [Point2<f64>; 2]) -> Vec<Vec<Point2<f64>>> {
    let count = ((to - from).norm() / 12.0).ceil();
    let at = |step: f64| from + (to - from) * (step / count);
    (0..count as u32).map(|step| vec![at(f64::from(step)), at(f64::from(step) + 0.5)]).collect()
}

/// Between letters, in quarters of a small one's height.
const GAP: f64 = 1.5;

/// A letter as lines and arcs, and its width; a small one is 4 high.
fn glyph(letter: char) -> (Vec<Vec<Point2<f64>>>, f64) {
    // L: a line through points; A: of an ellipse the centre, the radii, and from where to where, degrees.
    let (width, strokes) = match letter {
        'a' => (3.6, "A 1.8 2 1.8 2 0 360 L 3.6 0 3.6 4"),
        'b' => (3.6, "L 0 0 0 6.2 A 1.8 2 1.8 2 0 360"),
        'c' => (3.1, "A 1.9 2 1.9 2 48 312"),
        'd' => (3.6, "A 1.8 2 1.8 2 0 360 L 3.6 0 3.6 6.2"),
        'e' => (3.6, "L 0 2 3.6 2 A 1.8 2 1.8 2 0 318"),
        'f' => (2.2, "L 1 0 1 4.8 A 2.2 4.8 1.2 1.4 90 180 L 0 4 2.2 4"),
        'g' => (3.6, "A 1.8 2 1.8 2 0 360 L 3.6 4 3.6 -0.3 A 1.8 -0.3 1.8 1.7 210 360"),
        'h' => (3.2, "L 0 0 0 6.2 A 1.6 2.4 1.6 1.6 0 180 L 3.2 2.4 3.2 0"),
        'i' => (0.0, "L 0 0 0 4 L 0 5.7 0 5.8"),
        'k' => (3.0, "L 0 0 0 6.2 L 3 4 0 1.5 L 1.2 2.5 3 0"),
        'l' => (0.0, "L 0 0 0 6.2"),
        'm' => (5.2, "L 0 0 0 4 A 1.3 2.7 1.3 1.3 0 180 L 2.6 2.7 2.6 0 A 3.9 2.7 1.3 1.3 0 180 L 5.2 2.7 5.2 0"),
        'n' => (3.2, "L 0 0 0 4 A 1.6 2.4 1.6 1.6 0 180 L 3.2 2.4 3.2 0"),
        'o' => (3.8, "A 1.9 2 1.9 2 0 360"),
        'p' => (3.6, "L 0 -2 0 4 A 1.8 2 1.8 2 0 360"),
        'r' => (2.0, "L 0 0 0 4 A 1.6 2.4 1.6 1.6 65 180"),
        's' => (2.8, "A 1.4 3 1.3 1 35 270 A 1.4 1 1.4 1 -145 90"),
        't' => (2.3, "L 1 5.4 1 1.2 A 2.2 1.2 1.2 1.2 180 280 L 0 4 2.2 4"),
        'u' => (3.2, "L 0 4 0 1.6 A 1.6 1.6 1.6 1.6 180 360 L 3.2 4 3.2 0"),
        'v' => (3.2, "L 0 4 1.6 0 3.2 4"),
        'w' => (4.8, "L 0 4 1.2 0 2.4 4 3.6 0 4.8 4"),
        'x' => (3.0, "L 0 0 3 4 L 0 4 3 0"),
        'y' => (3.2, "L 0 4 1.6 0 L 3.2 4 0.8 -2"),
        'z' => (3.0, "L 0 4 3 4 0 0 3 0"),
        'C' => (4.2, "A 2.6 3 2.6 3 45 315"),
        'P' => (3.4, "L 0 0 0 6 1.9 6 A 1.9 4.5 1.5 1.5 -90 90 L 1.9 3 0 3"),
        'T' => (3.8, "L 0 6 3.8 6 L 1.9 6 1.9 0"),
        '0' => (3.6, "A 1.8 3 1.8 3 0 360"),
        '1' => (1.5, "L 0 4.9 1.5 6 1.5 0"),
        '2' => (3.3, "A 1.65 4.35 1.65 1.65 -38 170 L 2.95 3.33 0 0 3.3 0"),
        '3' => (3.3, "A 1.5 4.5 1.5 1.5 -90 155 A 1.5 1.5 1.7 1.5 -155 90"),
        '4' => (3.8, "L 2.8 0 2.8 6 0 1.7 3.8 1.7"),
        '5' => (3.3, "L 3 6 0.5 6 0.3 3.3 A 1.5 1.95 1.8 1.95 -150 128"),
        '6' => (3.5, "A 1.75 1.9 1.75 1.9 0 360 A 3.4 2.2 3.4 3.9 95 185"),
        '8' => (3.4, "A 1.7 4.6 1.4 1.4 0 360 A 1.7 1.6 1.7 1.6 0 360"),
        '.' => (0.0, "L 0 0 0 0.1"),
        '=' => (3.2, "L 0 1.4 3.2 1.4 L 0 3 3.2 3"),
        '_' => (3.4, "L 0 -0.9 3.4 -0.9"),
        _ => (1.2, ""),
    };
    let mut lines = Vec::new();
    for stroke in strokes.split_inclusive(|c: char| c.is_ascii_uppercase()).collect::<Vec<_>>().windows(2) {
        let kind = stroke[0].chars().last();
        let numbers: Vec<f64> = stroke[1].split_whitespace().filter_map(|number| number.parse().ok()).collect();
        lines.push(match (kind, &numbers[..]) {
            (Some('A'), &[x, y, rx, ry, from, to]) => {
                let at = |step: u32| (from + (to - from) * f64::from(step) / 32.0).to_radians().sin_cos();
                (0..=32).map(at).map(|(sin, cos)| Point2::new(x + rx * cos, y + ry * sin)).collect()
            }
            _ => numbers.chunks_exact(2).map(|p| Point2::new(p[0], p[1])).collect(),
        });
    }
    (lines, width)
}
