use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use grasp::{DecodeParams, RESOLUTION, Volume, VoxelOrigin, WORKSPACE_SIZE};
use thiserror::Error;

use crate::onnx::{DimensionValue, ModelProto, StringStringEntryProto, ValueInfoProto};

/// What a model file means, kept inside it as properties named `graspd.…`.
#[derive(Clone, Debug, PartialEq)]
pub struct Metadata {
    /// The name it is asked for by.
    pub name: String,
    /// Its version: numbers separated by dots.
    pub version: String,
    /// Voxels along an edge of the volume it reads.
    pub resolution: usize,
    /// Edge of a voxel it was trained for, metres.
    pub voxel_size: f64,
    /// What a voxel's value means.
    pub value_convention: ValueConvention,
    /// Where in its voxel a grasp stands.
    pub voxel_origin: VoxelOrigin,
    /// Where the camera stood in training, where it always stood on the same side: degrees about the vertical axis
    /// through the middle of the volume, from x towards y. `None` for a network that takes any view.
    pub camera_azimuth: Option<f64>,
    /// Where the weights come from: data, seeds, steps, date and whatever else was noted (`graspd.provenance.…`).
    pub provenance: BTreeMap<String, String>,
}

/// What a voxel's value means to a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ValueConvention {
    /// VGN's: (tsdf + 1) / 2 near an observed surface, 0 elsewhere. What [`grasp::Volume`] holds.
    #[default]
    Vgn,
}

/// Metadata that cannot be.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum MetadataError {
    /// A property cannot be what it says.
    #[error("the model's property `graspd.{key}` is `{value}`, it must be {expected}")]
    Property {
        /// Which property, without `graspd.`.
        key: &'static str,
        /// Its value.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// No volume has as many voxels as the network reads, by its property or by its input's shape.
    #[error(
        "the model's resolution is {0}, it must be from 1 to {max}; export it for a volume of at most {max}³ voxels",
        max = Volume::MAX_RESOLUTION
    )]
    Resolution(usize),
}

pub(crate) const PREFIX: &str = "graspd.";
pub(crate) const PROVENANCE: &str = "provenance.";

impl Metadata {
    /// What a file without properties means: VGN's conventions, named after the file.
    ///
    /// `resolution` is that of the input's shape, where it is fixed.
    #[must_use]
    pub fn defaults(path: &Path, resolution: Option<usize>) -> Self {
        let resolution = resolution.unwrap_or(RESOLUTION);
        Self {
            name: path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            version: "1".to_owned(),
            resolution,
            voxel_size: WORKSPACE_SIZE / resolution as f64,
            value_convention: ValueConvention::Vgn,
            voxel_origin: VoxelOrigin::Corner,
            camera_azimuth: None,
            provenance: BTreeMap::new(),
        }
    }

    /// The metadata of a model that was read from `path`; what the file does not say has its [default](Self::defaults).
    ///
    /// # Errors
    /// [`MetadataError`] names the property that cannot be.
    pub fn of(model: &ModelProto, path: &Path) -> Result<Self, MetadataError> {
        let input = model.graph.as_ref().and_then(|graph| graph.input.first());
        let properties = model.metadata_props.iter().filter_map(|p| Some((p.key.clone()?, p.value.clone()?)));
        Self::from_properties(properties, Self::defaults(path, input.and_then(fixed_resolution)))
    }

    /// Overwrites `defaults` with every `graspd.…` property.
    pub(crate) fn from_properties(
        properties: impl IntoIterator<Item = (String, String)>,
        defaults: Self,
    ) -> Result<Self, MetadataError> {
        let mut metadata = Self { resolution: check_resolution(defaults.resolution)?, ..defaults };
        for (key, value) in properties {
            let Some(key) = key.strip_prefix(PREFIX) else { continue };
            match key {
                "name" => metadata.name = value,
                "version" => metadata.version = value,
                "resolution" => {
                    let resolution = parse("resolution", &value, "a whole number of voxels above 0", |&n| n > 0)?;
                    metadata.resolution = check_resolution(resolution)?;
                }
                "voxel_size" => {
                    let valid = |&size: &f64| size.is_finite() && size > 0.0;
                    metadata.voxel_size = parse("voxel_size", &value, "a number of metres above 0", valid)?;
                }
                "value_convention" => {
                    metadata.value_convention = match value.as_str() {
                        "vgn" => ValueConvention::Vgn,
                        _ => return Err(MetadataError::Property { key: "value_convention", value, expected: "`vgn`" }),
                    }
                }
                "voxel_origin" => {
                    metadata.voxel_origin = match value.as_str() {
                        "corner" => VoxelOrigin::Corner,
                        "center" => VoxelOrigin::Center,
                        _ => {
                            let expected = "`corner` or `center`";
                            return Err(MetadataError::Property { key: "voxel_origin", value, expected });
                        }
                    }
                }
                "camera_azimuth" => {
                    let azimuth =
                        parse("camera_azimuth", &value, "a number of degrees", |angle: &f64| angle.is_finite())?;
                    metadata.camera_azimuth = Some(azimuth);
                }
                _ => {
                    if let Some(key) = key.strip_prefix(PROVENANCE) {
                        metadata.provenance.insert(key.to_owned(), value);
                    }
                }
            }
        }
        Ok(metadata)
    }

    /// Replaces the model's `graspd.…` properties by these, keeping the others.
    pub fn write_to(&self, model: &mut ModelProto) {
        model.metadata_props.retain(|p| !p.key().starts_with(PREFIX));
        let mut put = |key: &str, value: String| {
            let key = Some(format!("{PREFIX}{key}"));
            model.metadata_props.push(StringStringEntryProto { key, value: Some(value) });
        };
        let ValueConvention::Vgn = self.value_convention;
        put("name", self.name.clone());
        put("version", self.version.clone());
        put("resolution", self.resolution.to_string());
        put("voxel_size", self.voxel_size.to_string());
        put("value_convention", "vgn".to_owned());
        put("voxel_origin", self.voxel_origin.name().to_owned());
        if let Some(azimuth) = self.camera_azimuth {
            put("camera_azimuth", azimuth.to_string());
        }
        for (key, value) in &self.provenance {
            put(&format!("{PROVENANCE}{key}"), value.clone());
        }
    }

    /// VGN's decoding for this network: its voxel origin, everything else as in [`DecodeParams::default`].
    #[must_use]
    pub fn decode_params(&self) -> DecodeParams {
        DecodeParams { origin: self.voxel_origin, ..DecodeParams::default() }
    }
}

/// The resolution an input of shape `[batch, 1, N, N, N]` fixes.
fn fixed_resolution(input: &ValueInfoProto) -> Option<usize> {
    let dims = &input.tensor_type()?.shape.as_ref()?.dim;
    match dims.last()?.value {
        Some(DimensionValue::DimValue(size)) => usize::try_from(size).ok().filter(|&size| size > 0),
        _ => None,
    }
}

/// Refused when the file is read, lest a server starts with a network that no request can fit.
fn check_resolution(resolution: usize) -> Result<usize, MetadataError> {
    if (1..=Volume::MAX_RESOLUTION).contains(&resolution) {
        Ok(resolution)
    } else {
        Err(MetadataError::Resolution(resolution))
    }
}

fn parse<T: FromStr>(
    key: &'static str,
    value: &str,
    expected: &'static str,
    valid: impl Fn(&T) -> bool,
) -> Result<T, MetadataError> {
    let wrong = || MetadataError::Property { key, value: value.to_owned(), expected };
    value.parse().ok().filter(valid).ok_or_else(wrong)
}
