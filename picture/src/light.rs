//! The light of a picture.
//!
//! A few dozen lamps spread over the sky, most of them on one side, light the scene. Each lamp has a shadow map,
//! rendered with the depth camera. Together they give soft shadows and ambient occlusion.

use std::f64::consts::PI;

use grasp::Intrinsics;
use nalgebra::{Isometry3, Point3, Rotation3, Vector3};
use rayon::prelude::*;

use crate::color::{GRID, PAPER, TABLE_TOP, linear};
use crate::mesh::Mesh;
use crate::raster::{Instance, View, toward};

/// Lamps over the whole sky.
const SKY: usize = 28;
/// Lamps close together that act as the sun.
const SUN: usize = 12;
/// The sun's share of the light.
const SUN_SHARE: f64 = 0.68;
/// Pixels along each side of a lamp's shadow map.
const SHADOW_MAP: usize = 768;

/// The lamps of a scene.
pub(crate) struct Light {
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
    /// Lamps on a dome over the meshes that cast shadows (task frame).
    pub(crate) fn over(casters: &[&Mesh], table: Option<f64>) -> Light {
        let boxes: Vec<_> = casters.iter().flat_map(|mesh| <[_; 2]>::from(mesh.bounds())).collect();
        let (low, high) = Mesh { vertices: boxes, triangles: Vec::new() }.bounds();
        let centre = nalgebra::center(&low, &high);
        // A margin for the shadows beside the meshes.
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
        let lamp =
            |(direction, strength): (Vector3<f64>, f64)| Lamp::new(direction, strength, centre, radius, casters, table);
        Light { lamps: directions.into_par_iter().map(lamp).collect(), centre, radius }
    }

    /// Light at a point of a surface.
    pub(crate) fn at(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
        // The point is lifted off the surface by more than a pixel of the shadow map, so that the surface does not
        // shade itself.
        let lifted = point + normal * (self.radius * 3.5 / SHADOW_MAP as f64);
        let from = |lamp: &Lamp| lamp.strength * normal.dot(&lamp.direction).max(0.0) * lamp.reaches(&lifted);
        0.06 + self.lamps.iter().map(from).sum::<f64>()
    }

    /// Light on an annotation: without shadows and with a high ambient part.
    pub(crate) fn unshaded(&self, normal: &Vector3<f64>) -> f64 {
        0.55 + 0.45 * normal.dot(&self.lamps[SKY].direction).max(0.0)
    }

    /// Specular reflection of the sun.
    pub(crate) fn gloss(&self, normal: &Vector3<f64>, toward_eye: &Vector3<f64>) -> f64 {
        let sun = self.lamps[SKY].direction;
        let halfway = (sun + toward_eye).normalize();
        0.12 * normal.dot(&halfway).max(0.0).powi(40)
    }

    /// The colour of the table with its grid, which fades into the background far from the scene. `footprint` is the
    /// size of a pixel on the table, metres.
    pub(crate) fn table(&self, point: &Point3<f64>, footprint: f64) -> Vector3<f64> {
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
        casters: &[&Mesh],
        table: Option<f64>,
    ) -> Lamp {
        let distance = 6.0 * radius;
        let camera_from_task = toward(centre + direction * distance, centre);
        let focal = SHADOW_MAP as f64 / 2.0 * distance / (1.35 * radius);
        let middle = SHADOW_MAP as f64 / 2.0;
        let camera = Intrinsics { width: SHADOW_MAP, height: SHADOW_MAP, fx: focal, fy: focal, cx: middle, cy: middle };
        let mut view = View::new(&camera, &camera_from_task, radius, 20.0 * radius);
        for mesh in casters {
            view.draw(&Instance::new(mesh), |_, _| ());
        }
        // The table also shades meshes below it.
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
