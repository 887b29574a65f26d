//! The depth camera: a z-buffer rasteriser.
//!
//! Pixel (u, v) samples the ray through ((u − cx)/fx, (v − cy)/fy, 1) in the camera frame: z forward, x right, y down,
//! pixel centres at whole coordinates. The depth of a pixel is that of the triangle's plane along the ray, so it is
//! exact for the mesh.

use std::f64::consts::PI;

use grasp::Intrinsics;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

use crate::mesh::Mesh;

/// The id of pixels without a surface.
pub const NOTHING: u16 = u16::MAX;
/// The id of pixels that show the table.
pub const TABLE: u16 = u16::MAX - 1;

/// Screen coordinates are rounded to this fraction of a pixel, so that coverage is computed in integers and two
/// triangles agree exactly on their shared edge.
const SUBPIXELS: f64 = 256.0;
/// Screen coordinates are clamped to ± this many pixels, so that their products fit into 64 bits.
const FARTHEST_PIXEL: f64 = 4_194_304.0;

/// A mesh in the scene.
#[derive(Clone, Copy, Debug)]
pub struct Instance<'a> {
    /// The surface. Both sides are visible.
    pub mesh: &'a Mesh,
    /// `T_task_mesh`, applied after the scale.
    pub pose: Isometry3<f64>,
    /// Scale of the mesh about its own origin.
    pub scale: f64,
    /// The id of its pixels.
    pub id: u16,
}

impl Instance<'_> {
    /// A mesh in the task frame.
    pub(crate) fn new(mesh: &Mesh) -> Instance<'_> {
        Instance { mesh, pose: Isometry3::identity(), scale: 1.0, id: 0 }
    }
}

/// The images of the camera, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Metres along the optical axis; 0 where there is no surface.
    pub depth: Vec<f32>,
    /// The [`Instance::id`] of each pixel, [`TABLE`] or [`NOTHING`].
    pub ids: Vec<u16>,
}

/// `T_camera_task` of a camera at `eye` that looks at `target` (task frame, metres), with z up in its picture.
pub fn toward(eye: Point3<f64>, target: Point3<f64>) -> Isometry3<f64> {
    let forward = (target - eye).normalize();
    // For a vertical view any up direction works.
    let up = if forward.xy().norm() < 1e-6 { Vector3::y() } else { Vector3::z() };
    // look_at_rh has y up and z backward; the optical frame has y down and z forward.
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI) * Isometry3::look_at_rh(&eye, &target, &up)
}

/// Renders the instances, and optionally the infinite horizontal plane at the height `table` (task frame, metres),
/// between the depths `near` and `far` (metres).
///
/// `camera_from_task` is `T_camera_task`.
pub fn render(
    instances: &[Instance],
    table: Option<f64>,
    camera: &Intrinsics,
    camera_from_task: &Isometry3<f64>,
    near: f64,
    far: f64,
) -> Frame {
    let mut view = View::new(camera, camera_from_task, near, far);
    let mut ids = vec![NOTHING; view.depth.len()];
    for instance in instances {
        view.draw(instance, |pixel, _| ids[pixel] = instance.id);
    }
    if let Some(height) = table {
        view.draw_table(height, |pixel| ids[pixel] = TABLE);
    }
    let seen = |z: f32| if z.is_finite() { z } else { 0.0 };
    let depth = view.depth.iter().map(|&z| seen(z)).collect();
    Frame { width: camera.width, height: camera.height, depth, ids }
}

/// A camera with its z-buffer.
pub(crate) struct View<'a> {
    camera: &'a Intrinsics,
    camera_from_task: &'a Isometry3<f64>,
    near: f64,
    /// Depth of the nearest surface so far, row by row; infinite without one.
    pub(crate) depth: Vec<f32>,
    far: f64,
    /// Vertices of the current instance in the camera frame. Kept between instances to reuse the allocation.
    vertices: Vec<Point3<f64>>,
}

impl<'a> View<'a> {
    pub(crate) fn new(camera: &'a Intrinsics, camera_from_task: &'a Isometry3<f64>, near: f64, far: f64) -> View<'a> {
        let depth = vec![f32::INFINITY; camera.width * camera.height];
        View { camera, camera_from_task, near, depth, far, vertices: Vec::new() }
    }

    /// Draws an instance and calls `hit(pixel, triangle)` for every pixel where it is the nearest so far.
    pub(crate) fn draw(&mut self, instance: &Instance, mut hit: impl FnMut(usize, usize)) {
        let camera_from_mesh = self.camera_from_task * instance.pose;
        let mut vertices = std::mem::take(&mut self.vertices);
        vertices.clear();
        vertices.extend(instance.mesh.vertices.iter().map(|p| camera_from_mesh * (p * instance.scale)));
        for (index, triangle) in instance.mesh.triangles.iter().enumerate() {
            self.draw_triangle(triangle.map(|i| vertices[i as usize]), |pixel| hit(pixel, index));
        }
        self.vertices = vertices;
    }

    /// Draws the plane z = `height` of the task frame and calls `hit(pixel)` for every pixel where it is the nearest so
    /// far.
    pub(crate) fn draw_table(&mut self, height: f64, mut hit: impl FnMut(usize)) {
        let normal = self.camera_from_task * Vector3::z();
        let offset = normal.dot(&(self.camera_from_task * Point3::new(0.0, 0.0, height)).coords);
        let plane = self.inverse_depth(normal, offset);
        for v in 0..self.camera.height {
            for u in 0..self.camera.width {
                let depth = 1.0 / plane.at(u, v);
                let pixel = v * self.camera.width + u;
                if depth >= self.near && depth <= self.far && (depth as f32) < self.depth[pixel] {
                    self.depth[pixel] = depth as f32;
                    hit(pixel);
                }
            }
        }
    }

    /// Draws one triangle given in the camera frame, clipped at the near plane.
    fn draw_triangle(&mut self, corners: [Point3<f64>; 3], mut hit: impl FnMut(usize)) {
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        let inverse_depth = self.inverse_depth(normal, normal.dot(&corners[0].coords));
        if corners.iter().all(|p| p.z >= self.near) {
            return self.fill(corners, inverse_depth, &mut hit);
        }
        let (polygon, count) = clip(corners, self.near);
        for i in 2..count {
            self.fill([polygon[0], polygon[i - 1], polygon[i]], inverse_depth, &mut hit);
        }
    }

    /// Fills the pixels of a triangle in front of the near plane.
    fn fill(&mut self, corners: [Point3<f64>; 3], inverse_depth: Affine, hit: &mut impl FnMut(usize)) {
        let [a, b, c] = corners.map(|p| self.project(p));
        let (b, c) = match turn(a, b, c) {
            0 => return,
            area if area > 0 => (b, c),
            _ => (c, b),
        };
        let Some((columns, rows)) = self.covered([a, b, c]) else { return };
        let edges = [Edge::new(a, b), Edge::new(b, c), Edge::new(c, a)];
        // At the rim of a triangle seen edge-on, the rounding of coverage can extrapolate the plane far. The depth is
        // clamped to those of the corners.
        let nearest = corners.iter().fold(f64::INFINITY, |z, p| z.min(p.z));
        let farthest = corners.iter().fold(0.0, |z: f64, p| z.max(p.z));
        for v in rows {
            let mut sides = edges.each_ref().map(|edge| edge.at(columns.start, v));
            for u in columns.clone() {
                // Inside if no side is negative, that is, if no sign bit is set.
                if sides[0] | sides[1] | sides[2] >= 0 {
                    let depth = (1.0 / inverse_depth.at(u, v)).clamp(nearest, farthest);
                    let pixel = v * self.camera.width + u;
                    if depth <= self.far && (depth as f32) < self.depth[pixel] {
                        self.depth[pixel] = depth as f32;
                        hit(pixel);
                    }
                }
                for (side, edge) in sides.iter_mut().zip(&edges) {
                    *side += edge.step;
                }
            }
        }
    }

    /// Projects a point in front of the camera, in units of 1 / [`SUBPIXELS`] pixel.
    fn project(&self, p: Point3<f64>) -> [i64; 2] {
        let screen = [self.camera.fx * p.x / p.z + self.camera.cx, self.camera.fy * p.y / p.z + self.camera.cy];
        screen.map(|x| (x.clamp(-FARTHEST_PIXEL, FARTHEST_PIXEL) * SUBPIXELS).round() as i64)
    }

    /// Columns and rows covered by the bounding box of a screen triangle.
    fn covered(&self, corners: [[i64; 2]; 3]) -> Option<(std::ops::Range<usize>, std::ops::Range<usize>)> {
        let span = |axis: usize, size: usize| {
            let [a, b, c] = corners.map(|corner| corner[axis]);
            let first = (a.min(b).min(c) + SUBPIXELS as i64 - 1).div_euclid(SUBPIXELS as i64).max(0);
            let last = a.max(b).max(c).div_euclid(SUBPIXELS as i64).min(size as i64 - 1);
            (first <= last).then(|| first as usize..last as usize + 1)
        };
        Some((span(0, self.camera.width)?, span(1, self.camera.height)?))
    }

    /// 1 / depth of the plane normal · x = offset (camera frame), an affine function of the pixel.
    fn inverse_depth(&self, normal: Vector3<f64>, offset: f64) -> Affine {
        let (u, v) = (normal.x / self.camera.fx, normal.y / self.camera.fy);
        let constant = normal.z - u * self.camera.cx - v * self.camera.cy;
        Affine { u: u / offset, v: v / offset, constant: constant / offset }
    }
}

/// An affine function of the pixel.
#[derive(Clone, Copy)]
struct Affine {
    u: f64,
    v: f64,
    constant: f64,
}

impl Affine {
    fn at(&self, u: usize, v: usize) -> f64 {
        self.u * u as f64 + self.v * v as f64 + self.constant
    }
}

/// One side of a screen triangle in clockwise order on the screen (y down).
struct Edge {
    from: [i64; 2],
    direction: [i64; 2],
    /// 0 for top and left edges, which own the pixels on them, else −1.
    bias: i64,
    /// Change of [`Edge::at`] from one column to the next.
    step: i64,
}

impl Edge {
    fn new(from: [i64; 2], to: [i64; 2]) -> Edge {
        let direction = [to[0] - from[0], to[1] - from[1]];
        let owns = direction[1] < 0 || (direction[1] == 0 && direction[0] > 0);
        Edge { from, direction, bias: if owns { 0 } else { -1 }, step: -direction[1] * SUBPIXELS as i64 }
    }

    /// At least 0 if the centre of pixel (u, v) is inside.
    fn at(&self, u: usize, v: usize) -> i64 {
        let [x, y] = [u, v].map(|pixel| pixel as i64 * SUBPIXELS as i64);
        self.direction[0] * (y - self.from[1]) - self.direction[1] * (x - self.from[0]) + self.bias
    }
}

/// Twice the signed area of a screen triangle; positive if it is clockwise on the screen (y down).
fn turn(a: [i64; 2], b: [i64; 2], c: [i64; 2]) -> i64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// The part of a triangle with z ≥ `near`: up to four corners, and their number.
fn clip(corners: [Point3<f64>; 3], near: f64) -> ([Point3<f64>; 4], usize) {
    let mut polygon = [Point3::origin(); 4];
    let mut count = 0;
    let mut push = |p| {
        polygon[count] = p;
        count += 1;
    };
    for i in 0..3 {
        let (p, q) = (corners[i], corners[(i + 1) % 3]);
        if p.z >= near {
            push(p);
        }
        if (p.z >= near) != (q.z >= near) {
            // Always interpolated from the same end, so that neighbouring triangles get the same point.
            let (p, q) = if p.z < q.z { (p, q) } else { (q, p) };
            let mut cut = p + (q - p) * ((near - p.z) / (q.z - p.z));
            cut.z = near;
            push(cut);
        }
    }
    (polygon, count)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 320, height: 240, fx: 270.0, fy: 265.0, cx: 158.3, cy: 121.1 };

    fn instance(mesh: &Mesh, pose: Isometry3<f64>) -> Instance<'_> {
        Instance { mesh, pose, scale: 1.0, id: 3 }
    }

    fn ray(u: usize, v: usize) -> Vector3<f64> {
        Vector3::new((u as f64 - CAMERA.cx) / CAMERA.fx, (v as f64 - CAMERA.cy) / CAMERA.fy, 1.0)
    }

    /// Compares a frame with the expected depth along every ray; `None` skips pixels at a rim.
    fn assert_depths(frame: &Frame, tolerance: f64, expected: impl Fn(usize, usize) -> Option<f64>) {
        let mut compared = 0;
        for v in 0..frame.height {
            for u in 0..frame.width {
                let Some(expected) = expected(u, v) else { continue };
                let depth = f64::from(frame.depth[v * frame.width + u]);
                assert!((depth - expected).abs() < tolerance, "({u}, {v}): {depth} instead of {expected}");
                compared += 1;
            }
        }
        assert!(compared > frame.depth.len() / 2);
    }

    #[test]
    fn table_and_a_large_quad_have_the_same_depth() {
        let pose = toward(Point3::new(0.5, -0.2, 0.45), Point3::new(0.15, 0.15, 0.05));
        let table = render(&[], Some(0.05), &CAMERA, &pose, 0.1, 2.0);
        assert!(table.ids.iter().filter(|&&id| id == TABLE).count() > 50_000);
        let quad = Mesh::cuboid(Vector3::new(20.0, 20.0, 1.0));
        let quad = instance(&quad, Isometry3::translation(0.0, 0.0, -0.45));
        let quad = render(&[quad], None, &CAMERA, &pose, 0.1, 2.0);
        for (a, b) in table.depth.iter().zip(&quad.depth) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }

    #[test]
    fn a_sphere_has_the_depth_of_a_sphere() {
        let (radius, centre) = (0.1, Vector3::new(0.03, -0.02, 0.3));
        let mesh = Mesh::sphere(radius, 400);
        let sphere = instance(&mesh, Isometry3::translation(centre.x, centre.y, centre.z));
        let frame = render(&[sphere], None, &CAMERA, &Isometry3::identity(), 0.1, 2.0);
        assert_depths(&frame, 1e-4, |u, v| {
            let ray = ray(u, v);
            let along = ray.dot(&centre) / ray.norm_squared();
            let miss = (ray * along - centre).norm();
            if miss > radius {
                return Some(0.0).filter(|_| miss > radius * 1.02);
            }
            let depth = along - ((radius * radius - miss * miss) / ray.norm_squared()).sqrt();
            Some(depth).filter(|_| miss < radius * 0.97)
        });
    }

    #[test]
    fn a_box_occludes_objects_behind_it_and_fills_its_silhouette() {
        // Faces at z = 0.4 and 0.5, edges at x, y = ±0.1.
        let mesh = Mesh::cuboid(Vector3::new(2.0, 2.0, 1.0));
        let near = Instance { mesh: &mesh, pose: Isometry3::translation(0.0, 0.0, 0.45), scale: 0.1, id: 1 };
        let far = Instance { pose: Isometry3::translation(0.0, 0.0, 0.65), id: 2, ..near };
        let one = render(&[near, far], None, &CAMERA, &Isometry3::identity(), 0.1, 2.0);
        let other = render(&[far, near], None, &CAMERA, &Isometry3::identity(), 0.1, 2.0);
        assert_eq!(one, other);
        for v in 0..CAMERA.height {
            for u in 0..CAMERA.width {
                let ray = ray(u, v);
                let inside = (ray * 0.4).xy().amax() <= 0.1;
                assert_eq!(one.ids[v * CAMERA.width + u], if inside { 1 } else { NOTHING }, "({u}, {v})");
                assert!(!inside || (one.depth[v * CAMERA.width + u] - 0.4).abs() < 1e-7);
            }
        }
    }

    #[test]
    fn neighbouring_triangles_share_no_pixel_and_leave_no_gap() {
        let mesh = Mesh::sphere(0.1, 90);
        let pose = toward(Point3::new(0.31, 0.17, 0.23), Point3::new(0.01, 0.0, 0.0));
        let mut view = View::new(&CAMERA, &pose, 0.01, 2.0);
        let mut front = vec![0; view.depth.len()];
        let (eye, sphere) = (pose.inverse_transform_point(&Point3::origin()), instance(&mesh, Isometry3::identity()));
        for &triangle in &mesh.triangles {
            let facing = mesh.area_normal(triangle).dot(&(eye - mesh.corners(triangle)[0])) > 0.0;
            if facing {
                let alone = Mesh { vertices: mesh.vertices.clone(), triangles: vec![triangle] };
                view.depth.fill(f32::INFINITY);
                view.draw(&Instance { mesh: &alone, ..sphere }, |pixel, _| front[pixel] += 1);
            }
        }
        assert!(front.iter().all(|&count| count <= 1));
        for row in front.chunks(CAMERA.width) {
            let covered: Vec<_> = (0..row.len()).filter(|&u| row[u] == 1).collect();
            assert!(covered.windows(2).all(|pair| pair[1] == pair[0] + 1));
        }
    }

    #[test]
    fn surfaces_are_clipped_at_the_near_and_the_far_plane() {
        // The camera is above a long floor that extends behind it.
        let floor = Mesh::cuboid(Vector3::new(10.0, 1.0, 10.0));
        let floor = instance(&floor, Isometry3::translation(0.0, 0.6, 0.0));
        let frame = render(&[floor], None, &CAMERA, &Isometry3::identity(), 0.3, 1.5);
        assert_depths(&frame, 1e-6, |_, v| {
            let depth = 0.1 * CAMERA.fy / (v as f64 - CAMERA.cy);
            // Where the floor is clipped, its underside is visible but lies beyond the far plane.
            Some(if (0.3..=1.5).contains(&depth) { depth } else { 0.0 })
        });
    }
}
