//! Models as files.

use std::fs;
use std::path::{Path, PathBuf};

use prost::Message;
use thiserror::Error;

use super::ModelProto;

/// Why a file could not be read or written.
#[derive(Debug, Error)]
pub enum FileError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the file system.
        source: std::io::Error,
    },
    /// The bytes are not an ONNX model.
    #[error("{}: not an ONNX model, or cut short: {reason}; fetch or export the file again", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// The error of the decoder.
        reason: String,
    },
}

impl ModelProto {
    /// Reads a file.
    ///
    /// # Errors
    /// [`FileError`] names the file.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let bytes = fs::read(path).map_err(|source| FileError::Io { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes).map_err(|reason| FileError::Decode { path: path.to_owned(), reason })
    }

    /// Decodes the content of a file. The error is the reason of [`FileError::Decode`].
    pub(crate) fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let model = Self::decode(bytes).map_err(|error| error.to_string())?;
        match &model.graph {
            Some(graph) if !graph.output.is_empty() => Ok(model),
            _ => Err("it holds no graph".to_owned()),
        }
    }

    /// Writes a file under a temporary name and renames it, so that a concurrent reader gets the old file or the new one.
    ///
    /// # Errors
    /// [`FileError::Io`] if the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        let part = path.with_extension("onnx.part");
        fs::write(&part, self.encode_to_vec())
            .and_then(|()| fs::rename(&part, path))
            .map_err(|source| FileError::Io { path: path.to_owned(), source })
    }
}
