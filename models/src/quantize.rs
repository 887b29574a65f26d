//! Quantises weights and activations to 8-bit integers in ONNX's QDQ form: the inputs of integer kernels pass through
//! `QuantizeLinear` and `DequantizeLinear`. A runtime fuses these nodes with the operator, or executes them separately
//! if it has no integer kernel.
//!
//! The scheme follows ONNX Runtime's static quantisation: weights are symmetric with one scale per output channel;
//! activations are u8 with one scale and zero point, from the range observed on real volumes.

use std::collections::{HashMap, HashSet};

use thiserror::Error;

use crate::onnx::{AttributeProto, GraphProto, ModelProto, NodeProto, TensorError, TensorProto};

/// Range of the values of an activation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActivationRange {
    /// Smallest value.
    pub low: f32,
    /// Largest value.
    pub high: f32,
}

/// Why a network cannot be quantised.
#[derive(Debug, Error)]
pub enum QuantizeError {
    /// The range of an activation is missing.
    #[error("no calibrated range for the activation `{0}`")]
    MissingRange(String),
    /// A weight cannot be read.
    #[error(transparent)]
    Tensor(#[from] TensorError),
}

/// A convolution or matrix product with a stored weight, which can be computed in 8 bits.
struct QuantizableProduct<'a> {
    node: &'a NodeProto,
    weight: &'a TensorProto,
    /// The axis of the weight's output channels.
    axis: usize,
}

/// The activations whose ranges [`with_int8`] needs.
#[must_use]
pub fn quantized_activations(model: &ModelProto) -> Vec<String> {
    let Some(graph) = &model.graph else { return Vec::new() };
    let mut names: Vec<String> = products(graph)
        .iter()
        .flat_map(|product| [product.input(), product.output(graph)])
        .map(str::to_owned)
        .collect();
    names.sort();
    names.dedup();
    names
}

/// The model with its products with f32 weights computed in 8 bits. The last products before the outputs stay f32,
/// because their rounding would directly affect the grasps.
///
/// # Errors
/// [`QuantizeError`] names the activation without a range, or the weight that cannot be read.
pub fn with_int8(model: &ModelProto, ranges: &HashMap<String, ActivationRange>) -> Result<ModelProto, QuantizeError> {
    let Some(graph) = &model.graph else { return Ok(model.clone()) };
    let products = products(graph);
    let mut quantized =
        GraphProto { node: Vec::new(), initializer: Vec::new(), value_info: Vec::new(), ..graph.clone() };
    let mut activations = HashMap::new();
    for name in products.iter().flat_map(|product| [product.input(), product.output(graph)]) {
        let range = ranges.get(name).ok_or_else(|| QuantizeError::MissingRange(name.to_owned()))?;
        activations.insert(name, range.scale());
    }

    // Weights and biases of products are replaced.
    let replaced: HashSet<&str> =
        products.iter().flat_map(|product| &product.node.input[1..]).map(String::as_str).collect();
    let kept = |tensor: &&TensorProto| !replaced.contains(tensor.name());
    quantized.initializer.extend(graph.initializer.iter().filter(kept).cloned());

    if let Some(input) = graph.input.first().map(|input| input.name())
        && let Some(&scale) = activations.get(input)
    {
        quantize_activation(&mut quantized, input, scale);
    }
    for node in &graph.node {
        let mut node = node.clone();
        let product = products.iter().find(|product| product.node.output == node.output);
        for input in &mut node.input {
            // Other readers of a quantised activation get the same rounded values as the integer kernels.
            if activations.contains_key(input.as_str()) {
                *input = dequantized(input);
            }
        }
        if let Some(product) = product {
            let (scale, _) = activations[product.input()];
            let name = product.node.input.get(2).filter(|name| !name.is_empty());
            let bias = name.map(|name| bias(graph, name)).transpose()?;
            let scales = quantize_weight(&mut quantized, product, bias.as_deref().unwrap_or_default(), scale)?;
            node.input[1] = dequantized(product.weight.name());
            if let (Some(name), Some(bias)) = (name, bias) {
                quantize_bias(&mut quantized, name, &bias, &scales, scale);
                node.input[2] = dequantized(name);
            }
        }
        let outputs = node.output.clone();
        quantized.node.push(node);
        for output in &outputs {
            if let Some(&scale) = activations.get(output.as_str()) {
                quantize_activation(&mut quantized, output, scale);
            }
        }
    }
    Ok(ModelProto { graph: Some(quantized), ..model.clone() })
}

/// The products that are quantised, in graph order.
fn products<'a>(graph: &'a GraphProto) -> Vec<QuantizableProduct<'a>> {
    let final_products = final_products(graph);
    let weights: HashMap<&str, &TensorProto> = graph.initializer.iter().map(|tensor| (tensor.name(), tensor)).collect();
    let mut readers: HashMap<&str, usize> = HashMap::new();
    for input in graph.node.iter().flat_map(|node| &node.input) {
        *readers.entry(input).or_default() += 1;
    }
    let product =
        |node: &'a NodeProto| {
            let weight = *weights.get(node.input.get(1)?.as_str())?;
            let axis = match (node.op_type(), weight.dims.len()) {
                ("Conv", _) => 0,
                ("ConvTranspose", _) | ("MatMul", 2) => 1,
                _ => return None,
            };
            // Weight and bias are replaced, so they must be stored and have no other reader.
            let stored = |name: &str| name.is_empty() || (weights.contains_key(name) && readers[name] == 1);
            let own = node.input[1..].iter().all(|name| stored(name));
            (own && weight.is_float() && !final_products.contains(node.output[0].as_str()))
                .then_some(QuantizableProduct { node, weight, axis })
        };
    graph.node.iter().filter_map(product).collect()
}

/// The outputs of the products that no other product depends on.
fn final_products(graph: &GraphProto) -> HashSet<&str> {
    let (mut followed, mut last) = (HashSet::new(), HashSet::new());
    for node in graph.node.iter().rev() {
        let is_product = matches!(node.op_type(), "Conv" | "ConvTranspose" | "MatMul");
        let followed_here = node.output.iter().any(|output| followed.contains(output.as_str()));
        if is_product && !followed_here {
            last.extend(node.output.iter().map(String::as_str));
        }
        if is_product || followed_here {
            followed.extend(node.input.iter().map(String::as_str));
        }
    }
    last
}

impl QuantizableProduct<'_> {
    fn input(&self) -> &str {
        &self.node.input[0]
    }

    /// The value that is quantised as its output: that of a ReLU if it is the only reader, because quantisation then
    /// includes the ReLU at no cost.
    fn output<'a>(&'a self, graph: &'a GraphProto) -> &'a str {
        let output = self.node.output[0].as_str();
        let mut readers = graph.node.iter().filter(|node| node.input.iter().any(|input| input == output));
        match (readers.next(), readers.next()) {
            (Some(reader), None) if reader.op_type() == "Relu" => &reader.output[0],
            _ => output,
        }
    }
}

impl ActivationRange {
    /// Scale and zero point of u8 for this range extended to 0. Padding needs an exact 0.
    fn scale(self) -> (f32, u8) {
        let (low, high) = (self.low.min(0.0), self.high.max(0.0));
        let scale = if high > low { (high - low) / 255.0 } else { 1.0 };
        (scale, (-low / scale).round().clamp(0.0, 255.0) as u8)
    }
}

fn dequantized(name: &str) -> String {
    format!("{name}.dequantized")
}

/// Adds nodes that quantise an activation to u8 and dequantise it.
fn quantize_activation(graph: &mut GraphProto, name: &str, (scale, zero): (f32, u8)) {
    let (scale_name, zero_name, quantized) =
        (format!("{name}.scale"), format!("{name}.zero"), format!("{name}.quantized"));
    graph.initializer.push(TensorProto::from_f32(&scale_name, &[], &[scale]));
    graph.initializer.push(TensorProto::from_u8(&zero_name, &[], &[zero]));
    graph.node.push(node("QuantizeLinear", [name, &scale_name, &zero_name], &quantized, None));
    graph.node.push(node("DequantizeLinear", [&quantized, &scale_name, &zero_name], &dequantized(name), None));
}

/// The values of a stored bias.
fn bias(graph: &GraphProto, name: &str) -> Result<Vec<f32>, QuantizeError> {
    let tensor = graph.initializer.iter().find(|tensor| tensor.name() == name);
    Ok(tensor.ok_or_else(|| QuantizeError::MissingRange(name.to_owned()))?.to_f32()?)
}

/// Quantises the product's weight to i8 and returns the scales of its output channels. They are large enough for the
/// bias, which is stored in units of weight scale and `input_scale`: half of the range of i32, for the sums.
fn quantize_weight(
    graph: &mut GraphProto,
    product: &QuantizableProduct,
    bias: &[f32],
    input_scale: f32,
) -> Result<Vec<f32>, TensorError> {
    let QuantizableProduct { weight, axis, .. } = *product;
    let values = weight.to_f32()?;
    // None is negative: the number of values has been checked.
    let dims: Vec<usize> = weight.dims.iter().map(|&dim| dim as usize).collect();
    let inner: usize = dims[axis + 1..].iter().product();
    let channel = |index: usize| index / inner % dims[axis];

    let mut scales = vec![0.0_f32; dims[axis]];
    for (index, value) in values.iter().enumerate() {
        let scale = &mut scales[channel(index)];
        *scale = scale.max(value.abs() / 127.0);
    }
    for (scale, value) in scales.iter_mut().zip(bias) {
        *scale = scale.max(value.abs() / input_scale / (i32::MAX / 2) as f32);
    }
    for scale in scales.iter_mut().filter(|scale| **scale == 0.0) {
        *scale = 1.0;
    }
    let round = |(index, value): (usize, &f32)| (value / scales[channel(index)]).round() as i8;
    let values: Vec<i8> = values.iter().enumerate().map(round).collect();

    let name = weight.name();
    let [stored, scale, zero] = ["i8", "scale", "zero"].map(|suffix| format!("{name}.{suffix}"));
    let channels = [scales.len() as i64];
    graph.initializer.push(TensorProto::from_i8(&stored, &weight.dims, &values));
    graph.initializer.push(TensorProto::from_f32(&scale, &channels, &scales));
    graph.initializer.push(TensorProto::from_i8(&zero, &channels, &vec![0; scales.len()]));
    graph.node.push(node("DequantizeLinear", [&stored, &scale, &zero], &dequantized(name), Some(axis)));
    Ok(scales)
}

/// Quantises a bias to i32 in the units of the product's sums, as integer kernels require.
fn quantize_bias(graph: &mut GraphProto, name: &str, bias: &[f32], weight_scales: &[f32], input_scale: f32) {
    let scales: Vec<f32> = weight_scales.iter().map(|scale| scale * input_scale).collect();
    let values: Vec<i32> = bias.iter().zip(&scales).map(|(value, scale)| (value / scale).round() as i32).collect();
    let [stored, scale, zero] = ["i32", "scale", "zero"].map(|suffix| format!("{name}.{suffix}"));
    let channels = [scales.len() as i64];
    graph.initializer.push(TensorProto::from_i32(&stored, &channels, &values));
    graph.initializer.push(TensorProto::from_f32(&scale, &channels, &scales));
    graph.initializer.push(TensorProto::from_i32(&zero, &channels, &vec![0; scales.len()]));
    graph.node.push(node("DequantizeLinear", [&stored, &scale, &zero], &dequantized(name), Some(0)));
}

fn node(op: &str, inputs: [&str; 3], output: &str, axis: Option<usize>) -> NodeProto {
    NodeProto {
        op_type: Some(op.to_owned()),
        name: Some(output.to_owned()),
        input: inputs.map(str::to_owned).to_vec(),
        output: vec![output.to_owned()],
        attribute: axis.map(|axis| AttributeProto::int("axis", axis as i64)).into_iter().collect(),
        ..NodeProto::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bias_that_is_large_for_its_weights_keeps_its_value() {
        const BIAS: f32 = 3.0;
        let mut model = crate::build("vgn", 0).unwrap();
        let ranges = quantized_activations(&model);
        let ranges = ranges.into_iter().map(|name| (name, ActivationRange { low: 0.0, high: 1.0 })).collect();
        let graph = model.graph.as_mut().unwrap();
        let [weight, bias] = [1, 2].map(|input| graph.node[0].input[input].clone());
        for tensor in &mut graph.initializer {
            // In units of 1e-10 / 127 and 1 / 255, the bias would exceed i32.
            match tensor.name() {
                name if name == weight => tensor.set_f32(&vec![1e-10; tensor.elements()]),
                name if name == bias => tensor.set_f32(&vec![BIAS; tensor.elements()]),
                _ => {}
            }
        }
        let int8 = with_int8(&model, &ranges).unwrap().graph.unwrap();
        let stored = |name: String| int8.initializer.iter().find(|tensor| tensor.name() == name).unwrap();
        let scales = stored(format!("{bias}.scale")).to_f32().unwrap();
        let bytes = stored(format!("{bias}.i32")).raw_data().to_vec();
        let values: Vec<i32> = bytes.as_chunks().0.iter().map(|&bytes| i32::from_le_bytes(bytes)).collect();
        assert_eq!(values.len(), scales.len());
        for (value, scale) in values.into_iter().zip(scales) {
            assert!(value <= i32::MAX / 2 + 128, "room for the sums: {value}");
            assert!((value as f32 * scale - BIAS).abs() < 1e-4, "{value} × {scale}");
        }
    }
}
