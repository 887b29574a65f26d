//! The planners of the benchmark: those that graspd serves, a running graspd, and random grasps.

mod named;
mod random;
mod server;

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use grasp::{DecodeParams, Fusion, Grasp, RESOLUTION, Volume, VolumeError};
use grasp_models::{Network, Options};
use grasp_perception::Scene;
use grasp_planner::{Evaluator, Gpd, HighestProposal, NetworkPlanner, PlanParams, Planner, Shaf};
use nalgebra::Isometry3;
use rand_chacha::ChaCha8Rng;

pub use self::server::{Server, depth_view};
use crate::TABLE_HEIGHT;
use crate::camera::{View, fuse, images, points};
use crate::label::is_graspable;

/// Input of a planner: depth images and the volume fused from them.
pub struct Observation {
    /// The depth images.
    pub views: Vec<View>,
    fused: Fusion,
    /// The volume they were fused into, task frame.
    pub volume: Volume,
    /// Duration of the fusion.
    pub fusion: Duration,
}

impl Observation {
    /// Fuses the views; `None` if they see no object in the workspace.
    #[must_use]
    pub fn new(views: Vec<View>) -> Option<Self> {
        let start = Instant::now();
        let fusion = fuse(&views, RESOLUTION);
        let volume = fusion.volume(Isometry3::identity()).ok()?;
        let took = start.elapsed();
        if !fusion.surface().iter().any(is_graspable) {
            return None;
        }
        Some(Self { views, fused: fusion, volume, fusion: took })
    }

    /// The volume with its details, which an evaluator reads.
    ///
    /// # Errors
    /// [`VolumeError`] if the volume is empty, which [`new`](Self::new) excludes.
    pub fn detailed_volume(&self) -> Result<Volume, VolumeError> {
        let images: Vec<_> = images(&self.views).collect();
        self.fused.detailed_volume(Isometry3::identity(), &images)
    }
}

/// A planner of the benchmark.
pub enum BenchPlanner {
    /// [`PlannerSpec::Random`].
    Random,
    /// [`PlannerSpec::Server`].
    Server(Box<Server>),
    /// A planner of graspd in this process.
    Local {
        /// The planner.
        planner: Box<dyn Planner + Send>,
        /// Its decoding parameters.
        decode: Box<DecodeParams>,
        /// Whether it reads the point cloud.
        reads_points: bool,
        /// Whether it reads the details of the volume.
        reads_details: bool,
    },
}

impl BenchPlanner {
    /// Proposes grasps for one observation, best first, in the task frame. `rng` is the round's generator, so that
    /// random grasps are reproducible.
    ///
    /// # Errors
    /// When the network or the server behind the planner fails.
    pub fn plan(&mut self, observation: &Observation, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<Grasp>> {
        match self {
            Self::Random => Ok(random::plan(observation, rng)),
            Self::Server(server) => server.plan(observation),
            Self::Local { planner, decode, reads_points, reads_details } => {
                let points = reads_points.then(|| points(&observation.views));
                let volume = if *reads_details { observation.detailed_volume()? } else { observation.volume.clone() };
                let scene = Scene { points, ..volume.into() };
                let params = PlanParams { decode: **decode, table: Some(TABLE_HEIGHT) };
                Ok(planner.plan(&scene, &params, &|| true)?.grasps)
            }
        }
    }
}

/// A planner as given on the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PlannerSpec {
    /// A random point of the observed surface, approached against its normal, at a random yaw.
    Random,
    /// An ONNX network of VGN's signature.
    Network(PathBuf),
    /// A running graspd, which receives the depth images.
    Server(String),
    /// SHAF: the highest candidate.
    Highest,
    /// The highest of an ONNX network's proposals with a quality above 0.5.
    HighestProposed(PathBuf),
    /// GPD: candidates scored by an ONNX classifier.
    Gpd(PathBuf),
    /// An ONNX network, whose grasps are moved and scored by an ONNX evaluator.
    Evaluated {
        /// The evaluator.
        evaluator: PathBuf,
        /// The network.
        network: PathBuf,
    },
}

impl FromStr for PlannerSpec {
    type Err = String;

    /// A file is a path with the extension `.onnx`. Other texts are names of the models that come with graspd.
    fn from_str(text: &str) -> Result<Self, String> {
        let is_file = |text: &str| text.ends_with(".onnx") || Path::new(text).is_file();
        Ok(match text.split_once(':') {
            _ if text == "random" => Self::Random,
            _ if text == "shaf" => Self::Highest,
            Some(("grpc", address)) => Self::Server(address.to_owned()),
            Some(("shaf", path)) => Self::HighestProposed(PathBuf::from(path)),
            Some(("gpd", path)) => Self::Gpd(PathBuf::from(path)),
            Some((evaluator, network)) if evaluator.ends_with(".onnx") => {
                Self::Evaluated { evaluator: PathBuf::from(evaluator), network: PathBuf::from(network) }
            }
            _ if is_file(text) => Self::Network(PathBuf::from(text)),
            _ => named::planner(text)?,
        })
    }
}

impl PlannerSpec {
    /// The decoding parameters of the planner, given those of networks; `None` for random grasps. GPD and SHAF use
    /// their own, and SHAF on a network's proposals replaces the threshold and `force`. A server uses its model's
    /// parameters except for the threshold and `force`.
    #[must_use]
    pub fn decode_params(&self, params: &DecodeParams) -> Option<DecodeParams> {
        match self {
            Self::Random => None,
            Self::Highest => Some(Shaf::decode_params()),
            Self::Gpd(_) => Some(Gpd::decode_params()),
            Self::HighestProposed(_) => Some(DecodeParams { threshold: 0.5, force: None, ..*params }),
            Self::Server(_) | Self::Network(_) | Self::Evaluated { .. } => Some(*params),
        }
    }

    /// Creates the planner. Networks and classifiers run with `options`; [`decode_params`](Self::decode_params) says
    /// what uses `params`.
    ///
    /// # Errors
    /// If the file is not the expected kind of network, or the server cannot be reached.
    pub fn build(&self, params: &DecodeParams, options: &Options) -> anyhow::Result<BenchPlanner> {
        let load = |path: &Path| {
            let network = NetworkPlanner::load(path, options)?;
            let decode = DecodeParams { origin: network.network().metadata().voxel_origin, ..*params };
            anyhow::Ok((network, decode))
        };
        let local = |planner: Box<dyn Planner + Send>, decode, reads_points| BenchPlanner::Local {
            planner,
            decode: Box::new(decode),
            reads_points,
            reads_details: matches!(self, Self::Evaluated { .. }),
        };
        Ok(match self {
            Self::Random => BenchPlanner::Random,
            Self::Server(address) => BenchPlanner::Server(Box::new(Server::connect(address, params)?)),
            Self::Highest => local(Box::new(Shaf), Shaf::decode_params(), true),
            Self::Gpd(path) => local(Box::new(Gpd::load(path, options)?), Gpd::decode_params(), true),
            Self::Network(path) => {
                let (network, decode) = load(path)?;
                local(Box::new(network), decode, false)
            }
            Self::Evaluated { evaluator, network } => {
                let (network, evaluator) = (Network::load(network, options)?, Evaluator::load(evaluator, options)?);
                let decode = DecodeParams { origin: network.metadata().voxel_origin, ..*params };
                local(Box::new(NetworkPlanner::new(network, Some(evaluator))), decode, false)
            }
            Self::HighestProposed(path) => {
                let (network, decode) = load(path)?;
                local(Box::new(HighestProposal(network)), decode, false)
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planner_specs_are_parsed() {
        let planners = [
            ("random", PlannerSpec::Random),
            ("grpc:127.0.0.1:50051", PlannerSpec::Server("127.0.0.1:50051".into())),
            ("shaf", PlannerSpec::Highest),
            ("shaf:vgn.onnx", PlannerSpec::HighestProposed("vgn.onnx".into())),
            ("gpd:zoo/gpd.onnx", PlannerSpec::Gpd("zoo/gpd.onnx".into())),
            ("zoo/vgn.onnx", PlannerSpec::Network("zoo/vgn.onnx".into())),
        ];
        for (text, expected) in planners {
            assert_eq!(text.parse(), Ok(expected));
        }
    }
}
