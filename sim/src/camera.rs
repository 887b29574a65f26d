//! The simulated depth camera: poses, rendering and noise.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, TAU};
use std::ops::{Range, RangeInclusive};

use grasp::{DepthImage, Fusion, Intrinsics, SurfacePoint};
pub use grasp_data::raw::View;
use grasp_perception::{TARGET_HEIGHT, TRAINED_ANGLE, TRAINED_DISTANCE, image_depth_factor};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, Gamma, Normal};

use crate::TABLE_HEIGHT;
use crate::physics::World;
use grasp_picture::{Instance, render, toward};

/// Smallest measured depth, metres.
const NEAR: f64 = 0.1;

/// Greatest measured depth, metres.
const FAR: f64 = 2.0;

/// Greatest difference of a [`Views::RandomSide`] from the paper's azimuth, radians.
const JITTER: f64 = TAU / 72.0;

/// Camera poses of an observation.
#[derive(Clone, Debug, PartialEq)]
pub enum Views {
    /// The single fixed side view of GIGA and the paper, rotated by `azimuth` about the vertical.
    Side {
        /// Radians; 0 is the paper's view.
        azimuth: f64,
    },
    /// One random view from the paper's side: its azimuth ±5°, polar angle 30–75°, distance 0.48–0.72 m.
    RandomSide,
    /// VGN's six views on a circle, 30° from the vertical.
    Circle,
    /// Random views, their number in this range: any azimuth, polar angle 20–75°, distance 0.48–0.72 m.
    Random(RangeInclusive<usize>),
    /// One of these, drawn for every observation.
    OneOf(Vec<Views>),
}

impl Views {
    /// The cameras' poses (`T_camera_task`).
    pub fn sample(&self, rng: &mut impl Rng) -> Vec<Isometry3<f64>> {
        match self {
            Self::OneOf(choices) => choices.choose(rng).map_or_else(Vec::new, |views| views.sample(rng)),
            Self::Side { azimuth } => {
                vec![look_at(&Point3::new(0.15, 0.15, 0.1), 0.6, FRAC_PI_3, azimuth - FRAC_PI_2)]
            }
            Self::RandomSide => vec![random_view(30.0..75.0, -FRAC_PI_2 - JITTER..-FRAC_PI_2 + JITTER, rng)],
            Self::Circle => (0..6)
                .map(|i| look_at(&Point3::new(0.15, 0.15, 0.0), 0.6, TAU / 12.0, f64::from(i) * TAU / 6.0))
                .collect(),
            Self::Random(count) => {
                let count = rng.random_range(count.clone());
                let [low, high] = TRAINED_ANGLE;
                (0..count).map(|_| random_view(low..high, 0.0..TAU, rng)).collect()
            }
        }
    }
}

/// A camera at a random distance, at a random angle from the vertical (degrees) and azimuth (radians).
fn random_view(polar: Range<f64>, azimuth: Range<f64>, rng: &mut impl Rng) -> Isometry3<f64> {
    let [near, far] = TRAINED_DISTANCE;
    let (distance, polar) = (rng.random_range(near..far), rng.random_range(polar).to_radians());
    let azimuth = rng.random_range(azimuth);
    look_at(&Point3::new(0.15, 0.15, TARGET_HEIGHT), distance, polar, azimuth)
}

/// `T_camera_task` of an upright camera at `distance` (metres) from `target`, at the angle `polar` from the vertical
/// and `azimuth` about it (radians).
#[must_use]
pub fn look_at(target: &Point3<f64>, distance: f64, polar: f64, azimuth: f64) -> Isometry3<f64> {
    let direction = Vector3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
    toward(target + direction * distance, *target)
}

/// Renders the scene's depth from each camera, without noise.
#[must_use]
pub fn look(world: &World, cameras: &[Isometry3<f64>]) -> Vec<View> {
    let instances: Vec<Instance> = world
        .objects()
        .iter()
        .zip(0..)
        .map(|(body, id)| Instance { mesh: &body.object.visual, pose: world.pose(body.id), scale: body.scale, id })
        .collect();
    cameras
        .iter()
        .map(|camera_from_task| {
            let frame = render(&instances, Some(TABLE_HEIGHT), &Intrinsics::BENCHMARK, camera_from_task, NEAR, FAR);
            View { depth: frame.depth, camera_from_task: *camera_from_task }
        })
        .collect()
}

/// A sensor whose depth noise is simulated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sensor {
    /// The noise of the benchmark, [`add_noise`].
    Dex,
    /// A stereo camera, [`add_stereo_noise`].
    Stereo,
}

/// Depth noise of the observations of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthNoise {
    /// Share of the observations with noise.
    pub share: f64,
    /// The sensor.
    pub sensor: Sensor,
    /// Whether the scale of the depths is corrected by the table, as by a graspd with `Workspace.correct_depth_scale`.
    pub is_scale_corrected: bool,
}

impl DepthNoise {
    /// No noise.
    pub const NONE: Self = Self { share: 0.0, sensor: Sensor::Dex, is_scale_corrected: false };

    /// The noise of the benchmark in all observations.
    pub const BENCHMARK: Self = Self { share: 1.0, sensor: Sensor::Dex, is_scale_corrected: false };
}

/// Renders the scene from cameras drawn from `views`.
#[must_use]
pub fn observe(world: &World, views: &Views, noise: DepthNoise, rng: &mut impl Rng) -> Vec<View> {
    let mut views = look(world, &views.sample(rng));
    if rng.random_bool(noise.share) {
        views.iter_mut().for_each(|view| match noise.sensor {
            Sensor::Dex => add_noise(view, rng),
            Sensor::Stereo => add_stereo_noise(view, rng),
        });
    }
    if noise.is_scale_corrected {
        views.iter_mut().for_each(correct_scale);
    }
    views
}

/// Multiplies the depths by the factor that puts the table at its height, if it is in view.
fn correct_scale(view: &mut View) {
    let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).expect("views are of the benchmark's camera");
    let extent = [grasp::WORKSPACE_SIZE; 2];
    if let Some(factor) = image_depth_factor(&image, &view.camera_from_task, TABLE_HEIGHT, extent) {
        view.depth.iter_mut().for_each(|depth| *depth *= factor as f32);
    }
}

/// Adds the noise of GIGA's evaluation (Dex-Net's model): one Gamma(1000, 0.001) factor per image, and with probability
/// 0.5 additive N(0, 5 mm), drawn on a quarter-resolution grid and interpolated bilinearly.
pub fn add_noise(view: &mut View, rng: &mut impl Rng) {
    let gamma = Gamma::new(1000.0f32, 0.001).expect("both parameters are positive");
    let factor = gamma.sample(rng);
    view.depth.iter_mut().for_each(|d| *d *= factor);
    if rng.random_bool(0.5) {
        let normal = Normal::new(0.0f32, 0.005).expect("the deviation is finite");
        let Intrinsics { width, height, .. } = Intrinsics::BENCHMARK;
        let (w, h) = (width / 4, height / 4);
        let coarse: Vec<f32> = (0..w * h).map(|_| normal.sample(rng)).collect();
        let at = |pixel: usize, cells: usize| {
            let x = ((pixel as f32 + 0.5) / 4.0 - 0.5).clamp(0.0, (cells - 1) as f32);
            let cell = (x as usize).min(cells - 2);
            (cell, x - cell as f32)
        };
        for v in 0..height {
            let (row, fv) = at(v, h);
            for u in 0..width {
                let d = &mut view.depth[v * width + u];
                if *d > 0.0 {
                    let (col, fu) = at(u, w);
                    let cell = |r: usize, c: usize| coarse[r * w + c];
                    let upper = cell(row, col) * (1.0 - fu) + cell(row, col + 1) * fu;
                    let lower = cell(row + 1, col) * (1.0 - fu) + cell(row + 1, col + 1) * fu;
                    *d += upper * (1.0 - fv) + lower * fv;
                }
            }
        }
    }
}

/// The noise of a stereo camera: errors that grow with the square of the depth, in steps, holes at the edges of objects,
/// and flying pixels between them and what is behind. Pixels without a measurement stay 0.
pub fn add_stereo_noise(view: &mut View, rng: &mut impl Rng) {
    let width = Intrinsics::BENCHMARK.width;
    let clean = view.depth.clone();
    for (index, depth) in view.depth.iter_mut().enumerate() {
        let behind = clean.get(index + 2).filter(|_| index % width + 2 < width).copied().unwrap_or(*depth);
        let edge = (behind - *depth).abs() > 0.02;
        let noisy = if rng.random_bool(if edge { 0.5 } else { 0.02 }) {
            0.0
        } else if edge {
            rng.random_range(depth.min(behind)..=depth.max(behind))
        } else {
            // A disparity of a fifth of a pixel, at a baseline of 50 mm and a focal length of 540 pixels.
            let step = *depth * *depth / (540.0 * 0.05) * 0.2;
            ((*depth + step * rng.random_range(-1.0..1.0)) / step).round() * step
        };
        // No pixel flies between a surface and a pixel without a measurement.
        let is_unmeasured = *depth == 0.0 || edge && behind == 0.0;
        *depth = if is_unmeasured { 0.0 } else { noisy };
    }
}

/// Fuses views into a field of `resolution`³ voxels over the workspace.
#[must_use]
pub fn fuse(views: &[View], resolution: usize) -> Fusion {
    let mut fusion = Fusion::new(resolution, grasp::WORKSPACE_SIZE);
    for (image, camera_from_task) in images(views) {
        fusion.integrate(&image, &camera_from_task);
    }
    fusion
}

/// The depth images of views, with their `T_camera_task`.
pub fn images(views: &[View]) -> impl Iterator<Item = (DepthImage<'_>, Isometry3<f64>)> {
    views.iter().map(|view| {
        let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).expect("views are of the benchmark's camera");
        (image, view.camera_from_task)
    })
}

/// The point cloud of the views in the task frame: one point for every pixel with a depth.
#[must_use]
pub fn points(views: &[View]) -> Vec<SurfacePoint> {
    images(views).flat_map(|(image, pose)| image.points(&pose).collect::<Vec<_>>()).collect()
}
