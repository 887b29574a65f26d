//! Fits the hand to a point cloud. GPD and SHAF choose from the candidates.

use grasp::gpd::{Candidate, Cloud, Params, by_sample, is_on_an_object};
use grasp::{DecodeParams, Decoded, Grasp, Hand, Selection, SurfacePoint, Volume};
use grasp_perception::Scene;
use nalgebra::Isometry3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use crate::{PlanError, PlanParams};

/// Smallest distance between the hand and the table, metres: a margin for camera noise.
const TABLE_CLEARANCE: f64 = 0.002;

/// GPD: graspable objects are wider than this, and narrower than the hand's opening minus this, metres.
const APERTURE_MARGIN: f64 = 0.01;

/// The same for an evaluator, which knows better what holds: pens and cutlery are thin, cartons almost as wide as the
/// hand.
const APERTURE_MARGIN_OF_EVALUATOR: f64 = 0.004;

/// How far the fingertips initially pass a sample for an evaluator, metres. With GPD's distance they would hit the table
/// beside a pen or a fork.
const BITE_OF_EVALUATOR: f64 = 0.003;

/// The candidates in one scene.
#[derive(Debug)]
pub struct HandFit {
    /// Points of the objects.
    pub cloud: Cloud,
    /// Candidate grasps.
    pub candidates: Vec<Candidate>,
    /// Number of points that belong to no object.
    other_points: usize,
    /// Number of rotations at which the hand does not fit.
    misfits: usize,
}

/// The points of objects on a table, without the points of the table and of the border of the workspace. Task frame;
/// `size` is the edge of the workspace and `table` the height of the table, metres.
#[must_use]
pub fn object_points(points: &[SurfacePoint], size: f64, table: f64) -> Vec<SurfacePoint> {
    points.iter().filter(|point| is_on_an_object(&point.position, size, table)).copied().collect()
}

impl HandFit {
    /// GPD's parameters for a hand above a table at height `table`, metres.
    #[must_use]
    pub fn params(hand: Hand, table: f64) -> Params {
        let aperture = APERTURE_MARGIN..=(2.0 * hand.half_opening() - APERTURE_MARGIN);
        let of_gpd = Params::above(table + TABLE_CLEARANCE);
        // Fingers may be shorter than GPD's, and the palm must not touch the object.
        let bite = of_gpd.bite.min(hand.depth / 2.0);
        Params { hand, aperture, bite, ..of_gpd }
    }

    /// Parameters for places that an evaluator will score: thin objects count, too. The hand is fitted at `samples`
    /// points.
    fn evaluator_params(samples: usize, hand: Hand, table: f64) -> Params {
        let aperture = APERTURE_MARGIN_OF_EVALUATOR..=(2.0 * hand.half_opening() - APERTURE_MARGIN_OF_EVALUATOR);
        Params { samples, aperture, bite: BITE_OF_EVALUATOR, ..Self::params(hand, table) }
    }

    /// Fits the hand to the points of the scene as GPD does.
    pub(crate) fn new(scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Self, PlanError> {
        match &scene.points {
            Some(points) => Self::with(Self::params, points, scene, params, is_wanted),
            None => Self::with(Self::params, &surface(&scene.volume), scene, params, is_wanted),
        }
    }

    /// Fits the hand at `samples` points of the scene, or else of the `surface` of its volume, for an evaluator.
    pub(crate) fn for_evaluator(
        samples: usize,
        surface: &[SurfacePoint],
        scene: &Scene,
        params: &PlanParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Self, PlanError> {
        let points = scene.points.as_deref().unwrap_or(surface);
        Self::with(|hand, table| Self::evaluator_params(samples, hand, table), points, scene, params, is_wanted)
    }

    /// Fits the hand to `points` of the scene, with parameters for the hand and the height of the table.
    fn with(
        fit: impl Fn(Hand, f64) -> Params,
        points: &[SurfacePoint],
        scene: &Scene,
        params: &PlanParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Self, PlanError> {
        let volume = &scene.volume;
        let size = volume.resolution() as f64 * volume.voxel_size();
        let table = params.table.unwrap_or(f64::NEG_INFINITY);
        let of_objects = object_points(points, size, table);
        let other_points = points.len() - of_objects.len();
        let cloud = Cloud::new(of_objects);
        let fit = fit(params.decode.hand.unwrap_or(Hand::GPD), table);
        let (mut candidates, mut misfits) = (Vec::new(), 0);
        for of_sample in by_sample(&cloud, &fit, &mut ChaCha8Rng::seed_from_u64(0)) {
            if !is_wanted() {
                return Err(PlanError::Cancelled);
            }
            misfits += fit.rotations - of_sample.len();
            candidates.extend(of_sample);
        }
        Ok(Self { cloud, candidates, other_points, misfits })
    }

    /// At most `count` of the candidates as grasps in the frame of a volume at `pose`, from all over the cloud.
    pub(crate) fn spread(&self, count: usize, pose: &Isometry3<f64>) -> Vec<Grasp> {
        let of_cloud = self.candidates.iter().step_by(self.candidates.len().div_ceil(count).max(1));
        of_cloud.map(|c| Grasp { pose: pose * c.pose, width: c.width, quality: 0.0 }).collect()
    }

    /// The grasps that pass the parameters, in the frame of the volume's pose. `grasps` are in the task frame, best
    /// first.
    pub(crate) fn select(&self, grasps: Vec<Grasp>, scene: &Scene, params: &DecodeParams) -> Decoded {
        let pose = scene.volume.pose();
        let in_frame: Vec<Grasp> = grasps.into_iter().map(|grasp| Grasp { pose: pose * grasp.pose, ..grasp }).collect();
        let mut decoded = Selection::new(&scene.volume, params).select(&in_frame, params);
        decoded.dropped.mask += self.other_points;
        decoded.dropped.collision += self.misfits;
        decoded
    }
}

/// The observed surface in the frame of the volume's corner: that of its details, if it has them, because they show
/// thinner objects.
pub(crate) fn surface(volume: &Volume) -> Vec<SurfacePoint> {
    let Some(details) = volume.details() else { return volume.surface() };
    let in_volume = volume.pose().inverse() * details.pose();
    let moved =
        |SurfacePoint { position, normal }| SurfacePoint { position: in_volume * position, normal: in_volume * normal };
    details.surface().into_iter().map(moved).collect()
}
