//! Tests of networks, model files and ONNX Runtime. One program, because each would be linked with everything else.

mod conformance;
mod evaluators;
mod files;
mod large;
mod networks;
mod runtime;
mod scenes;
mod snapshots;
