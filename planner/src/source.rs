use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::path::Path;

use grasp::DecodeParams;
use grasp_models::{Backend, Classifier, Entry, LoadError, Network, Options};

use crate::{Gpd, NetworkPlanner, Planner, Shaf};

/// A planner of a model folder, by its name and version, and what it is loaded from.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// A network, from volumes to maps.
    Network(Entry),
    /// Places where the hand fits into a point cloud, scored by a classifier.
    Gpd(Entry),
    /// The highest of those places.
    Shaf,
}

/// A planner that is ready to run.
pub enum Loaded {
    /// One that can take several volumes at once.
    Network(NetworkPlanner),
    /// One that takes scenes one by one.
    Single(Box<dyn Planner + Send>),
}

impl Source {
    /// The finest volume that a planner without a network takes, voxels along an edge: in a cube of 0.3 m as fine as the
    /// point cloud is thinned to.
    pub const MAX_RESOLUTION: usize = 100;

    fn entry(&self) -> Option<&Entry> {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => Some(entry),
            Self::Shaf => None,
        }
    }

    /// As requests name it.
    #[must_use]
    pub fn name(&self) -> &str {
        self.entry().map_or("shaf", |entry| &entry.metadata.name)
    }

    /// As requests name it.
    #[must_use]
    pub fn version(&self) -> &str {
        self.entry().map_or("1", |entry| &entry.metadata.version)
    }

    /// Of its file; empty without a file.
    #[must_use]
    pub fn sha256(&self) -> &str {
        self.entry().map_or("", |entry| &entry.sha256)
    }

    /// Its file.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        self.entry().map(|entry| entry.path.as_path())
    }

    /// Where it comes from.
    #[must_use]
    pub fn provenance(&self) -> BTreeMap<String, String> {
        match self.entry() {
            Some(entry) => entry.metadata.provenance.clone(),
            None => [("method".to_owned(), "the highest place where the hand fits".to_owned())].into(),
        }
    }

    /// The network's file and metadata, if it is a network.
    #[must_use]
    pub fn network(&self) -> Option<&Entry> {
        match self {
            Self::Network(entry) => Some(entry),
            Self::Gpd(_) | Self::Shaf => None,
        }
    }

    /// Orders two versions of a name, the older first.
    #[must_use]
    pub fn by_version(&self, other: &Self) -> Ordering {
        match (self.entry(), other.entry()) {
            (Some(one), Some(other)) => one.by_version(other),
            _ => Ordering::Equal,
        }
    }

    /// How its grasps are chosen by default.
    #[must_use]
    pub fn decode_params(&self) -> DecodeParams {
        match self {
            Self::Network(entry) => entry.metadata.decode_params(),
            Self::Gpd(_) => Gpd::decode_params(),
            Self::Shaf => Shaf::decode_params(),
        }
    }

    /// Loads it `count` times, for as many threads.
    ///
    /// # Errors
    /// [`LoadError`] where its file is not what it should be.
    pub fn load(&self, options: &Options, count: usize) -> Result<(Vec<Loaded>, Backend), LoadError> {
        let single = |planner: Box<dyn Planner + Send>| Loaded::Single(planner);
        Ok(match self {
            Self::Network(entry) => {
                let networks = Network::load_several(entry, options, count)?;
                let backend = networks.first().map_or(Backend::REFERENCE, Network::backend);
                (networks.into_iter().map(|network| Loaded::Network(NetworkPlanner::new(network))).collect(), backend)
            }
            Self::Gpd(entry) => {
                let classifiers = Classifier::load_several(entry, options, count)?.into_iter();
                (classifiers.map(|classifier| single(Box::new(Gpd::new(classifier)))).collect(), Backend::REFERENCE)
            }
            Self::Shaf => ((0..count).map(|_| single(Box::new(Shaf))).collect(), Backend::REFERENCE),
        })
    }
}
