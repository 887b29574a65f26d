use std::cmp::Ordering;
use std::fs;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::onnx::ModelProto;
use crate::{Metadata, MetadataError};

/// The models in a folder, as their files describe themselves. Nothing is loaded into ONNX Runtime yet.
#[derive(Clone, Debug)]
pub struct Store {
    directory: PathBuf,
    entries: Vec<Entry>,
}

/// One model file.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The file.
    pub path: PathBuf,
    /// What it says of itself.
    pub metadata: Metadata,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: String,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Learnt numbers.
    pub parameters: usize,
}

/// Why a folder of models, or a model in it, cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The folder or a file in it cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
    /// The folder holds no model.
    #[error("{}: holds no .onnx file; train one with `grasp-train` or put one there", .0.display())]
    Empty(PathBuf),
    /// A file is no ONNX model.
    #[error("{}: not an ONNX model, or cut short: {reason}; fetch or export the file again", path.display())]
    Model {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A file's metadata cannot be.
    #[error("{}: {source}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: MetadataError,
    },
    /// Two files claim to be the same model.
    #[error("{} and {} are both `{name}` version {version}; remove one", first.display(), second.display())]
    Duplicate {
        /// One file.
        first: PathBuf,
        /// The other.
        second: PathBuf,
        /// Their name.
        name: String,
        /// Their version.
        version: String,
    },
    /// No model has that name and version.
    #[error("{}: no model `{wanted}`; there are {available}", directory.display())]
    Unknown {
        /// The folder.
        directory: PathBuf,
        /// What was asked for, as `name` or `name version`.
        wanted: String,
        /// What there is.
        available: String,
    },
}

impl Store {
    /// Reads every `*.onnx` file of a folder.
    ///
    /// # Errors
    /// [`StoreError`] names the file that cannot be used, or the folder if there is none.
    pub fn open(directory: &Path) -> Result<Self, StoreError> {
        let io = |source| StoreError::Io { path: directory.to_owned(), source };
        let mut entries = Vec::new();
        for file in fs::read_dir(directory).map_err(io)? {
            let path = file.map_err(io)?.path();
            if path.extension().is_some_and(|extension| extension == "onnx") {
                entries.push(Entry::read(path)?);
            }
        }
        if entries.is_empty() {
            return Err(StoreError::Empty(directory.to_owned()));
        }
        entries.sort_by(|a, b| a.order(b));
        for pair in entries.windows(2) {
            if pair[0].order(&pair[1]).is_eq() {
                return Err(StoreError::Duplicate {
                    first: pair[0].path.clone(),
                    second: pair[1].path.clone(),
                    name: pair[0].metadata.name.clone(),
                    version: pair[0].metadata.version.clone(),
                });
            }
        }
        Ok(Self { directory: directory.to_owned(), entries })
    }

    /// All models, by name, the versions of a name from the oldest to the newest.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The model of that name: the version asked for, or the newest.
    ///
    /// # Errors
    /// [`StoreError::Unknown`] says what there is instead.
    pub fn get(&self, name: &str, version: Option<&str>) -> Result<&Entry, StoreError> {
        let fits = |metadata: &Metadata| {
            metadata.name == name && version.is_none_or(|version| compare_versions(&metadata.version, version).is_eq())
        };
        self.entries.iter().rfind(|entry| fits(&entry.metadata)).ok_or_else(|| {
            let describe = |name: &str, version: &str| format!("{name} {version}");
            let available: Vec<_> =
                self.entries.iter().map(|e| describe(&e.metadata.name, &e.metadata.version)).collect();
            StoreError::Unknown {
                directory: self.directory.clone(),
                wanted: version.map_or_else(|| name.to_owned(), |version| describe(name, version)),
                available: available.join(", "),
            }
        })
    }
}

impl Entry {
    fn read(path: PathBuf) -> Result<Self, StoreError> {
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(source) => return Err(StoreError::Io { path, source }),
        };
        let model = match ModelProto::from_bytes(&bytes) {
            Ok(model) => model,
            Err(reason) => return Err(StoreError::Model { path, reason }),
        };
        let metadata = match Metadata::of(&model, &path) {
            Ok(metadata) => metadata,
            Err(source) => return Err(StoreError::Metadata { path, source }),
        };
        let sha256 = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { path, metadata, sha256, bytes: bytes.len() as u64, parameters: model.parameters() })
    }

    fn order(&self, other: &Self) -> Ordering {
        let (a, b) = (&self.metadata, &other.metadata);
        a.name.cmp(&b.name).then_with(|| compare_versions(&a.version, &b.version))
    }
}

/// Part by part: numbers as numbers, so that 1.10 is newer than 1.9; anything else as text, older than any number.
fn compare_versions(a: &str, b: &str) -> Ordering {
    let parts = |version: &str| -> Vec<(Option<u64>, String)> {
        version.split('.').map(|part| (part.parse().ok(), part.to_owned())).collect()
    };
    let key = |(number, text): (Option<u64>, String)| (number, if number.is_some() { String::new() } else { text });
    parts(a).into_iter().map(key).cmp(parts(b).into_iter().map(key))
}
