//! Weights stored as f16, which halves the file. Computation stays f32: each weight is cast when the model is loaded.
//!
//! ONNX Runtime folds the casts when it loads the model, so the speed is the same.

use std::collections::{HashMap, HashSet};

use crate::onnx::{DataType, GraphProto, ModelProto, NodeProto, TensorError, TensorProto};

/// Suffix of the names of weights that are stored as f16.
const SUFFIX: &str = ".f16";

/// Smallest number of elements to convert. Smaller tensors, such as biases and norm scales, stay f32.
const MIN_ELEMENTS: usize = 1024;

/// Largest finite f16.
const F16_MAX: f32 = 65504.0;

/// The model with its weights stored as f16. Weights with values beyond the range of f16 stay f32.
///
/// # Errors
/// [`TensorError`] names the weight that cannot be read.
pub fn with_half_weights(model: &ModelProto) -> Result<ModelProto, TensorError> {
    let mut model = model.clone();
    let Some(graph) = &mut model.graph else { return Ok(model) };
    let mut casts = Vec::new();
    for weight in &mut graph.initializer {
        if weight.element_type() != DataType::Float || weight.elements() < MIN_ELEMENTS {
            continue;
        }
        let values = weight.to_f32()?;
        if !values.iter().all(|value| value.abs() <= F16_MAX) {
            continue;
        }
        let stored = format!("{}{SUFFIX}", weight.name());
        casts.push(NodeProto::cast(&stored, weight.name(), DataType::Float));
        *weight = TensorProto::from_f32_as_f16(&stored, &weight.dims, &values);
    }
    graph.node.splice(0..0, casts);
    Ok(model)
}

/// The inverse of [`with_half_weights`], except for the rounding to f16.
///
/// # Errors
/// [`TensorError`] names the weight that cannot be read.
pub fn with_full_weights(model: &ModelProto) -> Result<ModelProto, TensorError> {
    let mut model = model.clone();
    let Some(graph) = &mut model.graph else { return Ok(model) };
    let casts = casts(graph);
    for weight in &mut graph.initializer {
        if let Some(name) = casts.get(weight.name()) {
            let values = weight.to_f32()?;
            *weight = TensorProto::from_f32(name, &weight.dims, &values);
        }
    }
    let restored: HashSet<&String> = casts.values().collect();
    graph.node.retain(|node| !(node.op_type() == "Cast" && node.output.iter().all(|name| restored.contains(name))));
    Ok(model)
}

/// The casts of f16 weights: stored name → name of the f32 weight.
fn casts(graph: &GraphProto) -> HashMap<String, String> {
    let halves: HashSet<&str> = graph
        .initializer
        .iter()
        .filter(|weight| weight.element_type() == DataType::Float16)
        .map(|weight| weight.name())
        .collect();
    let of_half = |node: &&NodeProto| {
        node.op_type() == "Cast" && node.input.first().is_some_and(|input| halves.contains(input.as_str()))
    };
    let casts = graph.node.iter().filter(of_half);
    casts.filter_map(|node| Some((node.input.first()?.clone(), node.output.first()?.clone()))).collect()
}
