use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// What is wrong with a data set; always names the file.
#[derive(Debug, Error)]
pub enum DataError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A line of `grasps.csv` cannot be understood.
    #[error("{}, line {line}: {reason}; the columns must be {columns}", path.display())]
    Row {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is wrong.
        reason: String,
        /// The format's columns.
        columns: &'static str,
    },
    /// A scene's file cannot be used.
    #[error("{}: {reason}; it must hold {expected}", path.display())]
    Scene {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
        /// What the format asks for.
        expected: &'static str,
    },
    /// A packed file is damaged.
    #[error("{}: {reason} at byte {offset}; delete the file, its scenes can be labelled again into another folder", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What is wrong.
        reason: String,
    },
    /// A folder holds no data set, or nothing in it.
    #[error(
        "{}: holds no grasps; a data set is a folder with scenes-*.pack, or with grasps.csv and scenes/",
        .0.display()
    )]
    Empty(PathBuf),
    /// The folder holds data of another recipe.
    #[error("{} was written with other settings ({found}); use another folder, or the same settings", path.display())]
    OtherSetup {
        /// The setup file.
        path: PathBuf,
        /// What it holds.
        found: String,
    },
    /// Two folders hold the same scene.
    #[error("{} holds scene {id}, which {} holds too", second.display(), first.display())]
    Twice {
        /// The scene.
        id: String,
        /// A folder.
        first: PathBuf,
        /// Another.
        second: PathBuf,
    },
}

/// Adds the file to an error.
pub(crate) trait At<T> {
    fn at(self, path: &Path) -> Result<T, DataError>;
}

impl<T, E: Into<io::Error>> At<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, DataError> {
        self.map_err(|source| DataError::Io { path: path.to_owned(), source: source.into() })
    }
}
