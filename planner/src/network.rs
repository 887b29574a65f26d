use std::path::Path;

use grasp::{Decoded, Volume, decode};
use grasp_models::{LoadError, Network, Options, Output, RuntimeError};

use crate::{PlanError, PlanParams, Planner, Scene};

/// A network of VGN's signature: from a volume to maps, which are decoded.
pub struct NetworkPlanner {
    network: Network,
}

impl NetworkPlanner {
    /// With a network of its own.
    #[must_use]
    pub fn new(network: Network) -> Self {
        Self { network }
    }

    /// With the network of a file.
    ///
    /// # Errors
    /// [`LoadError`] where the file is no such network.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Ok(Self::new(Network::load(path, options)?))
    }

    /// The network.
    #[must_use]
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// The maps of several volumes at once.
    ///
    /// # Errors
    /// [`RuntimeError`].
    pub fn infer(&mut self, volumes: &[&Volume]) -> Result<Output<'_>, RuntimeError> {
        self.network.infer(volumes)
    }
}

impl Planner for NetworkPlanner {
    /// One inference cannot be stopped: `is_wanted` is not called.
    fn plan(&mut self, scene: &Scene, params: &PlanParams, _: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let output = self.network.infer(&[&scene.volume])?;
        Ok(decode(&scene.volume, &output.maps(0), &params.decode)?)
    }
}
