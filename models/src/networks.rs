use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use grasp::{RESOLUTION, Volume, VoxelOrigin};
use thiserror::Error;

use crate::Metadata;
use crate::onnx::ModelProto;
use crate::output_heads::Orientation;
use crate::transformer::{Sizes, transformer};
use crate::vgn::vgn;

/// The network architectures of this crate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Architecture {
    /// VGN: convolutional, 0.3 M parameters.
    Vgn,
    /// The paper's transformer: 87 M parameters.
    Transformer,
    /// The paper's transformer with smaller sizes.
    TransformerSmall,
}

/// Why a network cannot be built.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum BuildError {
    /// The name is not an architecture.
    #[error("network `{0}` not found; available: vgn, transformer, transformer-small")]
    Name(String),
    /// The resolution is not supported.
    #[error(
        "resolution is {0}, must be a multiple of 8 from 8 to {max}, because networks halve it three times",
        max = Volume::MAX_RESOLUTION
    )]
    Resolution(usize),
}

/// The network `name` with random weights for volumes of 40³ voxels, as in the paper.
///
/// # Errors
/// [`BuildError::Name`] if the name is unknown.
pub fn build(name: &str, seed: u64) -> Result<ModelProto, BuildError> {
    name.parse::<Architecture>()?.build(RESOLUTION, seed)
}

impl Architecture {
    /// All architectures.
    pub const ALL: [Self; 3] = [Self::Vgn, Self::Transformer, Self::TransformerSmall];

    /// Name in options and metadata.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgn => "vgn",
            Self::Transformer => "transformer",
            Self::TransformerSmall => "transformer-small",
        }
    }

    /// The network with random weights for volumes of `resolution`³ voxels, regressing quaternions as published. The
    /// same seed gives the same bytes.
    ///
    /// # Errors
    /// As [`build_with`](Self::build_with).
    pub fn build(self, resolution: usize, seed: u64) -> Result<ModelProto, BuildError> {
        self.build_with(resolution, Orientation::Quaternion, seed)
    }

    /// Like [`build`](Self::build), with a choice of the regressed orientation.
    ///
    /// # Errors
    /// [`BuildError::Resolution`] if the resolution is not a multiple of 8 or too large for a [`Volume`].
    pub fn build_with(self, resolution: usize, orientation: Orientation, seed: u64) -> Result<ModelProto, BuildError> {
        if !(8..=Volume::MAX_RESOLUTION).contains(&resolution) || !resolution.is_multiple_of(8) {
            return Err(BuildError::Resolution(resolution));
        }
        let mut model = match self {
            Self::Vgn => vgn(resolution, orientation, seed),
            Self::Transformer => transformer(&Sizes::PAPER, resolution, orientation, seed),
            Self::TransformerSmall => transformer(&Sizes::SMALL, resolution, orientation, seed),
        };
        let provenance = [
            ("architecture", self.name().to_owned()),
            ("orientation", orientation.name().to_owned()),
            ("seed", seed.to_string()),
        ];
        let metadata = Metadata {
            name: self.name().to_owned(),
            former_name: None,
            version: "1".to_owned(),
            resolution,
            voxel_size: grasp::WORKSPACE_SIZE / resolution as f64,
            voxel_origin: VoxelOrigin::Corner,
            camera_azimuth: None,
            network: None,
            provenance: BTreeMap::from(provenance.map(|(key, value)| (key.to_owned(), value))),
        };
        metadata.write_to(&mut model);
        Ok(model)
    }
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Architecture {
    type Err = BuildError;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|a| a.name() == name).ok_or_else(|| BuildError::Name(name.to_owned()))
    }
}
