use std::path::Path;

use grasp::{Decoded, Volume, decode};
use grasp_models::{LoadError, Network, Options, Output, RuntimeError};

use crate::{PlanError, PlanParams, Planner, Scene};

/// A network with the inputs and outputs of VGN. Its output maps are decoded into grasps.
pub struct NetworkPlanner {
    network: Network,
}

impl NetworkPlanner {
    /// A planner with a loaded network.
    #[must_use]
    pub fn new(network: Network) -> Self {
        Self { network }
    }

    /// Loads the network from a file.
    ///
    /// # Errors
    /// [`LoadError`] if the file is not a valid network.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Ok(Self::new(Network::load(path, options)?))
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
    pub fn infer(&mut self, volumes: &[&Volume]) -> Result<Output<'_>, RuntimeError> {
        self.network.infer(volumes)
    }
}

impl Planner for NetworkPlanner {
    /// Ignores `is_wanted`: an inference cannot be interrupted.
    fn plan(&mut self, scene: &Scene, params: &PlanParams, _: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let output = self.network.infer(&[&scene.volume])?;
        Ok(decode(&scene.volume, &output.maps(0), &params.decode)?)
    }
}
