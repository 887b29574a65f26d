//! Weights stored as f16, half the file: what computes stays f32, for each is cast as the model is loaded.
//!
//! ONNX Runtime folds the casts once, so that such a model runs as fast as the other.

use std::collections::{HashMap, HashSet};

use half::f16;

use crate::onnx::{AttributeProto, DataType, GraphProto, ModelProto, NodeProto, TensorError, TensorProto};

/// What the name of a weight ends with where it is stored as f16.
const SUFFIX: &str = ".f16";

/// Smaller ones, such as biases and the scales of norms, are left as they are.
const SMALLEST: usize = 1024;

/// The greatest of f16.
const LARGEST: f32 = 65504.0;

/// The model with its weights stored as f16. One with a value that f16 does not hold stays f32.
///
/// # Errors
/// [`TensorError`] names a weight whose values cannot be read.
pub fn with_half_weights(model: &ModelProto) -> Result<ModelProto, TensorError> {
    let mut model = model.clone();
    let Some(graph) = &mut model.graph else { return Ok(model) };
    let mut casts = Vec::new();
    for weight in &mut graph.initializer {
        if weight.element_type() != DataType::Float || weight.elements() < SMALLEST {
            continue;
        }
        let values = weight.to_f32()?;
        if !values.iter().all(|value| value.abs() <= LARGEST) {
            continue;
        }
        let (name, stored) = (weight.name().to_owned(), format!("{}{SUFFIX}", weight.name()));
        weight.name = Some(stored.clone());
        weight.data_type = Some(DataType::Float16.into());
        weight.float_data.clear();
        weight.raw_data = Some(values.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect());
        casts.push(NodeProto {
            op_type: Some("Cast".to_owned()),
            name: Some(format!("{name}.cast")),
            input: vec![stored],
            output: vec![name],
            attribute: vec![AttributeProto::int("to", i64::from(i32::from(DataType::Float)))],
            ..NodeProto::default()
        });
    }
    graph.node.splice(0..0, casts);
    Ok(model)
}

/// The model with those weights as f32 again, as it was but for what f16 rounded.
///
/// # Errors
/// [`TensorError`] names a weight whose values cannot be read.
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

/// The casts of weights stored as f16: from the stored name to the other.
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
