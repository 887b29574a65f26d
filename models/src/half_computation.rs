//! Computation in f16, for GPUs.
//!
//! Everything up to the last convolution or matrix product is computed in f16. What follows, such as the sigmoid of the
//! quality and the normalisation of the rotation, stays f32: it costs little, and its squares and quotients would lose
//! accuracy. Inputs and outputs stay f32. ONNX Runtime's kernels accumulate sums in f32.

use std::collections::{HashMap, HashSet};

use crate::onnx::{DataType, GraphProto, ModelProto, NodeProto, TensorError, TensorProto};

/// Suffix of the names of values in f16.
const SUFFIX: &str = ".f16";

/// Operators after the last of which the computation stays f32.
const PRODUCTS: [&str; 3] = ["Conv", "ConvTranspose", "MatMul"];

/// Operators that compute in f16, with inputs and outputs of the same type.
const SUPPORTED: [&str; 22] = [
    "Add",
    "Concat",
    "Conv",
    "ConvTranspose",
    "Div",
    "Erf",
    "Flatten",
    "InstanceNormalization",
    "LayerNormalization",
    "LeakyRelu",
    "MatMul",
    "MaxPool",
    "Mul",
    "Relu",
    "Reshape",
    "Resize",
    "Sigmoid",
    "Slice",
    "Softmax",
    "Split",
    "Sub",
    "Transpose",
];

/// Why a graph cannot compute in f16.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HalfError {
    /// The operator is not in the list.
    #[error("the operator {0} cannot be converted to fp16")]
    Operator(String),
    /// A weight cannot be read.
    #[error(transparent)]
    Tensor(#[from] TensorError),
}

/// The model with its convolutions and matrix products in f16. Weights must be f32
/// ([`with_full_weights`](crate::with_full_weights)).
///
/// # Errors
/// [`HalfError`] names the operator that cannot be converted, or the weight that cannot be read.
pub(crate) fn with_half_computation(model: &ModelProto) -> Result<ModelProto, HalfError> {
    let mut model = model.clone();
    let Some(graph) = model.graph.take() else { return Ok(model) };
    let conversion = Conversion::new(&graph)?;
    model.graph = Some(conversion.apply(&graph)?);
    Ok(model)
}

struct Conversion<'a> {
    /// Nodes that compute in f16.
    nodes: HashSet<usize>,
    /// Their outputs.
    halves: HashSet<&'a str>,
    /// Values that are read in f32.
    read_in_f32: HashSet<&'a str>,
    /// Values that are no floating-point numbers.
    integers: HashSet<&'a str>,
    weights: HashMap<&'a str, &'a TensorProto>,
}

impl<'a> Conversion<'a> {
    fn new(graph: &'a GraphProto) -> Result<Self, HalfError> {
        let nodes = up_to_products(graph);
        for &index in &nodes {
            let op = graph.node[index].op_type();
            if !SUPPORTED.contains(&op) {
                return Err(HalfError::Operator(op.to_owned()));
            }
        }
        let halves = nodes.iter().flat_map(|&index| &graph.node[index].output).map(String::as_str).collect();
        let others = graph.node.iter().enumerate().filter(|(index, _)| !nodes.contains(index));
        let mut read_in_f32: HashSet<&str> = others.flat_map(|(_, node)| &node.input).map(String::as_str).collect();
        read_in_f32.extend(graph.output.iter().map(|output| output.name()));
        let mut integers: HashSet<&str> =
            graph.initializer.iter().filter(|tensor| !tensor.is_float()).map(|tensor| tensor.name()).collect();
        for node in graph.node.iter().filter(|node| node.op_type() == "Constant") {
            let value = node.attribute("value").and_then(|value| value.t.as_ref());
            if value.is_some_and(|value| !value.is_float()) {
                integers.extend(node.output.iter().map(String::as_str));
            }
        }
        let weights = graph.initializer.iter().map(|tensor| (tensor.name(), tensor)).collect();
        Ok(Self { nodes, halves, read_in_f32, integers, weights })
    }

    fn apply(&self, graph: &GraphProto) -> Result<GraphProto, HalfError> {
        let (mut nodes, mut weights) = (Vec::new(), Vec::new());
        // Values that have an f16 version already.
        let mut converted: HashSet<&str> = HashSet::new();
        for (index, node) in graph.node.iter().enumerate() {
            if !self.nodes.contains(&index) {
                nodes.push(node.clone());
                continue;
            }
            let mut node = node.clone();
            for (position, input) in graph.node[index].input.iter().enumerate() {
                // The scales of a Resize are f32 in every precision.
                let stays = node.op_type() == "Resize" && position > 0;
                if input.is_empty() || stays || self.integers.contains(input.as_str()) {
                    continue;
                }
                node.input[position] = half_name(input);
                if self.halves.contains(input.as_str()) || !converted.insert(input) {
                    continue;
                }
                match self.weights.get(input.as_str()) {
                    Some(weight) => {
                        let values = weight.to_f32()?;
                        weights.push(TensorProto::from_f32_as_f16(&half_name(input), &weight.dims, &values));
                    }
                    None => nodes.push(NodeProto::cast(input, &half_name(input), DataType::Float16)),
                }
            }
            node.output = node.output.iter().map(|name| half_name(name)).collect();
            nodes.push(node);
            let read = graph.node[index].output.iter().filter(|name| self.read_in_f32.contains(name.as_str()));
            nodes.extend(read.map(|name| NodeProto::cast(&half_name(name), name, DataType::Float)));
        }
        let mut initializer = graph.initializer.clone();
        initializer.extend(weights);
        let read: HashSet<&String> = nodes.iter().flat_map(|node| &node.input).collect();
        initializer.retain(|tensor| tensor.name.as_ref().is_some_and(|name| read.contains(name)));
        Ok(GraphProto { node: nodes, initializer, value_info: Vec::new(), ..graph.clone() })
    }
}

/// The nodes whose results a convolution or a matrix product needs, and these products. Constants are not among them.
fn up_to_products(graph: &GraphProto) -> HashSet<usize> {
    let producers: HashMap<&str, usize> = graph
        .node
        .iter()
        .enumerate()
        .filter(|(_, node)| node.op_type() != "Constant")
        .flat_map(|(index, node)| node.output.iter().map(move |name| (name.as_str(), index)))
        .collect();
    let is_product = |node: &NodeProto| PRODUCTS.contains(&node.op_type());
    let mut pending: Vec<usize> =
        graph.node.iter().enumerate().filter(|(_, node)| is_product(node)).map(|(index, _)| index).collect();
    let mut found = HashSet::new();
    while let Some(index) = pending.pop() {
        if found.insert(index) {
            pending.extend(graph.node[index].input.iter().filter_map(|name| producers.get(name.as_str())));
        }
    }
    found
}

fn half_name(name: &str) -> String {
    format!("{name}{SUFFIX}")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use grasp::Volume;
    use nalgebra::Isometry3;

    use super::*;
    use crate::upsampling::with_upsampling_folded;
    use crate::{Architecture, Network, Options, Orientation};

    const N: usize = 16;

    fn maps(model: &ModelProto) -> Vec<Vec<f32>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        fs::write(&path, prost::Message::encode_to_vec(model)).unwrap();
        // ONNX Runtime's CPU kernels run a graph in f16 with casts around the kernels that they do not have in f16.
        let mut network = Network::load(&path, &Options::default()).unwrap();
        let values = (0..N.pow(3)).map(|index| (index as f32 * 0.7).sin() / 2.0 + 0.5).collect();
        let volume = Volume::new(N, 0.01, Isometry3::identity(), values).unwrap();
        let output = network.infer(&[&volume]).unwrap();
        let maps = output.maps(0);
        [maps.quality, maps.rotation, maps.width].map(<[f32]>::to_vec).into()
    }

    #[test]
    fn outputs_in_f16_differ_by_rounding() {
        for (architecture, orientation) in [
            (Architecture::Vgn, Orientation::Quaternion),
            (Architecture::Vgn, Orientation::Axes),
            (Architecture::TransformerSmall, Orientation::Axes),
        ] {
            let model = architecture.build_with(N, orientation, 3).unwrap();
            let folded = with_upsampling_folded(&model);
            let half = with_half_computation(folded.as_ref().unwrap_or(&model)).unwrap();
            let graph = half.graph.as_ref().unwrap();
            let types: Vec<DataType> = graph.initializer.iter().map(TensorProto::element_type).collect();
            assert!(types.contains(&DataType::Float16), "weights are f16");
            let weights = graph.initializer.iter().filter(|tensor| tensor.element_type() == DataType::Float);
            assert!(weights.map(TensorProto::elements).sum::<usize>() < 1000, "few numbers stay f32");
            for (got, expected) in maps(&half).iter().zip(maps(&model)) {
                let differences: Vec<f32> = got.iter().zip(&expected).map(|(a, b)| (a - b).abs()).collect();
                let mean = differences.iter().sum::<f32>() / differences.len() as f32;
                assert!(mean > 0.0 && mean < 0.01, "{} {}: {mean}", architecture.name(), orientation.name());
            }
        }
    }

    #[test]
    fn an_operator_that_is_not_known_is_an_error() {
        let mut model = Architecture::Vgn.build(N, 3).unwrap();
        let relu = model.graph.as_mut().unwrap().node.iter_mut().find(|node| node.op_type() == "Relu").unwrap();
        relu.op_type = Some("Softplus".to_owned());
        let error = with_half_computation(&model).unwrap_err().to_string();
        assert!(error.contains("Softplus"), "{error}");
    }
}
