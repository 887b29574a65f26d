use std::f64::consts::PI;
use std::iter;
use std::path::Path;

use grasp::{DecodeParams, Decoded, FINGER_DEPTH, Grasp, Hand, Patch, Selection, Volume};
use grasp_models::{Classifier, ClassifierKind, Entry, LoadError, LoadReason, Metadata, Options, RuntimeError};
use grasp_perception::Scene;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

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

/// Number of places where the hand fits, of which a coarse evaluator chooses one. Chosen from all places, the best ones
/// would be on few objects.
const PLACES: usize = 4;

/// Number of variations of a grasp that a coarse evaluator chooses.
const PROMISING: usize = 4;

/// Largest number of times that a grasp is moved.
const MOVES: usize = 2;

/// Scores grasp poses and moves them: from the volume around the hand it predicts whether an execution of the grasp lifts
/// an object. Holds whose pads do not lie flat are less probable than in the simulation that it was trained in.
///
/// A network scores voxels. The evaluator scores poses, so it also finds a better pose near a network's grasp.
///
/// A coarse evaluator, which needs a quarter of the time, chooses the poses that are worth an evaluation. Without one all are
/// evaluated.
pub struct Evaluator {
    classifier: Classifier,
    coarse: Option<Classifier>,
}

impl Evaluator {
    /// Loads the classifiers from a file.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid classifier of patches.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        let classifier = Classifier::load(path, ClassifierKind::Evaluator, options)?;
        let coarse = if_any(Classifier::load(path, ClassifierKind::CoarseEvaluator, options))?;
        Ok(Self { classifier, coarse })
    }

    /// Loads the classifiers of an entry of a store once per session.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid classifier of patches.
    pub fn load_several(entry: &Entry, options: &Options) -> Result<Vec<Self>, LoadError> {
        let fine = Classifier::load_several(entry, ClassifierKind::Evaluator, options)?;
        let options = Options { sessions: Some(fine.len()), ..*options };
        let coarse = if_any(Classifier::load_several(entry, ClassifierKind::CoarseEvaluator, &options))?;
        let coarse = coarse.into_iter().flatten().map(Some).chain(iter::repeat_with(|| None));
        Ok(fine.into_iter().zip(coarse).map(|(classifier, coarse)| Self { classifier, coarse }).collect())
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
        self.evaluate(grasps.iter_mut(), volume, &outlines)?;
        let reaches = |grasp: &Grasp, quality: f32| grasp.quality >= quality && selection.accepts(&grasp.pose);
        for (enough, (points, most)) in [SURE, params.decode.threshold].into_iter().zip(FITS) {
            if grasps.iter().any(|grasp| reaches(grasp, enough)) {
                break;
            }
            let fit = HandFit::for_evaluator(points, &surface, scene, params, is_wanted)?;
            let fitted = fit.spread(most, volume.pose());
            let mut fitted: Vec<Vec<Grasp>> = fitted.chunks(PLACES).map(<[Grasp]>::to_vec).collect();
            self.keep_promising(&mut fitted, 1, volume, &outlines)?;
            self.evaluate(fitted.iter_mut().flatten(), volume, &outlines)?;
            grasps.extend(fitted.into_iter().flatten());
        }
        sort(&mut grasps);
        let mut moving: Vec<usize> = (0..REFINED.min(grasps.len())).collect();
        moving.retain(|&index| !reaches(&grasps[index], SETTLED));
        for _ in 0..MOVES {
            if !is_wanted() {
                return Err(PlanError::Cancelled);
            }
            moving = self.move_better(&mut grasps, &moving, volume, &outlines, &selection)?;
        }
        sort(&mut grasps);
        let mut decoded = selection.select(&grasps, &params.decode);
        decoded.dropped += dropped;
        Ok(decoded)
    }

    /// Replaces the grasps at the indices `moving` by the best of their variations that pass the checks, if these are
    /// better. Returns the indices of those replaced.
    fn move_better(
        &mut self,
        grasps: &mut [Grasp],
        moving: &[usize],
        volume: &Volume,
        outlines: &Outlines,
        selection: &Selection,
    ) -> Result<Vec<usize>, RuntimeError> {
        // A grasp that would be dropped is worse than every other one.
        let value = |grasp: &Grasp| if selection.accepts(&grasp.pose) { grasp.quality } else { 0.0 };
        let values: Vec<f32> = moving.iter().map(|&index| value(&grasps[index])).collect();
        let variations = |(&index, &value): (&usize, &f32)| -> Vec<Grasp> {
            // The factor of the outline bounds the quality.
            let may_be_better =
                |moved: &Grasp| outlines.agreement(&moved.pose) > value && selection.accepts(&moved.pose);
            variations(&grasps[index], outlines.hand().depth).filter(may_be_better).collect()
        };
        let mut moved: Vec<Vec<Grasp>> = moving.par_iter().zip(&values).map(variations).collect();
        self.keep_promising(&mut moved, PROMISING, volume, outlines)?;
        self.evaluate(moved.iter_mut().flatten(), volume, outlines)?;
        let mut replaced = Vec::new();
        for ((&index, value), moved) in moving.iter().zip(values).zip(moved) {
            let best = moved.into_iter().max_by(|a, b| a.quality.total_cmp(&b.quality));
            if let Some(best) = best.filter(|best| best.quality > value) {
                grasps[index] = best;
                replaced.push(index);
            }
        }
        Ok(replaced)
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
        self.probabilities(poses, volume, &outlines)
    }

    /// Replaces the quality of each grasp by the predicted probability of success.
    fn evaluate<'a>(
        &mut self,
        grasps: impl Iterator<Item = &'a mut Grasp>,
        volume: &Volume,
        outlines: &Outlines,
    ) -> Result<(), RuntimeError> {
        let grasps: Vec<&mut Grasp> = grasps.collect();
        let poses: Vec<Isometry3<f64>> = grasps.iter().map(|grasp| grasp.pose).collect();
        for (grasp, quality) in grasps.into_iter().zip(self.probabilities(&poses, volume, outlines)?) {
            grasp.quality = quality;
        }
        Ok(())
    }

    /// The probabilities of success of hands at `poses`.
    fn probabilities(
        &mut self,
        poses: &[Isometry3<f64>],
        volume: &Volume,
        outlines: &Outlines,
    ) -> Result<Vec<f32>, RuntimeError> {
        let scores = self.classifier.score(poses.len(), |index, patch| {
            Patch::write(volume, &of_training_hand(&poses[index], outlines.hand()), patch);
        })?;
        let probability = |(pose, score): (_, f32)| outlines.agreement(pose) / (1.0 + (-score).exp());
        Ok(poses.iter().zip(scores).map(probability).collect())
    }

    /// Keeps the `most` grasps of each group that the coarse evaluator scores best, if there is one.
    fn keep_promising(
        &mut self,
        groups: &mut [Vec<Grasp>],
        most: usize,
        volume: &Volume,
        outlines: &Outlines,
    ) -> Result<(), RuntimeError> {
        let Some(coarse) = &mut self.coarse else { return Ok(()) };
        let poses: Vec<Isometry3<f64>> = groups.iter().flatten().map(|grasp| grasp.pose).collect();
        let scores = coarse.score(poses.len(), |index, patch| {
            Patch::write_coarse(volume, &of_training_hand(&poses[index], outlines.hand()), patch);
        })?;
        let mut scores = scores.into_iter();
        for group in groups {
            let mut scored: Vec<(f32, Grasp)> = scores.by_ref().take(group.len()).zip(group.drain(..)).collect();
            scored.sort_by(|(a, _), (b, _)| b.total_cmp(a));
            group.extend(scored.into_iter().take(most).map(|(_, grasp)| grasp));
        }
        Ok(())
    }
}

/// None if the file has no coarse evaluator.
fn if_any<T>(loaded: Result<T, LoadError>) -> Result<Option<T>, LoadError> {
    match loaded {
        Err(LoadError { reason: LoadReason::NoCoarseEvaluator, .. }) => Ok(None),
        loaded => loaded.map(Some),
    }
}

/// The pose of a hand with fingers of [`FINGER_DEPTH`], with which the evaluators were trained, and with the fingertips of
/// `hand` at `pose`.
fn of_training_hand(pose: &Isometry3<f64>, hand: &Hand) -> Isometry3<f64> {
    pose * Translation3::new(0.0, 0.0, hand.depth - FINGER_DEPTH)
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
