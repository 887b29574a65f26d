use std::path::Path;

use grasp::gpd::{Image, scored};
use grasp::{DecodeParams, Decoded};
use grasp_models::{Classifier, ClassifierKind, LoadError, Options};
use grasp_perception::Scene;

use crate::hand_fit::HandFit;
use crate::{PlanError, PlanParams, Planner};

/// Number of candidates scored between two calls of `is_wanted`.
const BATCH: usize = 64;

/// Grasp pose detection (GPD): candidate grasps on a point cloud, scored by a classifier (ten Pas et al., IJRR 2017).
pub struct Gpd {
    classifier: Classifier,
}

impl Gpd {
    /// A planner with a loaded classifier.
    #[must_use]
    pub fn new(classifier: Classifier) -> Self {
        Self { classifier }
    }

    /// Loads the classifier from a file.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid classifier.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Ok(Self::new(Classifier::load(path, ClassifierKind::Gpd, options)?))
    }

    /// The default parameters: the threshold 0.5 keeps candidates that are more likely to succeed than to fail, as in
    /// GPD's code.
    #[must_use]
    pub fn decode_params() -> DecodeParams {
        DecodeParams { threshold: 0.5, ..DecodeParams::default() }
    }
}

impl Planner for Gpd {
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let fit = HandFit::new(scene, params, is_wanted)?;
        let mut scores = Vec::with_capacity(fit.candidates.len());
        for batch in fit.candidates.chunks(BATCH) {
            if !is_wanted() {
                return Err(PlanError::Cancelled);
            }
            scores.extend(self.classifier.score(batch.len(), |index, values| {
                Image::new(&fit.cloud, &batch[index]).write(values);
            })?);
        }
        let grasps = scored(&fit.candidates, &scores);
        Ok(fit.select(grasps, scene, &params.decode))
    }
}
