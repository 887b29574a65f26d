use std::f64::consts::PI;
use std::path::Path;

use grasp::{DecodeParams, Decoded, FINGER_DEPTH, Grasp, Hand, Patch, Selection, Volume};
use grasp_models::{Classifier, LoadError, Metadata, Options, RuntimeError};
use grasp_perception::Scene;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::hand_fit::surface;
use crate::outline::Outlines;
use crate::{HandFit, PlanError, PlanParams};

/// Smallest quality of a network's grasp that is evaluated.
const PROPOSAL_THRESHOLD: f32 = 0.2;

/// Largest number of a network's grasps that are evaluated.
const PROPOSALS: usize = 32;

/// If no proposal has this quality, the hand is fitted to the surface for more of them.
const SURE: f32 = 0.9;

/// Number of points at which the hand is fitted, and largest number of the proposals from it: at first, and if none of
/// the grasps passes the threshold.
const FITS: [(usize, usize); 2] = [(150, 96), (600, 384)];

/// Quality from which moving a grasp gains nothing.
const SETTLED: f32 = 0.97;

/// Number of the best proposals that are moved.
const REFINED: usize = 6;

/// Largest number of times that a grasp is moved.
const MOVES: usize = 2;

/// Scores grasp poses and moves them: from the volume around the hand it predicts whether an execution of the grasp lifts
/// an object. Holds whose pads do not lie flat are less probable than in the simulation that it was trained in.
///
/// A network scores voxels. The evaluator scores poses, so it also finds a better pose near a network's grasp.
pub struct Evaluator {
    classifier: Classifier,
}

impl Evaluator {
    /// An evaluator with a loaded classifier of patches.
    #[must_use]
    pub fn new(classifier: Classifier) -> Self {
        Self { classifier }
    }

    /// Loads the classifier from a file.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid classifier of patches.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Ok(Self::new(Classifier::load(path, &Patch::SHAPE, options)?))
    }

    /// The default parameters for a network with an evaluator: the threshold 0.5 keeps grasps that succeed more likely
    /// than not.
    #[must_use]
    pub fn decode_params(network: &Metadata) -> DecodeParams {
        DecodeParams { threshold: 0.5, ..network.decode_params() }
    }

    /// The decoding parameters of the network's proposals.
    #[must_use]
    pub fn proposal_params(params: &DecodeParams) -> DecodeParams {
        DecodeParams { threshold: PROPOSAL_THRESHOLD, force: None, clearance: None, ..*params }
    }

    /// Scores and moves a network's proposals, and selects the grasps that pass `params`. If no proposal is sure to hold,
    /// places where the hand fits around the surface are proposals, too. Stops when `is_wanted` returns false.
    ///
    /// # Errors
    /// [`PlanError`] if the classifier fails or planning is cancelled.
    pub fn refine(
        &mut self,
        proposals: Decoded,
        scene: &Scene,
        params: &PlanParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Decoded, PlanError> {
        let Decoded { mut grasps, mut dropped } = proposals;
        dropped.suppressed += grasps.len().saturating_sub(PROPOSALS);
        grasps.truncate(PROPOSALS);
        let selection = Selection::new(&scene.volume, &params.decode);
        let volume = &scene.volume;
        let surface = surface(volume);
        let outlines = Outlines::new(&surface, volume, params.table, hand(params));
        self.evaluate(&mut grasps, volume, &outlines)?;
        let reaches = |grasp: &Grasp, quality: f32| grasp.quality >= quality && selection.accepts(&grasp.pose);
        for (enough, (points, most)) in [SURE, params.decode.threshold].into_iter().zip(FITS) {
            if grasps.iter().any(|grasp| reaches(grasp, enough)) {
                break;
            }
            let fit = HandFit::for_evaluator(points, &surface, scene, params, is_wanted)?;
            let mut fitted = fit.spread(most, volume.pose());
            self.evaluate(&mut fitted, volume, &outlines)?;
            grasps.extend(fitted);
        }
        sort(&mut grasps);
        let mut moving: Vec<usize> = (0..REFINED.min(grasps.len())).collect();
        moving.retain(|&index| !reaches(&grasps[index], SETTLED));
        for _ in 0..MOVES {
            if !is_wanted() {
                return Err(PlanError::Cancelled);
            }
            let mut moved: Vec<Grasp> =
                moving.iter().flat_map(|&index| variations(&grasps[index], hand(params).depth)).collect();
            self.evaluate(&mut moved, volume, &outlines)?;
            let of_grasp = moved.chunks_exact(VARIATIONS);
            let better = moving.iter().zip(of_grasp).filter_map(|(&index, moved)| {
                // A grasp that would be dropped is worse than every other one.
                let value = |grasp: &Grasp| if selection.accepts(&grasp.pose) { grasp.quality } else { 0.0 };
                let current = value(&grasps[index]);
                let mut better: Vec<&Grasp> = moved.iter().filter(|grasp| grasp.quality > current).collect();
                better.sort_by(|a, b| b.quality.total_cmp(&a.quality));
                better.into_iter().find(|grasp| selection.accepts(&grasp.pose)).map(|best| (index, *best))
            });
            let better: Vec<(usize, Grasp)> = better.collect();
            better.iter().for_each(|&(index, grasp)| grasps[index] = grasp);
            moving = better.into_iter().map(|(index, _)| index).collect();
        }
        sort(&mut grasps);
        let mut decoded = selection.select(&grasps, &params.decode);
        decoded.dropped += dropped;
        Ok(decoded)
    }

    /// The predicted probabilities of success of grasps at `poses`.
    ///
    /// # Errors
    /// [`RuntimeError`] if the classifier fails.
    pub fn score(
        &mut self,
        poses: &[Isometry3<f64>],
        volume: &Volume,
        params: &PlanParams,
    ) -> Result<Vec<f32>, RuntimeError> {
        let outlines = Outlines::new(&surface(volume), volume, params.table, hand(params));
        self.probabilities(poses.len(), |index| poses[index], volume, &outlines)
    }

    /// Replaces the quality of each grasp by the predicted probability of success.
    fn evaluate(&mut self, grasps: &mut [Grasp], volume: &Volume, outlines: &Outlines) -> Result<(), RuntimeError> {
        let qualities = self.probabilities(grasps.len(), |index| grasps[index].pose, volume, outlines)?;
        for (grasp, quality) in grasps.iter_mut().zip(qualities) {
            grasp.quality = quality;
        }
        Ok(())
    }

    /// The probabilities of `count` poses. The evaluator was trained with fingers of [`FINGER_DEPTH`], so it gets the pose
    /// of such a hand with its fingertips in the same place.
    fn probabilities(
        &mut self,
        count: usize,
        pose: impl Fn(usize) -> Isometry3<f64> + Sync,
        volume: &Volume,
        outlines: &Outlines,
    ) -> Result<Vec<f32>, RuntimeError> {
        let of_training_hand = Translation3::new(0.0, 0.0, outlines.hand().depth - FINGER_DEPTH);
        let scores = self.classifier.score(count, |index, patch| {
            Patch::write(volume, &(pose(index) * of_training_hand), patch);
        })?;
        let probability = |(index, score): (usize, f32)| outlines.agreement(&pose(index)) / (1.0 + (-score).exp());
        Ok(scores.into_iter().enumerate().map(probability).collect())
    }
}

fn hand(params: &PlanParams) -> Hand {
    params.decode.hand.unwrap_or(Hand::GPD)
}

/// Sorts by quality, best first.
fn sort(grasps: &mut [Grasp]) {
    grasps.sort_by(|a, b| b.quality.total_cmp(&a.quality));
}

/// Shifts of the variations along the closing axis and along the approach, metres, and their rotations, radians.
const SHIFTS: [f64; 4] = [-0.008, -0.004, 0.004, 0.008];
const DEPTHS: [f64; 3] = [-0.015, -0.0075, 0.0075];
const ANGLES: [f64; 4] = [-PI / 6.0, -PI / 12.0, PI / 12.0, PI / 6.0];

/// Number of [`variations`]: the rotations are about three axes.
const VARIATIONS: usize = SHIFTS.len() + DEPTHS.len() + 3 * ANGLES.len();

/// The grasp moved along its closing axis and its approach, and rotated about its axes through the middle between the
/// fingertips, so that the grasped part stays between them. `depth` is the distance of the fingertips from the origin.
fn variations(grasp: &Grasp, depth: f64) -> impl Iterator<Item = Grasp> {
    let shifts = SHIFTS.map(|y| Isometry3::translation(0.0, y, 0.0));
    let depths = DEPTHS.map(|z| Isometry3::translation(0.0, 0.0, z));
    let tips = Translation3::new(0.0, 0.0, depth);
    let about = move |axis| ANGLES.map(|angle| tips * UnitQuaternion::from_axis_angle(&axis, angle) * tips.inverse());
    let turns = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()].into_iter().flat_map(about);
    let grasp = *grasp;
    shifts.into_iter().chain(depths).chain(turns).map(move |change| Grasp { pose: grasp.pose * change, ..grasp })
}
