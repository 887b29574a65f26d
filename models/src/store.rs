use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::{fs, io};

use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::onnx::{FileError, ModelProto};
use crate::runtime::LoadReason;
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
}

/// Why a folder of models cannot be served.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The folder cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the file system said.
        source: io::Error,
    },
    /// The folder holds no model.
    #[error("{}: holds no .onnx file; train one with `grasp-train` or put one there", .0.display())]
    Empty(PathBuf),
    /// Files in it cannot be used: all of them are listed, so that they are mended in one go.
    #[error("{}: these files cannot be served:{}", directory.display(), lines(files))]
    Files {
        /// The folder.
        directory: PathBuf,
        /// What is wrong with which.
        files: Vec<EntryError>,
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

/// Why a file of a folder cannot be served.
#[derive(Debug, Error)]
pub enum EntryError {
    /// It cannot be read, or is no ONNX model.
    #[error(transparent)]
    File(#[from] FileError),
    /// Its metadata cannot be.
    #[error("{}: {source}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: MetadataError,
    },
    /// It claims to be the same model as another.
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
}

impl EntryError {
    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        match self {
            Self::File(FileError::Io { path, .. } | FileError::Decode { path, .. })
            | Self::Metadata { path, .. }
            | Self::Duplicate { second: path, .. } => path,
        }
    }
}

/// A line each, indented below the heading.
fn lines(files: &[EntryError]) -> String {
    files.iter().map(|error| format!("\n    {error}")).collect()
}

/// What a folder holds: the models that its files describe, and the files that describe none.
#[derive(Debug)]
pub struct Scan {
    /// By name, the versions of a name from the oldest to the newest.
    pub entries: Vec<Entry>,
    /// What is wrong with each other file.
    pub rejected: Vec<EntryError>,
}

impl Scan {
    /// Reads every `*.onnx` file of a folder.
    ///
    /// # Errors
    /// [`StoreError`] when the folder cannot be read, or holds no such file.
    pub fn read(directory: &Path) -> Result<Self, StoreError> {
        let files = fs::read_dir(directory).and_then(|files| files.map(|file| Ok(file?.path())).collect());
        let mut paths: Vec<PathBuf> = files.map_err(|source| StoreError::Io { path: directory.to_owned(), source })?;
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "onnx"));
        if paths.is_empty() {
            return Err(StoreError::Empty(directory.to_owned()));
        }
        // A folder has no order of its own.
        paths.sort();
        let (mut entries, mut rejected) = (Vec::<Entry>::new(), Vec::new());
        for path in paths {
            match Entry::read(path) {
                Ok(entry) => entries.push(entry),
                Err(error) => rejected.push(error),
            }
        }
        entries.sort_by(|a, b| a.order(b));
        entries.dedup_by(|second, first| {
            let same = first.order(second).is_eq();
            if same {
                rejected.push(EntryError::Duplicate {
                    first: first.path.clone(),
                    second: second.path.clone(),
                    name: first.metadata.name.clone(),
                    version: first.metadata.version.clone(),
                });
            }
            same
        });
        Ok(Self { entries, rejected })
    }
}

impl Store {
    /// Reads every `*.onnx` file of a folder, each of which must be a model.
    ///
    /// # Errors
    /// [`StoreError`] names every file that cannot be used, or the folder if there is none.
    pub fn open(directory: &Path) -> Result<Self, StoreError> {
        let Scan { entries, rejected } = Scan::read(directory)?;
        let directory = directory.to_owned();
        if rejected.is_empty() {
            Ok(Self { directory, entries })
        } else {
            Err(StoreError::Files { directory, files: rejected })
        }
    }

    /// The folder.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
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
    fn read(path: PathBuf) -> Result<Self, EntryError> {
        // Once for both, so that the hash is that of the model.
        let bytes = fs::read(&path).map_err(|source| FileError::Io { path: path.clone(), source })?;
        let model =
            ModelProto::from_bytes(&bytes).map_err(|reason| FileError::Decode { path: path.clone(), reason })?;
        let metadata = match Metadata::of(&model, &path) {
            Ok(metadata) => metadata,
            Err(source) => return Err(EntryError::Metadata { path, source }),
        };
        Ok(Self { path, metadata, sha256: sha256(&bytes) })
    }

    /// The file's bytes, unless they are others by now.
    pub(crate) fn bytes(&self) -> Result<Vec<u8>, LoadReason> {
        let bytes = fs::read(&self.path)?;
        let found = sha256(&bytes);
        if found == self.sha256 { Ok(bytes) } else { Err(LoadReason::Changed { expected: self.sha256.clone(), found }) }
    }

    fn order(&self, other: &Self) -> Ordering {
        self.metadata.name.cmp(&other.metadata.name).then_with(|| self.by_version(other))
    }

    /// Which of two versions is the older: 1.9 is older than 1.10, and what is no number older than any.
    #[must_use]
    pub fn by_version(&self, other: &Self) -> Ordering {
        compare_versions(&self.metadata.version, &other.metadata.version)
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Part by part: numbers as numbers, so that 1.10 is newer than 1.9; anything else as text, older than any number.
fn compare_versions(a: &str, b: &str) -> Ordering {
    let parts = |version: &str| -> Vec<(Option<u64>, String)> {
        version.split('.').map(|part| (part.parse().ok(), part.to_owned())).collect()
    };
    let key = |(number, text): (Option<u64>, String)| (number, if number.is_some() { String::new() } else { text });
    parts(a).into_iter().map(key).cmp(parts(b).into_iter().map(key))
}
