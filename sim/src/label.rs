//! Labelling: grasp points on the observed surface of a scene, each tried at six yaws.

use std::f64::consts::PI;

use grasp::{FINGER_DEPTH, Grasp, MAX_OPENING, RESOLUTION, SurfacePoint};
use grasp_data::{DISTINCT_YAWS, MAX_CLEARANCE, Occupancy, Trial};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

use crate::camera::{DepthNoise, View, Views, fuse, look, observe};
use crate::objects::ObjectSet;
use crate::physics::World;
use crate::scene::{SceneKind, generate};
use crate::trial;

/// Yaws at which a point is tried, evenly spaced from 0 to 180° inclusive.
pub const YAWS: usize = DISTINCT_YAWS + 1;

/// Enlargement of the hand on its approach to a labelled grasp, metres per side, in addition to the contact distance.
const PADDING: f64 = 0.0012;

/// Maximum number of repetitions of a successful grasp, each with a small pose error.
const REPEATS: usize = 6;

/// Repetitions end after this many successes without a failure. Most grasps hold, and further failures are rare then.
const ENOUGH: usize = 3;

/// Largest number of failed repetitions of a grasp that is labelled a success. Of grasps with more failures one in
/// three fails in another simulator.
const FAILURES: usize = 1;

/// Standard deviations of the pose error over all directions, metres and radians: the accuracy of a calibrated arm and
/// camera.
const POSITION_ERROR: f64 = 0.002;
const ROTATION_ERROR: f64 = 3.0 * PI / 180.0;

/// Resolution of the second volume, from whose surface the points are sampled.
const CLOUD_RESOLUTION: usize = 120;

/// How scenes are generated, observed and labelled.
#[derive(Clone, Debug)]
pub struct SceneConfig {
    /// Pile or packed.
    pub kind: SceneKind,
    /// Objects of the scenes.
    pub objects: ObjectSet,
    /// Grasp points per scene.
    pub points: usize,
    /// Cameras of the stored observations.
    pub views: Views,
    /// Observations per scene, with different views and noise.
    pub observations: usize,
    /// Depth noise of the observations.
    pub noise: DepthNoise,
    /// Seed of the data set.
    pub seed: u64,
}

/// The observations and labels of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledScene {
    /// Objects of the scene.
    pub objects: Vec<Placed>,
    /// Observations; at least one.
    pub observations: Vec<LabelObservation>,
    /// Grasp points.
    pub points: Vec<Point>,
    /// The voxels inside the objects.
    pub occupancy: Occupancy,
}

/// The observations of a scene without labels.
#[derive(Clone, Debug, PartialEq)]
pub struct ObservedScene {
    /// Observations; none if the cameras see nothing.
    pub observations: Vec<LabelObservation>,
    /// The voxels inside the objects.
    pub occupancy: Occupancy,
}

/// An object in a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// Name.
    pub name: String,
    /// Scale of its mesh.
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
    /// The labelled grasp in the task frame. Its yaw is the middle of the longest run of successful yaws, or the first
    /// yaw if none succeeded. A success has the opening after the lift and quality 1, a failure the maximum opening and
    /// 0.
    pub grasp: Grasp,
    /// Index of its yaw.
    pub yaw: usize,
    /// Which yaws lifted an object.
    pub lifted: [bool; YAWS],
    /// Success rate of the repetitions of `grasp`, see [`Trial::share`].
    pub share: f32,
    /// Clearance of the open hand on its approach to `grasp`, metres, see [`Trial::clearance`].
    pub clearance: f32,
    /// Index of the scene's object whose surface the point was sampled from.
    pub object: Option<usize>,
}

impl Point {
    /// Whether a yaw lifted an object and at most one of its repetitions with pose errors failed.
    #[must_use]
    pub fn success(&self) -> bool {
        self.grasp.quality > 0.5
    }

    /// The label with lengths in voxels of `voxel_size`, or in metres if that is 1.
    #[must_use]
    pub fn trial(&self, voxel_size: f64) -> Trial {
        let yaws = (1..DISTINCT_YAWS).filter(|turn| self.success() && self.lifted[(self.yaw + turn) % DISTINCT_YAWS]);
        Trial {
            yaws: yaws.fold(0, |bits, turn| bits | 1 << turn),
            share: self.share,
            clearance: self.clearance,
            ..Trial::new(&self.grasp, self.success(), voxel_size)
        }
    }
}

impl SceneConfig {
    /// The random generator of a scene and its trials.
    pub(crate) fn rng(&self, index: u64) -> ChaCha8Rng {
        generator(self.seed, index)
    }

    /// Generates a scene of Poisson(4) + 1 objects.
    pub(crate) fn scene(&self, rng: &mut ChaCha8Rng) -> World {
        let count = Poisson::new(4.0).expect("4 is positive").sample(rng) as usize + 1;
        generate(self.kind, &self.objects, count, rng)
    }

    /// Generates, observes and labels scene number `index`; `None` if the cameras see no object.
    #[must_use]
    pub fn label(&self, index: u64) -> Option<LabelledScene> {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        // Points are sampled from six noise-free views from above, independent of the stored observations.
        let cloud = graspable(&look(&world, &Views::Circle.sample(&mut rng)));
        if cloud.is_empty() {
            return None;
        }
        let points = (0..self.points).map(|_| try_point(&world, &cloud, &mut rng)).collect();
        let observations = self.observe_world(&world, index, self.seed);
        let objects = world.objects().iter().map(|body| Placed {
            name: body.object.name.clone(),
            scale: body.scale,
            pose: world.pose(body.id),
        });
        (!observations.is_empty()).then(|| LabelledScene {
            objects: objects.collect(),
            observations,
            points,
            occupancy: world.occupancy(RESOLUTION),
        })
    }

    /// Observes scene number `index` without trials. The scene is the one that [`label`](Self::label) generates. The
    /// observations are the same, too, if `seed` is [`seed`](Self::seed).
    #[must_use]
    pub fn observe_again(&self, index: u64, seed: u64) -> ObservedScene {
        let world = self.scene(&mut self.rng(index));
        ObservedScene { observations: self.observe_world(&world, index, seed), occupancy: world.occupancy(RESOLUTION) }
    }

    /// Uses its own random generator, so that the number of observations does not change the labels.
    fn observe_world(&self, world: &World, index: u64, seed: u64) -> Vec<LabelObservation> {
        let mut rng = generator(seed.wrapping_add(1 << 32), index);
        (0..self.observations).filter_map(|_| self.look(world, &mut rng)).collect()
    }

    fn look(&self, world: &World, rng: &mut ChaCha8Rng) -> Option<LabelObservation> {
        let views = observe(world, &self.views, self.noise, rng);
        let volume = fuse(&views, RESOLUTION).volume(Isometry3::identity()).ok()?.values().to_vec();
        Some(LabelObservation { views, volume })
    }
}

/// The random generator of one scene: results do not depend on the order or the threads.
fn generator(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}

/// The observed surface without the table, the borders of the workspace and surfaces that face down.
#[must_use]
pub fn graspable(views: &[View]) -> Vec<SurfacePoint> {
    let mut surface = fuse(views, CLOUD_RESOLUTION).surface();
    surface.retain(is_graspable);
    surface
}

/// Whether a point is above the table, away from the borders, and does not face down (the limits of GIGA's code).
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

/// Samples a grasp pose (VGN's `sample_grasp_point`): a random surface point at a random depth between the fingers.
///
/// The approach is opposite to the normal; the x axis is close to that of the task frame.
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
        |yaw: usize| pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw as f64 * PI / DISTINCT_YAWS as f64);
    let tried: [Option<f64>; DISTINCT_YAWS] =
        std::array::from_fn(|yaw| match trial::label(world, &turned(yaw), PADDING) {
            trial::Outcome::Lifted { width, .. } => Some(width),
            _ => None,
        });
    // The last yaw is the first rotated by 180°, and the hand is symmetric.
    let widths: [Option<f64>; YAWS] = std::array::from_fn(|yaw| tried[yaw % DISTINCT_YAWS]);
    let lifted = widths.map(|width| width.is_some());
    let object = world.nearest(&surface.position);
    let best = middle_of_widest_run(&lifted).and_then(|yaw| widths[yaw].map(|width| (yaw, width)));
    let yaw = best.map_or(0, |(yaw, _)| yaw);
    let grasp = turned(yaw);
    let tries = if best.is_some() { Tries::new(world, &grasp, rng) } else { Tries { held: 0, failed: 1 } };
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

/// Results of a grasp: without and with pose errors.
struct Tries {
    held: usize,
    failed: usize,
}

impl Tries {
    /// Repeats a grasp that holds without pose error. Ends when it is a failure, after [`ENOUGH`] successes without a
    /// failure, or after [`REPEATS`] repetitions.
    fn new(world: &World, grasp: &Isometry3<f64>, rng: &mut impl Rng) -> Self {
        let mut tries = Self { held: 1, failed: 0 };
        while tries.held + tries.failed <= REPEATS && tries.is_success() && !(tries.failed == 0 && tries.held > ENOUGH)
        {
            match trial::label(world, &perturbed(grasp, rng), 0.0).is_success() {
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

/// The grasp with a random pose error.
pub(crate) fn perturbed(grasp: &Isometry3<f64>, rng: &mut impl Rng) -> Isometry3<f64> {
    // The deviation over all directions is √3 times that along one axis.
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
    fn the_middle_of_the_longest_run_is_chosen() {
        let runs = |s: &str| middle_of_widest_run(&s.chars().map(|c| c == '1').collect::<Vec<_>>());
        assert_eq!(runs("000000"), None);
        assert_eq!(runs("010000"), Some(1));
        assert_eq!(runs("101110"), Some(3));
        assert_eq!(runs("110110"), Some(0), "the first of equal runs, rounded down as in scipy");
        assert_eq!(runs("111111"), Some(2));
    }

    #[test]
    fn sampled_poses_approach_opposite_to_the_normal() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for normal in [Vector3::z(), Vector3::x(), -Vector3::x(), Vector3::new(0.3, -0.5, 0.4).normalize()] {
            let cloud = [SurfacePoint { position: Point3::new(0.1, 0.1, 0.1), normal }];
            let pose = sample_pose(&cloud, &mut rng);
            assert!((pose.rotation * Vector3::z() + normal).norm() < 1e-9);
            let offset = pose.translation.vector - cloud[0].position.coords;
            assert!((offset - normal * offset.dot(&normal)).norm() < 1e-9, "the depth is along the normal");
        }
    }
}
