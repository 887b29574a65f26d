//! Labels: grasp points on the observed surface of a scene, each tried at six yaws.

use std::f64::consts::PI;

use grasp::{FINGER_DEPTH, Grasp, MAX_OPENING, RESOLUTION, SurfacePoint};
use grasp_data::{MAX_CLEARANCE, TURNS, Trial};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

use crate::camera::{View, Views, fuse, look, observe};
use crate::objects::ObjectSet;
use crate::physics::World;
use crate::scene::{SceneKind, generate};
use crate::trial;

/// Yaws at which a point is tried, evenly from 0 to 180° inclusive.
pub const YAWS: usize = TURNS + 1;

/// How much the hand is swollen on its way to a grasp that is labelled, metres a side, beyond what counts as a contact.
const SWELL: f64 = 0.0012;

/// How often a grasp that held is tried again at most, each time a little off.
const REPEATS: usize = 6;

/// After so many tries again without a failure the grasp is not tried any more: most grasps hold, and in few of those that
/// held so often would a further try fail.
const ENOUGH: usize = 3;

/// How many of the tries may fail at most in a success: of the grasps that fail more often, one in three fails in another
/// simulator.
const FAILURES: usize = 1;

/// Standard deviation of that position from the grasp's, metres, and of that orientation, radians, over all directions: a
/// calibrated arm and camera are off by so much.
const POSITION_ERROR: f64 = 0.002;
const ROTATION_ERROR: f64 = 3.0 * PI / 180.0;

/// Resolution of the second volume, whose surface the points are drawn from.
const CLOUD_RESOLUTION: usize = 120;

/// How scenes are made, looked at and tried.
#[derive(Clone, Debug)]
pub struct SceneConfig {
    /// Pile or packed.
    pub kind: SceneKind,
    /// What the scenes are made of.
    pub objects: ObjectSet,
    /// Grasp points a scene.
    pub points: usize,
    /// What the network will see.
    pub views: Views,
    /// How often a scene is looked at anew, with other views and other noise.
    pub observations: usize,
    /// Share of the looks that carry the benchmark's noise.
    pub noise: f64,
    /// Seed of the whole data set.
    pub seed: u64,
}

/// A scene as a network sees it, with what came of trying it.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledScene {
    /// What stands in it.
    pub objects: Vec<Placed>,
    /// What was seen of it; at least one.
    pub observations: Vec<LabelObservation>,
    /// The grasp points.
    pub points: Vec<Point>,
}

/// An object in a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// Its name.
    pub name: String,
    /// The factor its mesh was scaled by.
    pub scale: f64,
    /// `T_task_object`.
    pub pose: Isometry3<f64>,
}

/// One observation of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelObservation {
    /// The depth images.
    pub views: Vec<View>,
    /// Their fused values, `[x][y][z]`, [`RESOLUTION`]³.
    pub volume: Vec<f32>,
}

/// A grasp point, tried at every yaw.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The grasp to learn, in the task frame. Where a yaw lifted something: the middle of the widest run of yaws that did,
    /// else the first yaw. Of a success the opening after the lift, and quality 1; else the greatest opening, and 0.
    pub grasp: Grasp,
    /// Which yaw that is.
    pub yaw: usize,
    /// Which yaws lifted something.
    pub lifted: [bool; YAWS],
    /// The share of the tries of `grasp` that held, see [`Trial::share`].
    pub share: f32,
    /// Of the open hand on its way to `grasp`, metres, see [`Trial::clearance`].
    pub clearance: f32,
    /// The object whose surface the point was drawn from: an index into the scene's objects.
    pub object: Option<usize>,
}

impl Point {
    /// Whether a yaw lifted an object, and nearly always did so when the hand was a little off.
    #[must_use]
    pub fn success(&self) -> bool {
        self.grasp.quality > 0.5
    }

    /// The grasp to learn in voxels of `voxel_size`, or with 1 in metres, which turns of it hold too, and with how much
    /// room to spare.
    #[must_use]
    pub fn trial(&self, voxel_size: f64) -> Trial {
        let turns = (1..TURNS).filter(|turn| self.success() && self.lifted[(self.yaw + turn) % TURNS]);
        Trial {
            turns: turns.fold(0, |bits, turn| bits | 1 << turn),
            share: self.share,
            clearance: self.clearance,
            ..Trial::new(&self.grasp, self.success(), voxel_size)
        }
    }
}

impl SceneConfig {
    /// The generator that makes a scene and tries it.
    pub(crate) fn rng(&self, index: u64) -> ChaCha8Rng {
        generator(self.seed, index)
    }

    /// A scene of Poisson(4) + 1 objects.
    pub(crate) fn scene(&self, rng: &mut ChaCha8Rng) -> World {
        let count = Poisson::new(4.0).expect("4 is positive").sample(rng) as usize + 1;
        generate(self.kind, &self.objects, count, rng)
    }

    /// Makes, looks at and labels scene number `index`; `None` if nothing of it can be seen.
    #[must_use]
    pub fn label(&self, index: u64) -> Option<LabelledScene> {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        // Labels cover what six clean views from above see, whatever the network will see.
        let cloud = graspable(&look(&world, &Views::Circle.sample(&mut rng)));
        if cloud.is_empty() {
            return None;
        }
        let points = (0..self.points).map(|_| try_point(&world, &cloud, &mut rng)).collect();
        let observations = self.look_at(&world, index, self.seed);
        let objects = world.objects().iter().map(|body| Placed {
            name: body.object.name.clone(),
            scale: body.scale,
            pose: world.pose(body.id),
        });
        (!observations.is_empty()).then(|| LabelledScene { objects: objects.collect(), observations, points })
    }

    /// Looks at scene number `index` without trying it: other views of the very scene that [`label`](Self::label) makes, or
    /// the same if `seed` is the recipe's own.
    #[must_use]
    pub fn observe_again(&self, index: u64, seed: u64) -> Vec<LabelObservation> {
        let world = self.scene(&mut self.rng(index));
        self.look_at(&world, index, seed)
    }

    /// From a generator of its own, so that how often a scene is looked at does not change its labels.
    fn look_at(&self, world: &World, index: u64, seed: u64) -> Vec<LabelObservation> {
        let mut rng = generator(seed.wrapping_add(1 << 32), index);
        (0..self.observations).filter_map(|_| self.look(world, &mut rng)).collect()
    }

    fn look(&self, world: &World, rng: &mut ChaCha8Rng) -> Option<LabelObservation> {
        let views = observe(world, &self.views, self.noise, rng);
        let volume = fuse(&views, RESOLUTION).volume(Isometry3::identity()).ok()?.values().to_vec();
        Some(LabelObservation { views, volume })
    }
}

/// A generator of a scene's own: the result does not depend on which thread makes it, or when.
fn generator(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}

/// The surface that these views see, without the table, the borders of the workspace, and what faces down.
#[must_use]
pub fn graspable(views: &[View]) -> Vec<SurfacePoint> {
    let mut surface = fuse(views, CLOUD_RESOLUTION).surface();
    surface.retain(is_graspable);
    surface
}

/// Whether a point is above the table, away from the borders, and does not face down (the bounds of GIGA's code).
#[must_use]
pub fn is_graspable(point: &SurfacePoint) -> bool {
    is_within_reach(&point.position) && point.normal.z > -0.1
}

/// Whether a position is above the table and away from the borders.
#[must_use]
pub fn is_within_reach(position: &Point3<f64>) -> bool {
    const LOWER: [f64; 3] = [0.02, 0.02, 0.055];
    const UPPER: [f64; 3] = [0.28, 0.28, 0.30];
    (0..3).all(|axis| (LOWER[axis]..=UPPER[axis]).contains(&position[axis]))
}

/// Draws a grasp point (VGN's `sample_grasp_point`): somewhere on the surface, at a random depth of the fingers.
///
/// The pose has its approach against the normal and its x axis near the task frame's.
#[must_use]
pub fn sample_pose(cloud: &[SurfacePoint], rng: &mut impl Rng) -> Isometry3<f64> {
    sample(cloud, rng).1
}

fn sample(cloud: &[SurfacePoint], rng: &mut impl Rng) -> (SurfacePoint, Isometry3<f64>) {
    const MARGIN: f64 = 0.1;
    let point = cloud[rng.random_range(0..cloud.len())];
    let depth = rng.random_range(-MARGIN * FINGER_DEPTH..(1.0 + MARGIN) * FINGER_DEPTH);
    let z = -point.normal;
    let reference = if z.x.abs() > 1.0 - 1e-4 { Vector3::y() } else { Vector3::x() };
    let y = z.cross(&reference).normalize();
    let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[y.cross(&z), y, z]));
    let position = point.position + point.normal * depth;
    (point, Isometry3::from_parts(Translation3::from(position), UnitQuaternion::from_rotation_matrix(&axes)))
}

fn try_point(world: &World, cloud: &[SurfacePoint], rng: &mut impl Rng) -> Point {
    let (surface, pose) = sample(cloud, rng);
    let turned =
        |yaw: usize| pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw as f64 * PI / TURNS as f64);
    let tried: [Option<f64>; TURNS] = std::array::from_fn(|yaw| match trial::label(world, &turned(yaw), SWELL) {
        trial::Outcome::Lifted { width, .. } => Some(width),
        _ => None,
    });
    // The last yaw is the first one turned by half a turn, and the hand is symmetric.
    let widths: [Option<f64>; YAWS] = std::array::from_fn(|yaw| tried[yaw % TURNS]);
    let lifted = widths.map(|width| width.is_some());
    let object = world.nearest(&surface.position);
    let best = middle_of_widest_run(&lifted).and_then(|yaw| widths[yaw].map(|width| (yaw, width)));
    let yaw = best.map_or(0, |(yaw, _)| yaw);
    let grasp = turned(yaw);
    let tries = if best.is_some() { Tries::of(world, &grasp, rng) } else { Tries { held: 0, failed: 1 } };
    let (width, quality) = match best {
        Some((_, width)) if tries.is_success() => (width, 1.0),
        _ => (MAX_OPENING, 0.0),
    };
    Point {
        grasp: Grasp { pose: grasp, width, quality },
        yaw,
        lifted,
        share: tries.share(),
        clearance: trial::clearance(world, &grasp, f64::from(MAX_CLEARANCE)) as f32,
        object,
    }
}

/// The tries of a grasp: as it is, and with small errors.
struct Tries {
    held: usize,
    failed: usize,
}

impl Tries {
    /// Tries a grasp that is known to hold as it is: until it is a failure, held [`ENOUGH`] times more without one, or was
    /// tried [`REPEATS`] times more.
    fn of(world: &World, grasp: &Isometry3<f64>, rng: &mut impl Rng) -> Self {
        let mut tries = Self { held: 1, failed: 0 };
        while tries.held + tries.failed <= REPEATS && tries.is_success() && !(tries.failed == 0 && tries.held > ENOUGH)
        {
            match trial::label(world, &shaken(grasp, rng), 0.0).is_success() {
                true => tries.held += 1,
                false => tries.failed += 1,
            }
        }
        tries
    }

    fn is_success(&self) -> bool {
        self.held > 0 && self.failed <= FAILURES
    }

    fn share(&self) -> f32 {
        self.held as f32 / (self.held + self.failed) as f32
    }
}

/// A grasp that is a little off.
fn shaken(grasp: &Isometry3<f64>, rng: &mut impl Rng) -> Isometry3<f64> {
    // The deviation over all directions is √3 that along one.
    let mut error =
        |deviation: f64| Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(rng) }) * (deviation / 3f64.sqrt());
    Isometry3::new(error(POSITION_ERROR), Vector3::zeros())
        * Translation3::from(grasp.translation.vector)
        * UnitQuaternion::from_scaled_axis(error(ROTATION_ERROR))
        * grasp.rotation
}

/// The middle of the first longest run of successes, as `scipy.signal.find_peaks` places it.
fn middle_of_widest_run(successes: &[bool]) -> Option<usize> {
    let mut widest: Option<(usize, usize)> = None;
    let mut start = 0;
    for run in successes.chunk_by(|a, b| a == b) {
        if run[0] && widest.is_none_or(|(_, length)| run.len() > length) {
            widest = Some((start, run.len()));
        }
        start += run.len();
    }
    widest.map(|(start, length)| start + (length - 1) / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_widest_run_gives_its_middle() {
        let runs = |s: &str| middle_of_widest_run(&s.chars().map(|c| c == '1').collect::<Vec<_>>());
        assert_eq!(runs("000000"), None);
        assert_eq!(runs("010000"), Some(1));
        assert_eq!(runs("101110"), Some(3));
        assert_eq!(runs("110110"), Some(0), "the first of equals, rounded down as scipy does");
        assert_eq!(runs("111111"), Some(2));
    }

    #[test]
    fn a_pose_approaches_against_the_normal() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for normal in [Vector3::z(), Vector3::x(), -Vector3::x(), Vector3::new(0.3, -0.5, 0.4).normalize()] {
            let cloud = [SurfacePoint { position: Point3::new(0.1, 0.1, 0.1), normal }];
            let pose = sample_pose(&cloud, &mut rng);
            assert!((pose.rotation * Vector3::z() + normal).norm() < 1e-9);
            let offset = pose.translation.vector - cloud[0].position.coords;
            assert!((offset - normal * offset.dot(&normal)).norm() < 1e-9, "the depth runs along the normal");
        }
    }
}
