use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use grasp::{RESOLUTION, Volume, VoxelOrigin};
use thiserror::Error;

use crate::heads::Orientation;
use crate::onnx::ModelProto;
use crate::transformer::{Config, transformer};
use crate::vgn::vgn;
use crate::{Metadata, ValueConvention};

/// The networks that are defined here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Architecture {
    /// VGN, convolutional, 0.3 M parameters.
    Vgn,
    /// The paper's transformer, 87 M parameters.
    Transformer,
    /// The paper's transformer with smaller sizes.
    TransformerSmall,
}

/// Why no network was built.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum BuildError {
    /// The name is no network's.
    #[error("there is no network `{0}`; there are vgn, transformer and transformer-small")]
    Name(String),
    /// The network cannot read volumes of this size.
    #[error(
        "resolution is {0}, a network halves it three times, so it must be a multiple of 8, from 8 to {max}",
        max = Volume::MAX_RESOLUTION
    )]
    Resolution(usize),
}

/// The network of that name with random weights, reading the paper's 40³ volumes.
///
/// # Errors
/// [`BuildError::Name`] when there is none.
pub fn build(name: &str, seed: u64) -> Result<ModelProto, BuildError> {
    name.parse::<Architecture>()?.build(RESOLUTION, seed)
}

impl Architecture {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Vgn, Self::Transformer, Self::TransformerSmall];

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgn => "vgn",
            Self::Transformer => "transformer",
            Self::TransformerSmall => "transformer-small",
        }
    }

    /// The network with random weights for volumes of `resolution`³ voxels, as published: it regresses quaternions. The
    /// same seed gives the same bytes.
    ///
    /// # Errors
    /// As [`build_with`](Self::build_with).
    pub fn build(self, resolution: usize, seed: u64) -> Result<ModelProto, BuildError> {
        self.build_with(resolution, Orientation::Quaternion, seed)
    }

    /// The same, with a choice of what it regresses.
    ///
    /// # Errors
    /// [`BuildError::Resolution`] unless the resolution is a multiple of 8 that a [`Volume`] can have.
    pub fn build_with(self, resolution: usize, orientation: Orientation, seed: u64) -> Result<ModelProto, BuildError> {
        if !(8..=Volume::MAX_RESOLUTION).contains(&resolution) || !resolution.is_multiple_of(8) {
            return Err(BuildError::Resolution(resolution));
        }
        let mut model = match self {
            Self::Vgn => vgn(resolution, orientation, seed),
            Self::Transformer => transformer(&Config::PAPER, resolution, orientation, seed),
            Self::TransformerSmall => transformer(&Config::SMALL, resolution, orientation, seed),
        };
        let provenance = [
            ("architecture", self.name().to_owned()),
            ("orientation", orientation.name().to_owned()),
            ("seed", seed.to_string()),
        ];
        let metadata = Metadata {
            name: self.name().to_owned(),
            version: "1".to_owned(),
            resolution,
            voxel_size: grasp::WORKSPACE_SIZE / resolution as f64,
            value_convention: ValueConvention::Vgn,
            voxel_origin: VoxelOrigin::Corner,
            camera_azimuth: None,
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
