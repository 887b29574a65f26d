use grasp::Volume;
use thiserror::Error;

/// Begins the names of graspd's properties in a model file.
pub(crate) const PREFIX: &str = "graspd.";

/// Invalid metadata.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum MetadataError {
    /// A property has an invalid value.
    #[error("the model's property `graspd.{key}` is `{value}`, must be {expected}")]
    Property {
        /// Name of the property without `graspd.`.
        key: &'static str,
        /// Its value.
        value: String,
        /// Valid values.
        expected: &'static str,
    },
    /// A property is not known. Ignoring a misspelt one would change the grasps.
    #[error(
        "the model's property `graspd.{0}` is not known; the properties are name, version, resolution, voxel_size, \
         value_convention, voxel_origin, camera_azimuth, network, calibration and provenance.…"
    )]
    Unknown(String),
    /// The resolution, from the property or from the shape of the input, is out of range.
    #[error(
        "the model's resolution is {0}, must be from 1 to {max}; export it for a volume of at most {max}³ voxels",
        max = Volume::MAX_RESOLUTION
    )]
    Resolution(usize),
}
