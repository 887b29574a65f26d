use std::path::Path;

use grasp::Grasp;
use grasp::gpd::{Cloud, Image, candidates, scored};
use grasp_models::{Classifier, Options};
use rand_chacha::ChaCha8Rng;

use super::{Observation, Planner};
use crate::candidates::{params, sights};

/// Candidates on the observed cloud, scored by a classifier; those that score below 0 are dropped, as in GPD's code.
pub(super) struct Gpd {
    classifier: Classifier,
}

impl Gpd {
    pub fn load(path: &Path) -> anyhow::Result<Self> {
        Ok(Self { classifier: Classifier::load(path, &Options::default())? })
    }
}

impl Planner for Gpd {
    fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        let cloud = Cloud::new(sights(&observation.views));
        let found = candidates(&cloud, &params(), rng);
        let images: Vec<Image> = found.iter().map(|candidate| Image::of(&cloud, candidate)).collect();
        let scores = self.classifier.score(&images)?;
        let mut grasps = scored(&found, &scores);
        // A success is the likelier, as GPD itself has it.
        grasps.retain(|grasp| grasp.quality >= 0.5);
        Ok(grasps)
    }
}
