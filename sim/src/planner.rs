//! Grasp planners behind one interface: each looks at the same observation and proposes grasps, best first.

use std::path::{Path, PathBuf};

use anyhow::Context;
use grasp::{DecodeParams, Grasp, MAX_OPENING, RESOLUTION, Volume, decode};
use grasp_client::Client;
use grasp_models::{Network, Options};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;

use crate::camera::{View, fuse};
use crate::label::{graspable, is_graspable, sample_pose};

/// What a planner is given: depth images, and the volume fused from them.
pub struct Observation {
    /// The depth images.
    pub views: Vec<View>,
    /// The volume they were fused into, task frame.
    pub volume: Volume,
}

impl Observation {
    /// Fuses the views; `None` if they see nothing in the workspace but the table.
    #[must_use]
    pub fn new(views: Vec<View>) -> Option<Self> {
        let fusion = fuse(&views, RESOLUTION);
        if !fusion.surface().iter().any(is_graspable) {
            return None;
        }
        let volume = fusion.volume(Isometry3::identity()).ok()?;
        Some(Self { views, volume })
    }
}

/// Proposes grasps, best first, in the task frame.
pub trait Planner {
    /// Plans for one observation. `rng` is the round's own, so that a planner that draws stays reproducible.
    ///
    /// # Errors
    /// When the network or the server behind the planner fails.
    fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>>;
}

/// Which planner, as written on the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PlannerSpec {
    /// A random point of the observed surface, approached against its normal, at a random yaw.
    Random,
    /// An ONNX network of VGN's signature.
    Network(PathBuf),
    /// A running graspd.
    Server(String),
}

impl From<&str> for PlannerSpec {
    fn from(text: &str) -> Self {
        match text.split_once(':') {
            _ if text == "random" => Self::Random,
            Some(("grpc", address)) => Self::Server(address.to_owned()),
            _ => Self::Network(PathBuf::from(text)),
        }
    }
}

impl PlannerSpec {
    /// Makes the planner. A server decodes with its model's own parameters but for the threshold and `force`.
    ///
    /// # Errors
    /// When the network cannot be loaded or the server cannot be reached.
    pub fn build(&self, params: &DecodeParams) -> anyhow::Result<Box<dyn Planner + Send>> {
        Ok(match self {
            Self::Random => Box::new(Random),
            Self::Network(path) => Box::new(Onnx::load(path, params)?),
            Self::Server(address) => Box::new(Server::connect(address, params)?),
        })
    }
}

struct Random;

impl Planner for Random {
    fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        let surface = graspable(&observation.views);
        if surface.is_empty() {
            return Ok(Vec::new());
        }
        let yaw = rng.random_range(0.0..std::f64::consts::PI);
        let pose = sample_pose(&surface, rng) * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Ok(vec![Grasp { pose, width: MAX_OPENING, quality: 0.5 }])
    }
}

struct Onnx {
    network: Network,
    params: DecodeParams,
}

impl Onnx {
    fn load(path: &Path, params: &DecodeParams) -> anyhow::Result<Self> {
        let network = Network::load(path, &Options::default())?;
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

struct Server {
    runtime: Runtime,
    client: Client,
    params: DecodeParams,
}

impl Server {
    fn connect(address: &str, params: &DecodeParams) -> anyhow::Result<Self> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planners_are_named_as_on_the_command_line() {
        assert_eq!(PlannerSpec::from("random"), PlannerSpec::Random);
        assert_eq!(PlannerSpec::from("grpc:127.0.0.1:50051"), PlannerSpec::Server("127.0.0.1:50051".into()));
        assert_eq!(PlannerSpec::from("zoo/vgn.onnx"), PlannerSpec::Network("zoo/vgn.onnx".into()));
    }
}
