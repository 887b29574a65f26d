use std::path::Path;

use grasp_models::{Entry, EntryError, Scan, StoreError};

use crate::ModelSpec;

/// Subfolder of a model folder with GPD's classifiers.
pub const CLASSIFIERS: &str = "classifiers";

/// Subfolder of a model folder with the evaluators of networks' grasps.
pub const EVALUATORS: &str = "evaluators";

/// The files of a model folder, and the planners that they make.
pub struct ModelFiles {
    /// The planners; SHAF, which needs no file, is the last.
    pub specs: Vec<ModelSpec>,
    /// Errors of the files that cannot be served.
    pub rejected: Vec<EntryError>,
}

impl ModelFiles {
    /// Reads the networks in the folder, and the files in its subfolders. Each file has at most `max_bytes`.
    ///
    /// # Errors
    /// [`StoreError`] if a folder cannot be read, or holds no network.
    pub fn read(directory: &Path, max_bytes: u64) -> Result<Self, StoreError> {
        let Scan { entries, rejected } = Scan::read(directory, max_bytes)?;
        let files = Self::with_networks(directory, entries, max_bytes)?;
        Ok(Self { rejected: rejected.into_iter().chain(files.rejected).collect(), ..files })
    }

    /// Reads the files in the subfolders, and combines them with networks that were read before.
    ///
    /// # Errors
    /// [`StoreError`] if a subfolder cannot be read.
    pub fn with_networks(directory: &Path, networks: Vec<Entry>, max_bytes: u64) -> Result<Self, StoreError> {
        let classifiers = subfolder(&directory.join(CLASSIFIERS), max_bytes)?;
        let evaluators = subfolder(&directory.join(EVALUATORS), max_bytes)?;
        let mut rejected: Vec<EntryError> = classifiers.rejected.into_iter().chain(evaluators.rejected).collect();
        let mut evaluated = Vec::new();
        for evaluator in evaluators.entries {
            let name = evaluator.metadata.network.clone().unwrap_or_default();
            // The versions of a name are in ascending order.
            match networks.iter().rfind(|network| network.metadata.name == name) {
                Some(network) => evaluated.push(ModelSpec::Evaluated { network: network.clone(), evaluator }),
                None => rejected.push(EntryError::NoNetwork { path: evaluator.path, network: name }),
            }
        }
        let networks = networks.into_iter().map(ModelSpec::Network);
        let classifiers = classifiers.entries.into_iter().map(ModelSpec::Gpd);
        let specs = networks.chain(evaluated).chain(classifiers).chain([ModelSpec::Shaf]).collect();
        Ok(Self { specs, rejected })
    }
}

/// The files in a subfolder, which may be missing or empty.
fn subfolder(directory: &Path, max_bytes: u64) -> Result<Scan, StoreError> {
    let none = || Scan { entries: Vec::new(), rejected: Vec::new() };
    if !directory.is_dir() {
        return Ok(none());
    }
    match Scan::read(directory, max_bytes) {
        Err(StoreError::Empty(_)) => Ok(none()),
        scan => scan,
    }
}
