use anyhow::Context;
use grasp::{DecodeParams, Grasp};
use grasp_client::Client;
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;

use super::{Observation, Planner};

pub(super) struct Server {
    runtime: Runtime,
    client: Client,
    params: DecodeParams,
}

impl Server {
    pub fn connect(address: &str, params: &DecodeParams) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let client =
            runtime.block_on(Client::connect(address)).with_context(|| format!("no graspd answers at {address}"))?;
        Ok(Self { runtime, client, params: *params })
    }
}

impl Planner for Server {
    fn plan(&mut self, observation: &Observation, _: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        let DecodeParams { threshold, force, .. } = self.params;
        let options = grasp_client::Options { threshold: Some(threshold), force, ..Default::default() };
        Ok(self.runtime.block_on(self.client.detect(&observation.volume, options))?.grasps)
    }
}
