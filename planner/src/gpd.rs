use std::path::Path;

use grasp::gpd::{Image, scored};
use grasp::{DecodeParams, Decoded};
use grasp_models::{Classifier, LoadError, Options};

use crate::hand_fit::HandFit;
use crate::{PlanError, PlanParams, Planner, Scene};

/// Candidates that are scored between two calls of `is_wanted`.
const BATCH: usize = 64;

/// Grasp pose detection: places where the hand fits, scored by a classifier (ten Pas et al. 2017).
pub struct Gpd {
    classifier: Classifier,
}

impl Gpd {
    /// With a classifier of its own.
    #[must_use]
    pub fn new(classifier: Classifier) -> Self {
        Self { classifier }
    }

    /// With the classifier of a file.
    ///
    /// # Errors
    /// [`LoadError`] where the file is no classifier.
    pub fn load(path: &Path) -> Result<Self, LoadError> {
        Ok(Self::new(Classifier::load(path, &Options::default())?))
    }

    /// A success is more likely than a failure, as GPD's code has it.
    #[must_use]
    pub fn decode_params() -> DecodeParams {
        DecodeParams { threshold: 0.5, ..DecodeParams::default() }
    }
}

impl Planner for Gpd {
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let fit = HandFit::of(scene, params, is_wanted)?;
        let mut scores = Vec::with_capacity(fit.candidates.len());
        for batch in fit.candidates.chunks(BATCH) {
            if !is_wanted() {
                return Err(PlanError::Cancelled);
            }
            let images: Vec<Image> = batch.iter().map(|candidate| Image::of(&fit.cloud, candidate)).collect();
            scores.extend(self.classifier.score(&images)?);
        }
        let grasps = scored(&fit.candidates, &scores);
        Ok(fit.select(grasps, scene, &params.decode))
    }
}
