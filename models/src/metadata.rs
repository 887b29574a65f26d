use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use grasp::{DecodeParams, RESOLUTION, Volume, VoxelOrigin, WORKSPACE_SIZE};

use crate::calibration::Calibration;
use crate::metadata_error::{MetadataError, PREFIX};
use crate::onnx::{DimensionValue, ModelProto, StringStringEntryProto, ValueInfoProto};

/// Metadata of a model, stored in its file as properties named `graspd.…`.
#[derive(Clone, Debug, PartialEq)]
pub struct Metadata {
    /// Name of the model in requests.
    pub name: String,
    /// Name that the model had before; requests may still use it.
    pub former_name: Option<String>,
    /// Version: numbers separated by dots.
    pub version: String,
    /// Voxels along an edge of its volumes.
    pub resolution: usize,
    /// Edge of a voxel in training, metres.
    pub voxel_size: f64,
    /// Position of a grasp in its voxel.
    pub voxel_origin: VoxelOrigin,
    /// Azimuth of the camera in training, if it was constant: degrees about the vertical axis through the middle of the
    /// volume, from x towards y. `None` for a network that accepts any view.
    pub camera_azimuth: Option<f64>,
    /// Name of the network whose grasps an evaluator scores. `None` for other models.
    pub network: Option<String>,
    /// Origin of the weights: data, seeds, steps, date and other entries (`graspd.provenance.…`).
    pub provenance: BTreeMap<String, String>,
}

/// Maximum length of a name or version, bytes.
const MAX_NAME: usize = 128;

pub(crate) const PROVENANCE: &str = "provenance.";

impl Metadata {
    /// Metadata of a file without properties: VGN's conventions, and the file name as the name.
    ///
    /// `resolution` is that of the input's shape, if it is fixed.
    #[must_use]
    pub fn defaults(path: &Path, resolution: Option<usize>) -> Self {
        let resolution = resolution.unwrap_or(RESOLUTION);
        Self {
            name: path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            former_name: None,
            version: "1".to_owned(),
            resolution,
            voxel_size: WORKSPACE_SIZE / resolution as f64,
            voxel_origin: VoxelOrigin::Corner,
            camera_azimuth: None,
            network: None,
            provenance: BTreeMap::new(),
        }
    }

    /// The metadata of a model read from `path`. Missing properties have their [defaults](Self::defaults).
    ///
    /// # Errors
    /// [`MetadataError`] names the invalid property.
    pub fn from_model(model: &ModelProto, path: &Path) -> Result<Self, MetadataError> {
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
        let mut voxel_size = None;
        for (key, value) in properties {
            let Some(key) = key.strip_prefix(PREFIX) else { continue };
            match key {
                "name" => metadata.name = printable("name", value)?,
                "former_name" => metadata.former_name = Some(printable("former_name", value)?),
                "version" => metadata.version = printable("version", value)?,
                "resolution" => {
                    let resolution = parse("resolution", &value, "a whole number of voxels above 0", |&n| n > 0)?;
                    metadata.resolution = check_resolution(resolution)?;
                }
                "voxel_size" => {
                    let valid = |&size: &f64| size.is_finite() && size > 0.0;
                    voxel_size = Some(parse("voxel_size", &value, "a number of metres above 0", valid)?);
                }
                // Only VGN's convention is supported: (tsdf + 1) / 2 near an observed surface, 0 elsewhere.
                "value_convention" if value == "vgn" => {}
                "value_convention" => {
                    return Err(MetadataError::Property { key: "value_convention", value, expected: "`vgn`" });
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
                "network" => metadata.network = Some(printable("network", value)?),
                // Only checked here; the classifier reads it.
                "calibration" => {
                    if let Err(expected) = value.parse::<Calibration>() {
                        return Err(MetadataError::Property { key: "calibration", value, expected });
                    }
                }
                _ => match key.strip_prefix(PROVENANCE) {
                    Some(key) => _ = metadata.provenance.insert(key.to_owned(), value),
                    None => return Err(MetadataError::Unknown(on_one_line(key))),
                },
            }
        }
        metadata.voxel_size = voxel_size.unwrap_or(WORKSPACE_SIZE / metadata.resolution as f64);
        Ok(metadata)
    }

    /// Replaces the `graspd.…` properties of the model by these and keeps the others.
    pub fn write_to(&self, model: &mut ModelProto) {
        model.metadata_props.retain(|p| !p.key().starts_with(PREFIX));
        let mut put = |key: &str, value: String| {
            let key = Some(format!("{PREFIX}{key}"));
            model.metadata_props.push(StringStringEntryProto { key, value: Some(value) });
        };
        put("name", self.name.clone());
        if let Some(name) = &self.former_name {
            put("former_name", name.clone());
        }
        put("version", self.version.clone());
        put("resolution", self.resolution.to_string());
        put("voxel_size", self.voxel_size.to_string());
        put("value_convention", "vgn".to_owned());
        put("voxel_origin", self.voxel_origin.name().to_owned());
        if let Some(azimuth) = self.camera_azimuth {
            put("camera_azimuth", azimuth.to_string());
        }
        if let Some(network) = &self.network {
            put("network", network.clone());
        }
        for (key, value) in &self.provenance {
            put(&format!("{PROVENANCE}{key}"), value.clone());
        }
    }

    /// The decoding parameters of this network: its voxel origin, otherwise [`DecodeParams::default`].
    #[must_use]
    pub fn decode_params(&self) -> DecodeParams {
        DecodeParams { origin: self.voxel_origin, ..DecodeParams::default() }
    }
}

/// The resolution in the shape of an input `[batch, 1, N, N, N]`, if it is fixed.
fn fixed_resolution(input: &ValueInfoProto) -> Option<usize> {
    let dims = &input.tensor_type()?.shape.as_ref()?.dim;
    match dims.last()?.value {
        Some(DimensionValue::DimValue(size)) => usize::try_from(size).ok().filter(|&size| size > 0),
        _ => None,
    }
}

/// Names and versions are labels of metrics and parts of log lines, so their length and characters are limited.
fn printable(key: &'static str, value: String) -> Result<String, MetadataError> {
    let is_printable = |character: char| !character.is_control() && !character.is_whitespace() || character == ' ';
    if (1..=MAX_NAME).contains(&value.len()) && value.chars().all(is_printable) {
        return Ok(value);
    }
    Err(MetadataError::Property { key, value: on_one_line(&value), expected: "1 to 128 bytes of printable characters" })
}

/// The beginning of a text, for error messages.
fn on_one_line(text: &str) -> String {
    let start: String = text.chars().take(20).collect();
    format!("{}{}", start.escape_debug(), if start.len() < text.len() { "…" } else { "" })
}

/// Checked when the file is read, so that a server does not start with a network that no request can use.
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
