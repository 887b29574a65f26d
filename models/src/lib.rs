//! The networks of graspd: their definitions as ONNX graphs, model files with metadata, and ONNX Runtime.
//!
//! [`build`] creates a network with random weights. A model file contains its [`Metadata`]. A [`Store`] is a folder of
//! model files. A [`Network`] runs one of them. [`gpd`] defines the classifier of grasp candidates, [`evaluator`] that of
//! the poses of a network's grasps. A [`Classifier`] runs both.

mod calibration;
mod coarse;
mod evaluator;
pub mod gpd;
mod graph;
mod half_computation;
mod half_weights;
mod metadata;
mod metadata_error;
mod networks;
pub mod onnx;
mod output_heads;
mod quantize;
mod rotation_average;
mod runtime;
mod store;
mod transformer;
mod upsampling;
mod vgn;

pub use calibration::Calibration;
pub use coarse::{coarse_evaluator_of, with_coarse_evaluator, without_coarse_evaluator};
pub use evaluator::{coarse_evaluator, evaluator};
pub use half_weights::{with_full_weights, with_half_weights};
pub use metadata::Metadata;
pub use metadata_error::MetadataError;
pub use networks::{Architecture, BuildError, build};
pub use output_heads::{Orientation, with_published_heads};
pub use quantize::{ActivationRange, QuantizeError, quantized_activations, with_int8};
pub use rotation_average::{RotationAverageError, averaged_over_rotations};
pub use runtime::{
    Backend, BackendError, Choice, Classifier, ClassifierKind, INPUT, LoadError, LoadReason, NameError, Network,
    OUTPUTS, Options, Output, Precision, Provider, RuntimeError, RuntimeInfo, batch_sizes, init,
};
pub use store::{Entry, EntryError, MAX_MODEL_BYTES, Scan, Store, StoreError, own_models, read_regular_file};
pub use upsampling::{upsampled_convolutions, upsampled_taps};
