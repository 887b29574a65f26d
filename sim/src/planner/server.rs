use anyhow::Context;
use grasp::{DecodeParams, Grasp};
use grasp_client::{Asked, Client, Options};
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
        let asked = Asked { threshold: Some(threshold), force, ..Asked::default() };
        let options = Options { asked, ..Options::default() };
        let detection = self.runtime.block_on(self.client.detect(&observation.volume, options))?;
        Ok(detection.grasps.iter().map(Into::into).collect())
    }
}
