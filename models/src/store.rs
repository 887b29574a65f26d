use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::{fs, io};

use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::onnx::{FileError, ModelProto};
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

/// A line each, indented below the heading.
fn lines(files: &[EntryError]) -> String {
    files.iter().map(|error| format!("\n    {error}")).collect()
}

impl Store {
    /// Reads every `*.onnx` file of a folder.
    ///
    /// # Errors
    /// [`StoreError`] names every file that cannot be used, or the folder if there is none.
    pub fn open(directory: &Path) -> Result<Self, StoreError> {
        let files = fs::read_dir(directory).and_then(|files| files.map(|file| Ok(file?.path())).collect());
        let mut paths: Vec<PathBuf> = files.map_err(|source| StoreError::Io { path: directory.to_owned(), source })?;
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "onnx"));
        if paths.is_empty() {
            return Err(StoreError::Empty(directory.to_owned()));
        }
        // A folder has no order of its own.
        paths.sort();
        let (mut entries, mut files) = (Vec::new(), Vec::new());
        for path in paths {
            match Entry::read(path) {
                Ok(entry) => entries.push(entry),
                Err(error) => files.push(error),
            }
        }
        entries.sort_by(|a, b| a.order(b));
        for pair in entries.windows(2) {
            if pair[0].order(&pair[1]).is_eq() {
                files.push(EntryError::Duplicate {
                    first: pair[0].path.clone(),
                    second: pair[1].path.clone(),
                    name: pair[0].metadata.name.clone(),
                    version: pair[0].metadata.version.clone(),
                });
            }
        }
        let directory = directory.to_owned();
        if files.is_empty() { Ok(Self { directory, entries }) } else { Err(StoreError::Files { directory, files }) }
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
        let sha256 = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { path, metadata, sha256 })
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
