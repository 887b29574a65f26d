//! Training data of an evaluator: the grasps that a planner proposes, moved at random, and tried.

use std::ops::RangeInclusive;
use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use grasp::{DecodeParams, FINGER_DEPTH, WORKSPACE_SIZE};
use grasp_data::{Occupancy, Trial, value};
use grasp_perception::Scene;
use grasp_planner::{PlanParams, Planner};
use nalgebra::{Isometry3, Translation3, Vector3};
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt};

use crate::TABLE_HEIGHT;
use crate::camera::observe;
use crate::label::{SceneConfig, perturbed};
use crate::planner::Observation;
use crate::trial;

/// An observed scene with the trials of a planner's grasps.
#[derive(Clone, Debug, PartialEq)]
pub struct TriedScene {
    /// The values of the observed volume, or of its [details](grasp::Details), `[x][y][z]`.
    pub values: Vec<f32>,
    /// The trials. A success is a grasp that the hand reached without a contact, and that lifted an object. The share is
    /// 1 if it lifted an object, also after a contact, else 0. The clearance is unknown.
    pub trials: Vec<Trial>,
    /// The voxels inside the objects.
    pub occupancy: Occupancy,
}

impl SceneConfig {
    /// Generates and observes scene number `index`, and tries [`points`](Self::points) grasps of a planner, each moved at
    /// random and executed with a pose error. The planner runs with `params`. With `with_details` the scene has the
    /// details of the volume instead of the volume. `None` if nothing is proposed.
    ///
    /// # Errors
    /// If the planner fails.
    pub fn proposals(
        &self,
        index: u64,
        planner: &Mutex<Box<dyn Planner + Send>>,
        params: &DecodeParams,
        with_details: bool,
    ) -> anyhow::Result<Option<TriedScene>> {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        let Some(observation) = Observation::new(observe(&world, &self.views, self.noise, &mut rng)) else {
            return Ok(None);
        };
        let scene = Scene::from(observation.detailed_volume()?);
        let params = PlanParams { decode: *params, table: Some(TABLE_HEIGHT) };
        let mut planner = planner.lock().unwrap_or_else(PoisonError::into_inner);
        let proposed = planner.plan(&scene, &params, &|| true).context("the planner failed")?.grasps;
        drop(planner);
        let (voxel_size, values) = match scene.volume.details().filter(|_| with_details) {
            Some(details) => (details.voxel_size(), details.bytes().iter().copied().map(value).collect()),
            None => (scene.volume.voxel_size(), scene.volume.values().to_vec()),
        };
        let resolution = (WORKSPACE_SIZE / voxel_size).round() as usize;
        let mut trials = Vec::new();
        for _ in 0..self.points {
            let Some(mut grasp) = proposed.choose(&mut rng).copied() else { return Ok(None) };
            grasp.pose *= displacement(&mut rng);
            let (outcome, short_by) = trial::attempt(&world, &perturbed(&grasp.pose, &mut rng));
            let lifted = outcome.is_success();
            let trial = Trial::new(&grasp, lifted && short_by == 0.0, voxel_size);
            trials.push(Trial { share: if lifted { 1.0 } else { 0.0 }, ..trial });
        }
        Ok(Some(TriedScene { values, trials, occupancy: world.occupancy(resolution) }))
    }
}

/// A random change of a pose in its own frame: the range of the poses that an evaluator scores, and a little more. One
/// pose in four stays as it is.
fn displacement(rng: &mut impl Rng) -> Isometry3<f64> {
    if rng.random_bool(0.25) {
        return Isometry3::identity();
    }
    let mut within = |range: RangeInclusive<f64>| if rng.random_bool(0.5) { rng.random_range(range) } else { 0.0 };
    let shift = Translation3::new(within(-0.004..=0.004), within(-0.01..=0.01), within(-0.018..=0.01));
    let turn = Vector3::new(within(-0.6..=0.6), within(-0.6..=0.6), within(-0.6..=0.6));
    let tips = Translation3::new(0.0, 0.0, FINGER_DEPTH);
    shift * tips * Isometry3::rotation(turn) * tips.inverse()
}
