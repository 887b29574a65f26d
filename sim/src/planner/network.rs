use std::path::Path;

use grasp::{DecodeParams, Grasp, decode};
use grasp_models::{Network, Options};
use rand_chacha::ChaCha8Rng;

use super::{Observation, Planner};

pub(super) struct Onnx {
    network: Network,
    params: DecodeParams,
}

impl Onnx {
    pub fn load(path: &Path, params: &DecodeParams, options: &Options) -> anyhow::Result<Self> {
        let network = Network::load(path, options)?;
        let params = DecodeParams { origin: network.metadata().voxel_origin, ..*params };
        Ok(Self { network, params })
    }
}

impl Planner for Onnx {
    fn plan(&mut self, observation: &Observation, _: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        let output = self.network.infer(&[&observation.volume])?;
        Ok(decode(&observation.volume, &output.maps(0), &self.params)?.grasps)
    }
}
