use std::cmp::Ordering;
use std::fs::{self, OpenOptions};
use std::io::{self, Read};
#[cfg(unix)]
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::onnx::{FileError, ModelProto};
use crate::runtime::LoadReason;
use crate::{Metadata, MetadataError};

/// Default limit on the size of a model file, bytes.
pub const MAX_MODEL_BYTES: u64 = 1 << 30;

/// The models in a folder with their metadata. Nothing is loaded into ONNX Runtime.
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
    /// Metadata of the file.
    pub metadata: Metadata,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: String,
    /// Size of the file, bytes.
    pub size: u64,
}

/// Why a folder of models cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The folder cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// The error of the file system.
        source: io::Error,
    },
    /// The folder holds no model.
    #[error("{}: holds no .onnx file; train one with `grasp-train` or copy one there", .0.display())]
    Empty(PathBuf),
    /// Files in the folder are invalid. The error lists all of them.
    #[error("{}: these files cannot be served:{}", directory.display(), lines(files))]
    Files {
        /// The folder.
        directory: PathBuf,
        /// The errors of the files.
        files: Vec<EntryError>,
    },
    /// No model has that name and version.
    #[error("{}: model `{wanted}` not found; available: {available}", directory.display())]
    Unknown {
        /// The folder.
        directory: PathBuf,
        /// The requested model, as `name` or `name version`.
        wanted: String,
        /// The available models.
        available: String,
    },
}

/// Why a model file is rejected.
#[derive(Debug, Error)]
pub enum EntryError {
    /// The file cannot be read or is not an ONNX model.
    #[error(transparent)]
    File(#[from] FileError),
    /// The metadata is invalid.
    #[error("{}: {source}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: MetadataError,
    },
    /// The network of an evaluator is not in the model folder.
    #[error("{}: the evaluator's network `{network}` is not in the model folder; add it, or set `graspd.network`", path.display())]
    NoNetwork {
        /// The file.
        path: PathBuf,
        /// The value of `graspd.network`; empty if it is missing.
        network: String,
    },
    /// Another file has the same name and version.
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
            | Self::NoNetwork { path, .. }
            | Self::Duplicate { second: path, .. } => path,
        }
    }
}

/// The folder of the models that come with graspd: in the prefix in which it is installed, or in the checkout from which it
/// was built.
#[must_use]
pub fn own_models() -> Option<PathBuf> {
    let program = std::env::current_exe().ok().and_then(|program| program.canonicalize().ok());
    let installed =
        program.as_deref().and_then(|program| Some(program.parent()?.parent()?.join("share/graspd/models")));
    let of_checkout = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/zoo"));
    [installed, of_checkout.canonicalize().ok()].into_iter().flatten().find(|folder| folder.is_dir())
}

/// One indented line per error.
fn lines(files: &[EntryError]) -> String {
    files.iter().map(|error| format!("\n    {error}")).collect()
}

/// Result of reading a folder: valid and rejected files.
#[derive(Debug)]
pub struct Scan {
    /// Models sorted by name, and the versions of a name from oldest to newest.
    pub entries: Vec<Entry>,
    /// Errors of the rejected files.
    pub rejected: Vec<EntryError>,
}

impl Scan {
    /// Reads every `*.onnx` file of a folder of at most `max_bytes`.
    ///
    /// # Errors
    /// [`StoreError`] if the folder cannot be read or holds no such file.
    pub fn read(directory: &Path, max_bytes: u64) -> Result<Self, StoreError> {
        let files = fs::read_dir(directory).and_then(|files| files.map(|file| Ok(file?.path())).collect());
        let mut paths: Vec<PathBuf> = files.map_err(|source| StoreError::Io { path: directory.to_owned(), source })?;
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "onnx"));
        if paths.is_empty() {
            return Err(StoreError::Empty(directory.to_owned()));
        }
        // Directory listings have no defined order.
        paths.sort();
        let (mut entries, mut rejected) = (Vec::<Entry>::new(), Vec::new());
        for path in paths {
            match Entry::read(path, max_bytes) {
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
    /// Reads every `*.onnx` file of a folder. Each must be a valid model of at most [`MAX_MODEL_BYTES`].
    ///
    /// # Errors
    /// [`StoreError`] names every invalid file, or the folder if it cannot be read.
    pub fn open(directory: &Path) -> Result<Self, StoreError> {
        Self::open_limited(directory, MAX_MODEL_BYTES)
    }

    /// Like [`open`](Self::open), for files of at most `max_bytes`.
    ///
    /// # Errors
    /// [`StoreError`] names every invalid file, or the folder if it cannot be read.
    pub fn open_limited(directory: &Path, max_bytes: u64) -> Result<Self, StoreError> {
        let Scan { entries, rejected } = Scan::read(directory, max_bytes)?;
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

    /// All models sorted by name, and the versions of a name from oldest to newest.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The model with this name, in the given version or the newest.
    ///
    /// # Errors
    /// [`StoreError::Unknown`] lists the available models.
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
    fn read(path: PathBuf, max_bytes: u64) -> Result<Self, EntryError> {
        // Read once, so that hash and model belong to the same content.
        let bytes =
            read_regular_file(&path, max_bytes).map_err(|source| FileError::Io { path: path.clone(), source })?;
        let model =
            ModelProto::from_bytes(&bytes).map_err(|reason| FileError::Decode { path: path.clone(), reason })?;
        let metadata = match Metadata::from_model(&model, &path) {
            Ok(metadata) => metadata,
            Err(source) => return Err(EntryError::Metadata { path, source }),
        };
        Ok(Self { path, metadata, sha256: sha256(&bytes), size: bytes.len() as u64 })
    }

    /// The content of the file. An error if it changed since the folder was read.
    pub(crate) fn bytes(&self) -> Result<Vec<u8>, LoadReason> {
        let bytes = read_regular_file(&self.path, self.size)?;
        let found = sha256(&bytes);
        if found == self.sha256 { Ok(bytes) } else { Err(LoadReason::Changed { expected: self.sha256.clone(), found }) }
    }

    fn order(&self, other: &Self) -> Ordering {
        self.metadata.name.cmp(&other.metadata.name).then_with(|| self.by_version(other))
    }

    /// Orders two versions: 1.9 is older than 1.10, and non-numeric parts are older than numbers.
    #[must_use]
    pub fn by_version(&self, other: &Self) -> Ordering {
        compare_versions(&self.metadata.version, &other.metadata.version)
    }
}

/// Reads a file of at most `max_bytes`. Other kinds of files are refused: reading a named pipe may never end, and
/// neither does a device.
///
/// # Errors
/// If it is not a regular file, is too large, or cannot be read.
pub fn read_regular_file(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut options = OpenOptions::new();
    options.read(true);
    // Without it, opening a named pipe waits for a writer.
    #[cfg(unix)]
    options.custom_flags(rustix::fs::OFlags::NONBLOCK.bits().cast_signed());
    let file = options.open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other("is not a regular file"));
    }
    let mut bytes = Vec::new();
    // The file may grow while it is read.
    if metadata.len() <= max_bytes {
        file.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    }
    let size = metadata.len().max(bytes.len() as u64);
    if size > max_bytes {
        return Err(io::Error::other(format!("has {size} bytes, must have at most {max_bytes}")));
    }
    Ok(bytes)
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Compares versions part by part: numbers numerically, so that 1.10 is newer than 1.9; other parts as text, and older
/// than any number.
fn compare_versions(a: &str, b: &str) -> Ordering {
    let parts = |version: &str| -> Vec<(Option<u64>, String)> {
        version.split('.').map(|part| (part.parse().ok(), part.to_owned())).collect()
    };
    let key = |(number, text): (Option<u64>, String)| (number, if number.is_some() { String::new() } else { text });
    parts(a).into_iter().map(key).cmp(parts(b).into_iter().map(key))
}
