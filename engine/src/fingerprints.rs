//! Detects changes of the model folder.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use grasp_planner::{CLASSIFIERS, EVALUATORS};

/// File in the model folder with the name of the default model.
pub(crate) const DEFAULT: &str = "default";

/// Path, modification time and size of each model file, to detect changes without reading the files.
pub type Fingerprints = Vec<(PathBuf, Option<SystemTime>, u64)>;

/// The fingerprints of the model files in a folder.
#[must_use]
pub fn fingerprints(directory: &Path) -> Fingerprints {
    let fingerprint = |path: PathBuf| {
        // `fs::metadata` follows symbolic links, which Kubernetes swaps to update a volume.
        let metadata = fs::metadata(&path).ok()?;
        Some((path, metadata.modified().ok(), metadata.len()))
    };
    let folders = [directory.to_owned(), directory.join(CLASSIFIERS), directory.join(EVALUATORS)];
    let files = folders.iter().flat_map(fs::read_dir).flatten().flatten().map(|file| file.path());
    let is_watched =
        |path: &PathBuf| path.extension().is_some_and(|extension| extension == "onnx") || path.ends_with(DEFAULT);
    let mut fingerprints: Vec<_> = files.filter(is_watched).filter_map(fingerprint).collect();
    fingerprints.sort();
    fingerprints
}
