//! The networks of graspd: their definitions as ONNX graphs, the files they are kept in, and ONNX Runtime.
//!
//! [`build`] defines a network with random weights; its [`Metadata`] travels inside the file; a [`Store`] is a folder
//! of such files; a [`Network`] runs one. [`gpd`] defines the classifier of grasp candidates, which a [`Classifier`]
//! runs.

pub mod gpd;
mod graph;
mod half;
mod heads;
mod metadata;
mod networks;
pub mod onnx;
mod quantize;
mod rotation_average;
mod runtime;
mod store;
mod transformer;
mod upsampling;
mod vgn;

pub use half::{with_full_weights, with_half_weights};
pub use heads::{Orientation, with_published_heads};
pub use metadata::{Metadata, MetadataError, ValueConvention};
pub use networks::{Architecture, BuildError, build};
pub use quantize::{QuantizeError, Range, quantized_activations, with_int8};
pub use rotation_average::{RotationAverageError, averaged_over_rotations};
pub use runtime::{
    Backend, BackendError, Choice, Classifier, INPUT, LoadError, LoadReason, NameError, Network, OUTPUTS, Options,
    Output, Precision, Provider, RuntimeError, RuntimeInfo, batch_sizes, init,
};
pub use store::{Entry, EntryError, Scan, Store, StoreError};
pub use upsampling::{upsampled_convolutions, upsampled_taps};
