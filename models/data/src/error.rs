use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Why a data set cannot be read or written. Every error names the file.
#[derive(Debug, Error)]
pub enum DataError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the file system.
        source: io::Error,
    },
    /// A line of `grasps.csv` is invalid.
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
    /// The file of a scene is invalid.
    #[error("{}: {reason}; it must hold {expected}", path.display())]
    Scene {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
        /// What the format requires.
        expected: &'static str,
    },
    /// A packed file is damaged.
    #[error("{}: {reason} at byte {offset}; delete the file and label its scenes again into another folder", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Offset of the error, bytes.
        offset: u64,
        /// What is wrong.
        reason: String,
    },
    /// A folder has no data set, or an empty one.
    #[error(
        "{}: holds no grasps; a data set is a folder with scenes-*.pack, or with grasps.csv and scenes/",
        .0.display()
    )]
    Empty(PathBuf),
    /// The trials are not grasps that a network proposed.
    #[error("{}: its grasps are not those of a network; use data of `grasp-sim proposals`", .0.display())]
    NoProposals(PathBuf),
    /// Scenes are to be merged into a folder that has some.
    #[error("{} already holds scenes; merge into another folder", .0.display())]
    NotEmpty(PathBuf),
    /// The folder holds data of another setup.
    #[error("{} was written with other settings ({found}); use another folder, or the same settings", path.display())]
    OtherSetup {
        /// The setup file, or the folder.
        path: PathBuf,
        /// Its content.
        found: String,
    },
    /// Two folders hold the same scene.
    #[error("scene {id} is in {} and in {}; merge only one of them", first.display(), second.display())]
    DuplicateScene {
        /// Name of the scene.
        id: String,
        /// The first folder.
        first: PathBuf,
        /// The second folder.
        second: PathBuf,
    },
}

/// Adds the path of the file to an error.
pub(crate) trait At<T> {
    fn at(self, path: &Path) -> Result<T, DataError>;
}

impl<T, E: Into<io::Error>> At<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, DataError> {
        self.map_err(|source| DataError::Io { path: path.to_owned(), source: source.into() })
    }
}
