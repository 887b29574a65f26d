use std::f64::consts::PI;

use grasp::{FINGER_DEPTH, Patch};
use grasp_models::{Classifier, RuntimeError};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

use crate::{Examples, ProposalDataset};

/// Poses around each tried grasp, besides its own.
const MOVED: usize = 3;

/// Largest shifts of these along the closing axis and back and forth along the approach, metres, and their largest
/// rotation about an axis through the middle between the fingertips.
const SHIFT: f64 = 0.01;
const BACK: f64 = 0.016;
const FORTH: f64 = 0.01;
const ANGLE: f64 = 35.0 * PI / 180.0;

/// Poses of hands at and around tried grasps, with the probability of success that an evaluator predicts: training data
/// of a coarse evaluator, whose images are coarse patches. This is distillation (Hinton et al., "Distilling the Knowledge
/// in a Neural Network"), so poses need not be tried.
pub struct ScoredPoses {
    tried: ProposalDataset,
    /// The index of the details, and the pose in their frame.
    poses: Vec<(usize, Isometry3<f64>)>,
    probabilities: Vec<f32>,
}

impl ScoredPoses {
    /// Scores the tried grasps and random moves of each by an evaluator.
    ///
    /// # Errors
    /// [`RuntimeError`] if the evaluator fails.
    pub fn new(tried: ProposalDataset, evaluator: &mut Classifier, seed: u64) -> Result<Self, RuntimeError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let around = |(details, pose)| {
            let moved: [_; MOVED] = std::array::from_fn(|_| (details, pose * random_move(&mut rng)));
            [(details, pose)].into_iter().chain(moved)
        };
        let poses: Vec<_> = tried.tried().flat_map(around).collect();
        let scores = evaluator.score(poses.len(), |index, patch| {
            let (details, pose) = &poses[index];
            Patch::write_mirrored(tried.details(*details), pose, [false; 2], &Patch::ALL, patch);
        })?;
        let probabilities = scores.into_iter().map(|score| 1.0 / (1.0 + (-score).exp())).collect();
        Ok(Self { tried, poses, probabilities })
    }
}

/// A random shift along the closing axis and the approach, and a random rotation about one of the axes.
fn random_move(rng: &mut ChaCha8Rng) -> Isometry3<f64> {
    let shift = Translation3::new(0.0, rng.random_range(-SHIFT..SHIFT), rng.random_range(-BACK..FORTH));
    let axis = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()][rng.random_range(0..3)];
    let turn = UnitQuaternion::from_axis_angle(&axis, rng.random_range(-ANGLE..ANGLE));
    let tips = Translation3::new(0.0, 0.0, FINGER_DEPTH);
    shift * tips * turn * tips.inverse()
}

impl Examples for ScoredPoses {
    fn len(&self) -> usize {
        self.poses.len()
    }

    fn class(&self, index: usize) -> usize {
        usize::from(self.probabilities[index] > 0.5)
    }

    fn classes(&self) -> usize {
        2
    }

    fn target(&self, index: usize) -> Vec<f32> {
        let success = self.probabilities[index];
        vec![1.0 - success, success]
    }

    fn scene(&self, index: usize) -> String {
        self.tried.scene_of(self.poses[index].0).to_owned()
    }

    fn images(&self, indices: &[i64], mirrored: [bool; 2]) -> Tensor {
        let poses = indices.iter().map(|&index| self.poses[index as usize]);
        self.tried.patches(poses, mirrored, &Patch::COARSE)
    }
}
