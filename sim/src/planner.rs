//! Grasp planners behind one interface: each looks at the same observation and proposes grasps, best first.

mod gpd;
mod network;
mod random;
mod server;
mod shaf;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Grasp, RESOLUTION, Volume};
use grasp_models::Options;
use nalgebra::Isometry3;
use rand_chacha::ChaCha8Rng;

pub use self::server::depth_view;
use crate::camera::{View, fuse};
use crate::label::is_graspable;

/// What a planner is given: depth images, and the volume fused from them.
pub struct Observation {
    /// The depth images.
    pub views: Vec<View>,
    /// The volume they were fused into, task frame.
    pub volume: Volume,
    /// How long that took.
    pub fusion: Duration,
}

impl Observation {
    /// Fuses the views; `None` if they see nothing in the workspace but the table.
    #[must_use]
    pub fn new(views: Vec<View>) -> Option<Self> {
        let start = Instant::now();
        let fusion = fuse(&views, RESOLUTION);
        let volume = fusion.volume(Isometry3::identity()).ok()?;
        let took = start.elapsed();
        if !fusion.surface().iter().any(is_graspable) {
            return None;
        }
        Some(Self { views, volume, fusion: took })
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
    /// A running graspd, which is sent the depth images.
    Server(String),
    /// The highest of the places where the hand fits.
    Highest,
    /// The highest of an ONNX network's proposals with a quality above 0.5.
    HighestProposed(PathBuf),
    /// Places where the hand fits, scored by an ONNX classifier.
    Gpd(PathBuf),
}

impl From<&str> for PlannerSpec {
    fn from(text: &str) -> Self {
        match text.split_once(':') {
            _ if text == "random" => Self::Random,
            _ if text == "shaf" => Self::Highest,
            Some(("grpc", address)) => Self::Server(address.to_owned()),
            Some(("shaf", path)) => Self::HighestProposed(PathBuf::from(path)),
            Some(("gpd", path)) => Self::Gpd(PathBuf::from(path)),
            _ => Self::Network(PathBuf::from(text)),
        }
    }
}

impl PlannerSpec {
    /// Makes the planner, whose network, if it has one, is run with `options`. A server decodes with its model's own parameters but for the threshold and `force`.
    ///
    /// # Errors
    /// When the file is not the network or classifier it should be, or the server cannot be reached.
    pub fn build(&self, params: &DecodeParams, options: &Options) -> anyhow::Result<Box<dyn Planner + Send>> {
        Ok(match self {
            Self::Random => Box::new(random::Random),
            Self::Network(path) => Box::new(network::Onnx::load(path, params, options)?),
            Self::Server(address) => Box::new(server::Server::connect(address, params)?),
            Self::Highest => Box::new(shaf::Geometric),
            Self::HighestProposed(path) => Box::new(shaf::Proposed::load(path, params, options)?),
            Self::Gpd(path) => Box::new(gpd::Gpd::load(path)?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planners_are_named_as_on_the_command_line() {
        assert_eq!(PlannerSpec::from("random"), PlannerSpec::Random);
        assert_eq!(PlannerSpec::from("grpc:127.0.0.1:50051"), PlannerSpec::Server("127.0.0.1:50051".into()));
        assert_eq!(PlannerSpec::from("shaf"), PlannerSpec::Highest);
        assert_eq!(PlannerSpec::from("shaf:vgn.onnx"), PlannerSpec::HighestProposed("vgn.onnx".into()));
        assert_eq!(PlannerSpec::from("gpd:zoo/gpd.onnx"), PlannerSpec::Gpd("zoo/gpd.onnx".into()));
        assert_eq!(PlannerSpec::from("zoo/vgn.onnx"), PlannerSpec::Network("zoo/vgn.onnx".into()));
    }
}
