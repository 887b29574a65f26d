//! Training data of the classifiers of grasp candidates: images with labels. The label is the outcome of a trial in
//! simulation. GPD's authors label by geometry (antipodal or not).

use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use grasp::gpd::{Cloud, Image, candidates};
use grasp::{DecodeParams, FINGER_DEPTH, Hand, Patch, WORKSPACE_SIZE};
use grasp_data::Candidates;
use grasp_planner::{HandFit, PlanParams, Planner, Scene, object_points};
use nalgebra::{Isometry3, Translation3, Vector3};
use rand::seq::{IndexedRandom, index};
use rand::{Rng, RngExt};

use crate::TABLE_HEIGHT;
use crate::camera::{observe, points};
use crate::label::{SceneConfig, perturbed};
use crate::planner::Observation;
use crate::trial;

impl SceneConfig {
    /// Generates and observes scene number `index`, and tries up to [`points`](Self::points) random candidates of GPD.
    #[must_use]
    pub fn candidates(&self, index: u64) -> Candidates {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        let points = points(&observe(&world, &self.views, self.noise, &mut rng));
        let cloud = Cloud::new(object_points(&points, WORKSPACE_SIZE, TABLE_HEIGHT));
        let found = candidates(&cloud, &HandFit::params(Hand::GPD, TABLE_HEIGHT), &mut rng);
        let chosen = index::sample(&mut rng, found.len(), self.points.min(found.len()));
        let mut tried = Candidates::default();
        for candidate in chosen.into_iter().map(|chosen| &found[chosen]) {
            let success = trial::label(&world, &candidate.pose, 0.0).is_success();
            tried.push(index, &Image::SHAPE, Image::of(&cloud, candidate).pixels(), success);
        }
        tried
    }

    /// Generates and observes scene number `index`, and tries [`points`](Self::points) grasps of a planner, each moved at
    /// random and executed with a pose error: the training data of an evaluator. The planner runs with `params`.
    ///
    /// # Errors
    /// If the planner fails.
    pub fn proposals(
        &self,
        index: u64,
        planner: &Mutex<Box<dyn Planner + Send>>,
        params: &DecodeParams,
    ) -> anyhow::Result<Candidates> {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        let mut tried = Candidates::default();
        for _ in 0..self.observations {
            let Some(Observation { volume, .. }) = Observation::new(observe(&world, &self.views, self.noise, &mut rng))
            else {
                continue;
            };
            let scene = Scene { volume, points: None };
            let params = PlanParams { decode: *params, table: Some(TABLE_HEIGHT) };
            let mut planner = planner.lock().unwrap_or_else(PoisonError::into_inner);
            let proposed = planner.plan(&scene, &params, &|| true).context("the planner failed")?.grasps;
            drop(planner);
            for grasp in (0..self.points).filter_map(|_| proposed.choose(&mut rng).copied()).collect::<Vec<_>>() {
                let pose = grasp.pose * displacement(&mut rng);
                let success = trial::label(&world, &perturbed(&pose, &mut rng), 0.0).is_success();
                tried.push(index, &Patch::SHAPE, Patch::of(&scene.volume, &pose).values(), success);
            }
        }
        Ok(tried)
    }
}

/// A random change of a pose in its own frame: the range of the poses that an evaluator scores, and a little more. One
/// pose in four stays as it is.
fn displacement(rng: &mut impl Rng) -> Isometry3<f64> {
    if rng.random_bool(0.25) {
        return Isometry3::identity();
    }
    let mut within =
        |range: std::ops::RangeInclusive<f64>| if rng.random_bool(0.5) { rng.random_range(range) } else { 0.0 };
    let shift = Translation3::new(within(-0.004..=0.004), within(-0.01..=0.01), within(-0.018..=0.01));
    let turn = Vector3::new(within(-0.6..=0.6), within(-0.6..=0.6), within(-0.6..=0.6));
    let tips = Translation3::new(0.0, 0.0, FINGER_DEPTH);
    shift * tips * Isometry3::rotation(turn) * tips.inverse()
}
