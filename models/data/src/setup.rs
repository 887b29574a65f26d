use std::fs;
use std::io;
use std::path::Path;

use grasp::{FINGER_DEPTH, Intrinsics, MAX_OPENING, WORKSPACE_SIZE};
use serde::{Deserialize, Serialize};

use crate::error::{At, DataError};

/// `setup.json`: the parameters that VGN's code reads, and the provenance of the data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Setup {
    /// Edge of the workspace, metres.
    pub size: f64,
    /// The depth camera.
    pub intrinsic: Intrinsic,
    /// Largest opening of the hand, metres.
    pub max_opening_width: f64,
    /// Length of the fingers, metres.
    pub finger_depth: f64,
    /// Parameters to reproduce the data; absent in data of other tools.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

/// The depth camera in VGN's format.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsic {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Intrinsic matrix, row by row: fx 0 cx, 0 fy cy, 0 0 1. Pixels.
    #[serde(rename = "K")]
    pub k: [f64; 9],
}

/// The parameters that determine every byte of a data set that `grasp-sim label` writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Scenario: `pile` or `packed`.
    pub scene: String,
    /// Objects: the built-in `train` or `test`, or the folder of the objects.
    pub objects: String,
    /// Part of the folder: `train`, `validation`, or `all`.
    #[serde(default = "all", skip_serializing_if = "is_all")]
    pub part: String,
    /// Greatest factor by which objects were stretched along an axis; absent if they were not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stretch: Option<f64>,
    /// Greatest distance between an object and each finger of the open hand, metres, if objects were resized to have
    /// one from 0 to this; absent if they were not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clearance: Option<f64>,
    /// Grasp points per scene.
    pub points: usize,
    /// Camera views of the scenes.
    pub views: String,
    /// Observations per scene.
    #[serde(alias = "looks")]
    pub observations: usize,
    /// Fraction of the observations with depth noise.
    pub noise: f64,
    /// Sensor of the depth noise: `dex`, that of the benchmark, or `stereo`.
    #[serde(default = "dex", skip_serializing_if = "is_dex")]
    pub sensor: String,
    /// Whether the scale of the depths was corrected by the table.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub correct_depth_scale: bool,
    /// Seed of the data set. Each scene number selects a random stream.
    pub seed: u64,
    /// Seed of the observations, if they were not generated with the labels.
    #[serde(default, alias = "look_seed", skip_serializing_if = "Option::is_none")]
    pub observation_seed: Option<u64>,
    /// The network whose grasps were tried; absent if points on the surface were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<String>,
    /// The evaluator that scored and moved the network's grasps before they were tried.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluator: Option<String>,
    /// Whether the data have details instead of volumes.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub details: bool,
    /// Version of the simulator. Labels can differ between versions.
    pub version: String,
}

/// The sensor of data sets that do not store one.
fn dex() -> String {
    "dex".to_owned()
}

fn is_dex(sensor: &str) -> bool {
    sensor == "dex"
}

/// The part of data sets that do not store one.
fn all() -> String {
    "all".to_owned()
}

fn is_all(part: &str) -> bool {
    part == "all"
}

impl Setup {
    /// The setup with the benchmark's workspace, camera and hand.
    #[must_use]
    pub fn benchmark(provenance: Provenance) -> Self {
        Self { provenance: Some(provenance), ..Self::unknown() }
    }

    /// The setup of the benchmark for data of unknown provenance.
    #[must_use]
    pub fn unknown() -> Self {
        let Intrinsics { width, height, fx, fy, cx, cy } = Intrinsics::BENCHMARK;
        Self {
            size: WORKSPACE_SIZE,
            intrinsic: Intrinsic { width, height, k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] },
            max_opening_width: MAX_OPENING,
            finger_depth: FINGER_DEPTH,
            provenance: None,
        }
    }

    /// The intrinsics of the camera.
    #[must_use]
    pub fn intrinsics(&self) -> Intrinsics {
        let Intrinsic { width, height, k: [fx, _, cx, _, fy, cy, ..] } = self.intrinsic;
        Intrinsics { width, height, fx, fy, cx, cy }
    }

    /// Reads the setup of a folder.
    ///
    /// # Errors
    /// [`DataError::Io`] if the file is missing or invalid.
    pub fn read(folder: &Path) -> Result<Self, DataError> {
        let path = folder.join("setup.json");
        let text = fs::read_to_string(&path).at(&path)?;
        serde_json::from_str(&text).at(&path)
    }

    /// Writes the setup into a folder, which is created if it does not exist. If the folder has a setup, it must be
    /// equal.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn write_or_compare(&self, folder: &Path) -> Result<(), DataError> {
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
