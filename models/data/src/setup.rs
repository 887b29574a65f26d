use std::fs;
use std::io;
use std::path::Path;

use grasp::{FINGER_DEPTH, Intrinsics, MAX_OPENING, WORKSPACE_SIZE};
use serde::{Deserialize, Serialize};

use crate::error::{At, DataError};

/// `setup.json`: what VGN's code wants to know of a data set, and how ours was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Setup {
    /// Edge of the workspace, metres.
    pub size: f64,
    /// The depth camera.
    pub intrinsic: Intrinsic,
    /// Greatest opening of the hand, metres.
    pub max_opening_width: f64,
    /// Length of the fingers, metres.
    pub finger_depth: f64,
    /// Everything it takes to make the same data again; data of others have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

/// The depth camera as VGN writes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsic {
    /// Pixels a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The 3×3 matrix, row by row: fx 0 cx, 0 fy cy, 0 0 1.
    #[serde(rename = "K")]
    pub k: [f64; 9],
}

/// What decides every byte of a data set that `grasp-sim label` writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// `pile` or `packed`.
    pub scene: String,
    /// `train` or `test`, our own objects, or the folder they came from.
    pub objects: String,
    /// Grasp points a scene.
    pub points: usize,
    /// Where the scenes were looked at from.
    pub views: String,
    /// Observations of each scene.
    #[serde(alias = "looks")]
    pub observations: usize,
    /// Share of the observations whose depth images carried the benchmark's noise.
    pub noise: f64,
    /// Seed of the data set; scene numbers select its streams.
    pub seed: u64,
    /// Seed of the observations, if they were not made with the labels.
    #[serde(default, alias = "look_seed", skip_serializing_if = "Option::is_none")]
    pub observation_seed: Option<u64>,
    /// Version of the simulator: another may give other labels.
    pub version: String,
}

impl Setup {
    /// The benchmark's workspace, camera and hand.
    #[must_use]
    pub fn benchmark(provenance: Provenance) -> Self {
        let Intrinsics { width, height, fx, fy, cx, cy } = Intrinsics::BENCHMARK;
        Self {
            size: WORKSPACE_SIZE,
            intrinsic: Intrinsic { width, height, k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] },
            max_opening_width: MAX_OPENING,
            finger_depth: FINGER_DEPTH,
            provenance: Some(provenance),
        }
    }

    /// The camera.
    #[must_use]
    pub fn intrinsics(&self) -> Intrinsics {
        let Intrinsic { width, height, k: [fx, _, cx, _, fy, cy, ..] } = self.intrinsic;
        Intrinsics { width, height, fx, fy, cx, cy }
    }

    /// Reads a folder's.
    ///
    /// # Errors
    /// [`DataError::Io`] when there is none, or it is none.
    pub fn read(folder: &Path) -> Result<Self, DataError> {
        let path = folder.join("setup.json");
        let text = fs::read_to_string(&path).at(&path)?;
        serde_json::from_str(&text).at(&path)
    }

    /// Writes it into a folder, which is made; a folder that has one already must have the same.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn claim(&self, folder: &Path) -> Result<(), DataError> {
        fs::create_dir_all(folder).at(folder)?;
        let path = folder.join("setup.json");
        match fs::read_to_string(&path) {
            Ok(found) if serde_json::from_str::<Self>(&found).is_ok_and(|found| found == *self) => Ok(()),
            Ok(found) => Err(DataError::OtherSetup { path, found: found.split_whitespace().collect() }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let text = serde_json::to_string_pretty(self).at(&path)?;
                fs::write(&path, text + "\n").at(&path)
            }
            Err(source) => Err(DataError::Io { path, source }),
        }
    }
}
