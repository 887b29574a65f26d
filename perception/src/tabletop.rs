//! The table in a depth image of which only the intrinsics are known.

use grasp::{DEPTH_MAX, DepthImage, WORKSPACE_SIZE};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, SymmetricEigen, Translation3, Unit, UnitQuaternion, Vector3};
use thiserror::Error;

use crate::layout::{OBJECT_MARGIN, cover_objects};
use crate::segmentation::Segmentation;

/// A table in a depth image, and a workspace on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tabletop {
    /// `T_camera_task`: the workspace, a cube of [`WORKSPACE_SIZE`], holds most of what stands on the table near the
    /// middle of the image. Its z axis is the normal of the table, its x axis points to the right in the image, and the
    /// table is at the height that [`find`](Self::find) was given.
    pub camera_from_task: Isometry3<f64>,
    /// Distance of the camera from the plane of the table, metres.
    pub distance: f64,
    /// Angle between the optical axis and the normal of the table, radians: 0 if the camera looks straight down.
    pub angle: f64,
    /// Share of the image's pixels that lie on the table. Pixels count less the farther they are from its middle.
    pub share: f64,
    /// Root mean square distance of these pixels from the plane, metres.
    pub deviation: f64,
    /// Angle between the normal of the table and the vertical, radians; `None` if gravity is unknown.
    pub tilt: Option<f64>,
}

/// Why no table was found.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum NoTabletop {
    /// The image has too few pixels with depth.
    #[error(
        "{} a depth of at most {DEPTH_MAX} m; a table needs {:.0} % of the image; check the depth unit",
        if *share > 0.0 { format!("only {:.1} % of the image has", share * 100.0) } else { "no pixel has".to_owned() },
        FEWEST * 100.0
    )]
    FewReadings {
        /// Share of the pixels with a depth.
        share: f64,
    },
    /// No plane is large enough.
    #[error(
        "the largest {}plane near the middle of the image covers {:.0} % of it; a table needs {:.0} %. Point the camera at \
         the table{}",
        if *with_gravity { "level " } else { "" },
        share * 100.0,
        SMALLEST * 100.0,
        if *with_gravity { ", and check the direction of gravity" } else { "" }
    )]
    NoPlane {
        /// Its share of the pixels.
        share: f64,
        /// Whether planes that are not level were left out.
        with_gravity: bool,
    },
}

/// Smallest share of the pixels with a depth.
const FEWEST: f64 = 0.05;

/// Smallest share of the pixels on the table.
const SMALLEST: f64 = 0.12;

/// Points are sampled from about this many pixels.
const POINTS: f64 = 3000.0;

/// Planes are proposed at about this many pixels.
const PROPOSALS: f64 = 400.0;

/// Distance between the pixels that propose a plane, as a fraction of the image's width. Several are tried: short ones
/// find small planes, long ones are accurate.
const BASELINES: [f64; 2] = [0.03, 0.08];

/// Standard deviation of the weight of pixels around the middle, as a fraction of half the diagonal.
const MIDDLE: f64 = 0.45;

/// Largest angle between the table's normal and the vertical, radians.
const LEVEL: f64 = 12.0 * std::f64::consts::PI / 180.0;

/// Error of the angle between a plane and the vertical, radians. Of the large planes, only those that are within this
/// of the most level one are considered.
const LEVEL_ERROR: f64 = 3.0 * std::f64::consts::PI / 180.0;

/// A plane below the largest one is the table, if it is parallel, in this range of distances below it, metres, and at
/// least this large in comparison: the top of a large object covers the middle of the image. What is farther below is
/// the floor around a bin or a table.
const BELOW: std::ops::Range<f64> = 0.02..0.2;
const LARGE: f64 = 0.35;

/// Largest angle between parallel planes, radians.
const PARALLEL: f64 = 5.0 * std::f64::consts::PI / 180.0;

/// A sampled pixel.
struct Sample {
    /// In the camera frame, metres.
    point: Point3<f64>,
    weight: f64,
}

/// Points with `normal · point = offset`. The normal points to the camera.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: Unit<Vector3<f64>>,
    offset: f64,
}

impl Tabletop {
    /// Finds the largest plane near the middle of the image. `gravity` is the direction of gravity in the camera frame;
    /// an accelerometer at rest measures the opposite. With it, only level planes are considered; without it, a wall
    /// that fills the image is taken for a table. `height` is the height of the table in the workspace, metres.
    ///
    /// # Errors
    /// [`NoTabletop`] if there is no plane large enough.
    pub fn find(image: &DepthImage, gravity: Option<Unit<Vector3<f64>>>, height: f64) -> Result<Self, NoTabletop> {
        Self::find_with_objects(image, gravity, height).map(|(table, _)| table)
    }

    /// Finds the table, and what stands on it. The points of the objects are in the frame of the workspace.
    pub(crate) fn find_with_objects(
        image: &DepthImage,
        gravity: Option<Unit<Vector3<f64>>>,
        height: f64,
    ) -> Result<(Self, Segmentation), NoTabletop> {
        let samples = samples(image);
        let (camera, step) = (image.intrinsics(), stride(image, POINTS));
        let pixels = (camera.width.div_ceil(step) * camera.height.div_ceil(step)) as f64;
        let share = samples.len() as f64 / pixels;
        if share < FEWEST {
            return Err(NoTabletop::FewReadings { share });
        }
        let is_level = |plane: &Plane| gravity.is_none_or(|down| plane.normal.angle(&-down.into_inner()) <= LEVEL);
        let mut scored: Vec<(f64, Plane)> = proposals(image)
            .filter(is_level)
            .map(|plane| (samples.iter().filter(|sample| plane.has(sample)).map(|sample| sample.weight).sum(), plane))
            .collect();
        scored.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let all: f64 = samples.iter().map(|sample| sample.weight).sum();
        let none = |share| NoTabletop::NoPlane { share, with_gravity: gravity.is_some() };
        let &(most, _) = scored.first().ok_or_else(|| none(0.0))?;
        let tilt = |plane: &Plane| gravity.map_or(0.0, |down| plane.normal.angle(&-down.into_inner()));
        let large = || scored.iter().filter(|(score, _)| *score >= LARGE * most);
        let most_level = large().map(|(_, plane)| tilt(plane)).fold(f64::INFINITY, f64::min);
        let &(largest_score, largest) =
            large().find(|(_, plane)| tilt(plane) <= most_level + LEVEL_ERROR).ok_or_else(|| none(0.0))?;
        let below = scored.iter().find(|(score, plane)| {
            *score >= LARGE * largest_score
                && plane.normal.angle(&largest.normal) < PARALLEL
                && BELOW.contains(&plane.depth_below(&largest, &samples))
        });
        let plane = below.map_or(largest, |&(_, plane)| plane).refined(&samples);
        let on_plane = || samples.iter().filter(|sample| plane.has(sample));
        let weight: f64 = on_plane().map(|sample| sample.weight).sum();
        // Pixels without depth count as pixels that are not on the table.
        let share = weight / all * share;
        if share < SMALLEST || !is_level(&plane) {
            return Err(none(share));
        }
        let squares: f64 = on_plane().map(|sample| plane.height(&sample.point).powi(2) * sample.weight).sum();
        let camera_from_table = plane.frame();
        let segmentation = Segmentation::new(image, &camera_from_table);
        let corner = match cover_objects(&segmentation.objects, WORKSPACE_SIZE, OBJECT_MARGIN, 1).0.first() {
            Some(corner) => *corner,
            None => plane.middle(&camera_from_table).map(|c| c - WORKSPACE_SIZE / 2.0),
        };
        let table_from_task = Translation3::new(corner[0], corner[1], -height);
        let table = Self {
            camera_from_task: camera_from_table * table_from_task,
            distance: -plane.offset,
            angle: plane.normal.angle(&-Vector3::z()),
            share,
            deviation: (squares / weight).sqrt(),
            tilt: gravity.map(|down| plane.normal.angle(&-down.into_inner())),
        };
        Ok((table, segmentation.moved([-corner[0], -corner[1]])))
    }
}

/// Step along both axes of the image with which about `count` pixels are visited.
fn stride(image: &DepthImage, count: f64) -> usize {
    ((image.depth().len() as f64 / count).sqrt() as usize).max(1)
}

fn samples(image: &DepthImage) -> Vec<Sample> {
    let camera = image.intrinsics();
    let (step, half) = (stride(image, POINTS), [camera.width, camera.height].map(|edge| edge as f64 / 2.0));
    let radius = MIDDLE * half[0].hypot(half[1]);
    let pixels = (0..camera.height).step_by(step).flat_map(|v| (0..camera.width).step_by(step).map(move |u| (u, v)));
    let sample = |(u, v)| {
        let from_middle = (u as f64 - half[0]).hypot(v as f64 - half[1]) / radius;
        Some(Sample { point: image.point(u, v)?, weight: (-0.5 * from_middle * from_middle).exp() })
    };
    pixels.filter_map(sample).collect()
}

/// Planes through a pixel and its neighbours.
fn proposals(image: &DepthImage) -> impl Iterator<Item = Plane> {
    let camera = image.intrinsics();
    let step = stride(image, PROPOSALS);
    let pixels =
        (0..camera.height).step_by(step).flat_map(move |v| (0..camera.width).step_by(step).map(move |u| (u, v)));
    let baselines = BASELINES.map(|share| (share * camera.width as f64) as usize);
    pixels.flat_map(move |pixel| baselines.map(|baseline| (pixel, baseline))).filter_map(move |((u, v), baseline)| {
        let corner = image.point(u, v)?;
        let (right, below) = (image.point(u + baseline, v)?, image.point(u, v + baseline)?);
        Plane::new(&corner, (right - corner).cross(&(below - corner)))
    })
}

impl Plane {
    fn new(point: &Point3<f64>, normal: Vector3<f64>) -> Option<Self> {
        let normal = Unit::try_new(normal, 1e-12)?;
        // The camera is at the origin.
        let normal = if normal.dot(&point.coords) < 0.0 { normal } else { -normal };
        Some(Self { normal, offset: normal.dot(&point.coords) })
    }

    fn height(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) - self.offset
    }

    /// Whether a point is on the plane. The noise of depth cameras grows with the square of the depth.
    fn has(&self, sample: &Sample) -> bool {
        self.is_near(sample, 1.0)
    }

    fn is_near(&self, sample: &Sample, tolerance: f64) -> bool {
        self.height(&sample.point).abs() <= tolerance * (0.004 + 0.006 * sample.point.z * sample.point.z)
    }

    /// Mean distance of the points on this plane below another one, metres.
    fn depth_below(&self, other: &Plane, samples: &[Sample]) -> f64 {
        let depths = samples.iter().filter(|sample| self.has(sample)).map(|sample| -other.height(&sample.point));
        let (count, sum) = depths.fold((0.0, 0.0), |(count, sum), depth| (count + 1.0, sum + depth));
        sum / count
    }

    /// The least-squares plane of the points on this one, fitted repeatedly. The tolerance shrinks, so that the lower
    /// edges of objects and walls do not tilt it.
    fn refined(self, samples: &[Sample]) -> Self {
        const TOLERANCES: [f64; 5] = [1.0, 0.8, 0.6, 0.5, 0.5];
        TOLERANCES.into_iter().fold(self, |plane, tolerance| {
            let on_plane = || samples.iter().filter(|sample| plane.is_near(sample, tolerance));
            let weight: f64 = on_plane().map(|sample| sample.weight).sum();
            let mean = on_plane().map(|sample| sample.point.coords * sample.weight).sum::<Vector3<f64>>() / weight;
            let spread = on_plane().map(|sample| (sample.point.coords - mean, sample.weight));
            let covariance: Matrix3<f64> = spread.map(|(d, weight)| d * d.transpose() * weight).sum();
            let eigen = SymmetricEigen::new(covariance);
            let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
            Self::new(&mean.into(), normal).unwrap_or(plane)
        })
    }

    /// `T_camera_table` of a frame on the plane: its z axis is the normal, and its x axis points to the right in the
    /// image; for a camera that is rotated to the side, to the bottom of the image.
    fn frame(&self) -> Isometry3<f64> {
        let z = self.normal.into_inner();
        let x = [Vector3::x(), Vector3::y()].map(|axis| axis - z * axis.dot(&z));
        let x = (if x[0].norm() > 0.1 { x[0] } else { x[1] }).normalize();
        let rotation = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
        Isometry3::from_parts(Translation3::from(z * self.offset), UnitQuaternion::from_rotation_matrix(&rotation))
    }

    /// Where the optical axis meets the plane, in its frame; the point below the camera if they are almost parallel.
    fn middle(&self, camera_from_table: &Isometry3<f64>) -> [f64; 2] {
        let z = self.normal.z;
        let seen = (z < -0.1).then(|| camera_from_table.inverse() * Point3::new(0.0, 0.0, self.offset / z));
        seen.map_or([0.0; 2], |at| [at.x, at.y])
    }
}
