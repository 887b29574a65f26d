//! The simple high-point heuristic that GIGA's paper compares with, in its two forms.

use std::path::Path;

use grasp::gpd::{Cloud, candidates, ranked};
use grasp::{DecodeParams, Grasp};
use grasp_models::Options;
use rand_chacha::ChaCha8Rng;

use super::network::Onnx;
use super::{Observation, Planner};
use crate::candidates::{params, sights};

/// The pure geometric form: the highest of the places where the hand fits.
pub(super) struct Geometric;

impl Planner for Geometric {
    fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        Ok(ranked(candidates(&Cloud::new(sights(&observation.views)), &params(), rng)))
    }
}

/// The highest of a network's proposals with a quality above 0.5.
pub(super) struct Proposed(Onnx);

impl Proposed {
    pub fn load(path: &Path, params: &DecodeParams, options: &Options) -> anyhow::Result<Self> {
        let params = DecodeParams { threshold: 0.5, force: None, ..*params };
        Ok(Self(Onnx::load(path, &params, options)?))
    }
}

impl Planner for Proposed {
    fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        let mut grasps = self.0.plan(observation, rng)?;
        highest_position_first(&mut grasps);
        Ok(grasps)
    }
}

/// By the height of the grasp's position; the sort is stable, so the better of two equals stays ahead.
fn highest_position_first(grasps: &mut [Grasp]) {
    grasps.sort_by(|a, b| b.pose.translation.z.total_cmp(&a.pose.translation.z));
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;

    #[test]
    fn the_highest_proposal_comes_first_whatever_its_quality() {
        let at = |z, quality| Grasp { pose: Isometry3::translation(0.1, 0.1, z), width: 0.05, quality };
        let mut grasps = [at(0.1, 0.99), at(0.2, 0.6), at(0.15, 0.9), at(0.2, 0.55)];
        highest_position_first(&mut grasps);
        assert_eq!(grasps.map(|grasp| grasp.quality), [0.6, 0.55, 0.9, 0.99]);
    }
}
