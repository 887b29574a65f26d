use std::path::Path;
use std::time::{Duration, Instant};

use grasp::{Decoded, Maps, Volume, decode, quality_at};
use grasp_models::{LoadError, Network, Options, Output, RuntimeError};
use grasp_perception::Scene;
use nalgebra::Isometry3;

use crate::{Evaluator, PlanError, PlanParams, Planner};

/// A network with the inputs and outputs of VGN. Its output maps are decoded into grasps, which an [`Evaluator`] may
/// score and move.
pub struct NetworkPlanner {
    network: Network,
    evaluator: Option<Evaluator>,
}

/// The output of a network for a batch of volumes.
pub struct Inference<'a> {
    output: Output<'a>,
    evaluator: Option<&'a mut Evaluator>,
    evaluation: Option<Duration>,
}

impl NetworkPlanner {
    /// A planner with a loaded network.
    #[must_use]
    pub fn new(network: Network, evaluator: Option<Evaluator>) -> Self {
        Self { network, evaluator }
    }

    /// Loads the network from a file, without an evaluator.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid network.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Ok(Self::new(Network::load(path, options)?, None))
    }

    /// The network.
    #[must_use]
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Runs the network on a batch of volumes.
    ///
    /// # Errors
    /// [`RuntimeError`] if the batch does not fit the network or ONNX Runtime fails.
    pub fn infer(&mut self, volumes: &[&Volume]) -> Result<Inference<'_>, RuntimeError> {
        Ok(Inference { output: self.network.infer(volumes)?, evaluator: self.evaluator.as_mut(), evaluation: None })
    }
}

impl Inference<'_> {
    /// The maps of the volume at `index` of the batch.
    #[must_use]
    pub fn maps(&self, index: usize) -> Maps<'_> {
        self.output.maps(index)
    }

    /// Time of the evaluator in the last [`decode`](Self::decode) or [`score`](Self::score); None without an evaluator.
    #[must_use]
    pub fn evaluation(&self) -> Option<Duration> {
        self.evaluation
    }

    /// The grasps in `scene`, whose volume is the one at `index` of the batch. The evaluator stops when `is_wanted`
    /// returns false.
    ///
    /// # Errors
    /// [`PlanError`] if the maps are invalid, the evaluator fails, or planning is cancelled.
    pub fn decode(
        &mut self,
        index: usize,
        scene: &Scene,
        params: &PlanParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Decoded, PlanError> {
        let volume = &scene.volume;
        let maps = self.output.maps(index);
        Ok(match &mut self.evaluator {
            None => decode(volume, &maps, &params.decode)?,
            Some(evaluator) => {
                let proposals = decode(volume, &maps, &Evaluator::proposal_params(&params.decode))?;
                let started = Instant::now();
                let refined = evaluator.refine(proposals, scene, params, is_wanted)?;
                self.evaluation = Some(started.elapsed());
                refined
            }
        })
    }

    /// The predicted quality of grasps at `poses` in `volume`, which is the one at `index` of the batch. An evaluator
    /// predicts it for the pose; a network alone for the best rotation at the position.
    ///
    /// # Errors
    /// [`PlanError`] if the maps are invalid or the evaluator fails.
    pub fn score(
        &mut self,
        index: usize,
        volume: &Volume,
        poses: &[Isometry3<f64>],
        params: &PlanParams,
    ) -> Result<Vec<f32>, PlanError> {
        match &mut self.evaluator {
            None => Ok(quality_at(volume, &self.output.maps(index), poses, &params.decode)?),
            Some(evaluator) => {
                let started = Instant::now();
                let qualities = evaluator.score(poses, volume, params)?;
                self.evaluation = Some(started.elapsed());
                Ok(qualities)
            }
        }
    }
}

impl Planner for NetworkPlanner {
    /// The inference of the network cannot be interrupted.
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        self.infer(&[&scene.volume])?.decode(0, scene, params, is_wanted)
    }
}
