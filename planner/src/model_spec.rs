use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::path::Path;

use grasp::DecodeParams;
use grasp_models::{Backend, Classifier, ClassifierKind, Entry, LoadError, Metadata, Network, Options, Precision};
use grasp_perception::{InputGrid, NetworkGrid};

use crate::{Evaluator, Gpd, NetworkPlanner, Planner, Shaf};

/// A planner of a model folder by name and version, before it is loaded.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "a model folder has few of them")]
pub enum ModelSpec {
    /// A network.
    Network(Entry),
    /// A network whose grasps an evaluator scores. Name and version are those of the evaluator.
    Evaluated {
        /// The network.
        network: Entry,
        /// The evaluator.
        evaluator: Entry,
    },
    /// GPD with a classifier.
    Gpd(Entry),
    /// SHAF, which needs no file.
    Shaf,
}

/// A loaded planner.
pub enum Loaded {
    /// A network, which accepts batches of volumes.
    Network(Box<NetworkPlanner>),
    /// A planner that processes one scene at a time.
    Single(Box<dyn Planner + Send>),
}

impl ModelSpec {
    /// Largest resolution for planners without a network, voxels along an edge: at 0.3 m it matches the voxel size of
    /// the downsampled point cloud.
    pub const MAX_RESOLUTION: usize = 100;

    fn entry(&self) -> Option<&Entry> {
        match self {
            Self::Network(entry) | Self::Evaluated { evaluator: entry, .. } | Self::Gpd(entry) => Some(entry),
            Self::Shaf => None,
        }
    }

    /// Name of the model in requests.
    #[must_use]
    pub fn name(&self) -> &str {
        self.entry().map_or("shaf", |entry| &entry.metadata.name)
    }

    /// The present name of the planner whose name is `name`, or was before it was renamed; `name` if there is none.
    #[must_use]
    pub fn current_name<'a>(specs: impl Iterator<Item = &'a Self> + Clone, name: &'a str) -> &'a str {
        let was_called =
            |spec: &&Self| spec.entry().is_some_and(|entry| entry.metadata.former_name.as_deref() == Some(name));
        let is_current = specs.clone().any(|spec| spec.name() == name);
        let renamed = || specs.clone().find(was_called).map(Self::name);
        if is_current { name } else { renamed().unwrap_or(name) }
    }

    /// Version of the model in requests.
    #[must_use]
    pub fn version(&self) -> &str {
        self.entry().map_or("1", |entry| &entry.metadata.version)
    }

    /// SHA-256 of its file, hexadecimal; empty without a file.
    #[must_use]
    pub fn sha256(&self) -> &str {
        self.entry().map_or("", |entry| &entry.sha256)
    }

    /// Path of its file.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        self.entry().map(|entry| entry.path.as_path())
    }

    /// Origin of the model: the provenance entries of its file.
    #[must_use]
    pub fn provenance(&self) -> BTreeMap<String, String> {
        match (self, self.entry()) {
            (Self::Evaluated { network, evaluator }, _) => {
                let Metadata { name, version, .. } = &network.metadata;
                let network = ("network".to_owned(), format!("{name} {version}, sha256 {}", network.sha256));
                evaluator.metadata.provenance.clone().into_iter().chain([network]).collect()
            }
            (_, Some(entry)) => entry.metadata.provenance.clone(),
            (_, None) => [("method".to_owned(), "the highest place where the hand fits".to_owned())].into(),
        }
    }

    /// The entry of the network, if the planner has one.
    #[must_use]
    pub fn network(&self) -> Option<&Entry> {
        match self {
            Self::Network(network) | Self::Evaluated { network, .. } => Some(network),
            Self::Gpd(_) | Self::Shaf => None,
        }
    }

    /// The grid that the planner reads.
    #[must_use]
    pub fn input(&self) -> InputGrid {
        let network = self.network().map(|entry| {
            let Metadata { resolution, voxel_size, camera_azimuth, .. } = entry.metadata;
            NetworkGrid { resolution, voxel_size, camera_azimuth }
        });
        let reads_details = matches!(self, Self::Evaluated { .. });
        InputGrid { model: self.name().to_owned(), network, reads_details }
    }

    /// Orders two versions of one model, older first.
    #[must_use]
    pub fn by_version(&self, other: &Self) -> Ordering {
        match (self.entry(), other.entry()) {
            (Some(one), Some(other)) => one.by_version(other),
            _ => Ordering::Equal,
        }
    }

    /// Default decoding parameters.
    #[must_use]
    pub fn decode_params(&self) -> DecodeParams {
        match self {
            Self::Network(entry) => entry.metadata.decode_params(),
            Self::Evaluated { network, .. } => Evaluator::decode_params(&network.metadata),
            Self::Gpd(_) => Gpd::decode_params(),
            Self::Shaf => Shaf::decode_params(),
        }
    }

    /// Loads the planner once per session, and returns the backend that runs it.
    ///
    /// # Errors
    /// [`LoadError`] if the file is invalid or cannot run with `options`.
    pub fn load(&self, options: &Options) -> Result<(Vec<Loaded>, Backend), LoadError> {
        let single = |planner: Box<dyn Planner + Send>| Loaded::Single(planner);
        // Only networks are exported for 8 bits.
        let precision = options.precision.filter(|&precision| precision != Precision::Int8);
        let of_classifiers = Options { precision, ..*options };
        Ok(match self {
            Self::Network(entry) => {
                let networks = Network::load_several(entry, options)?;
                let backend = networks.first().map_or(Backend::REFERENCE, Network::backend);
                let planner = |network| Loaded::Network(Box::new(NetworkPlanner::new(network, None)));
                (networks.into_iter().map(planner).collect(), backend)
            }
            Self::Evaluated { network, evaluator } => {
                let networks = Network::load_several(network, options)?;
                let backend = networks.first().map_or(Backend::REFERENCE, Network::backend);
                let of_evaluators = Options { sessions: Some(networks.len()), ..of_classifiers };
                let evaluators = Evaluator::load_several(evaluator, &of_evaluators)?;
                let planner =
                    |(network, evaluator)| Loaded::Network(Box::new(NetworkPlanner::new(network, Some(evaluator))));
                (networks.into_iter().zip(evaluators).map(planner).collect(), backend)
            }
            Self::Gpd(entry) => {
                let classifiers = Classifier::load_several(entry, ClassifierKind::Gpd, &of_classifiers)?;
                let backend = classifiers.first().map_or(Backend::REFERENCE, Classifier::backend);
                let planner = |classifier| single(Box::new(Gpd::new(classifier)));
                (classifiers.into_iter().map(planner).collect(), backend)
            }
            Self::Shaf => {
                let sessions = 0..options.sessions(Backend::REFERENCE);
                (sessions.map(|_| single(Box::new(Shaf))).collect(), Backend::REFERENCE)
            }
        })
    }
}
