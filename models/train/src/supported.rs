//! Which ONNX graphs can be trained, and why others cannot.

use std::ops::RangeInclusive;

use grasp_models::onnx::{GraphProto, ModelProto, NodeProto, OperatorSetIdProto, TensorError};
use tch::TchError;
use thiserror::Error;

/// Supported versions of ONNX's operator set. In earlier ones `Split`, `Softmax` and others have another meaning or
/// have attributes instead of inputs. Later ones are untested.
const OPSETS: RangeInclusive<i64> = 13..=20;

/// Supported operators with their supported attributes.
const OPERATORS: &[(&str, &[&str])] = &[
    ("Add", &[]),
    ("Clip", &[]),
    ("Concat", &["axis"]),
    ("Constant", &["value"]),
    ("Conv", &["dilations", "group", "kernel_shape", "pads", "strides"]),
    ("ConvTranspose", &["dilations", "group", "kernel_shape", "pads", "strides"]),
    ("Div", &[]),
    ("Erf", &[]),
    ("Expand", &[]),
    ("Flatten", &["axis"]),
    ("InstanceNormalization", &["epsilon"]),
    ("LayerNormalization", &["axis", "epsilon"]),
    ("LeakyRelu", &["alpha"]),
    ("MatMul", &[]),
    ("MaxPool", &["ceil_mode", "dilations", "kernel_shape", "pads", "strides"]),
    ("Mul", &[]),
    ("ReduceL2", &["axes", "keepdims", "noop_with_empty_axes"]),
    ("Relu", &[]),
    ("Reshape", &[]),
    ("Resize", &["coordinate_transformation_mode", "cubic_coeff_a", "mode", "nearest_mode"]),
    ("Shape", &[]),
    ("Sigmoid", &[]),
    ("Slice", &[]),
    ("Softmax", &["axis"]),
    ("Split", &["axis"]),
    ("Sub", &[]),
    ("Transpose", &["perm"]),
];

/// Why a graph cannot be executed.
#[derive(Debug, Error)]
pub enum ExecuteError {
    /// The file has no graph.
    #[error("the model has no graph; export it again")]
    NoGraph,
    /// The model has an unsupported opset.
    #[error(
        "the model has opset {0}, training needs an opset from {first} to {last}; export it again with one of these",
        first = OPSETS.start(),
        last = OPSETS.end()
    )]
    Opset(i64),
    /// The operator is not implemented.
    #[error("node `{node}`: the operator `{op}` cannot be trained; supported: {}", supported())]
    Operator {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
    },
    /// An attribute or an input of an operator is not supported.
    #[error("node `{node}` ({op}): {what} is not supported")]
    Unsupported {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// The attribute or input.
        what: String,
    },
    /// A node reads a value that no earlier node computes.
    #[error("node `{node}` ({op}): no earlier node computes its input `{value}`")]
    Missing {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// The missing value.
        value: String,
    },
    /// libtorch failed.
    #[error("node `{node}` ({op}): {source}")]
    Torch {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// libtorch's error.
        source: TchError,
    },
    /// The graph has no such value.
    #[error("the graph does not compute `{0}`")]
    Output(String),
    /// The graph has no features for the head that completes shapes.
    #[error("--occupancy needs a network whose output heads are convolutions of the same features")]
    NoFeatures,
    /// The requested voxels are not in the batch.
    #[error("the voxels cannot be selected from the maps: {0}")]
    Voxels(TchError),
    /// The values of an initializer cannot be used.
    #[error(transparent)]
    Tensor(#[from] TensorError),
}

impl ExecuteError {
    pub(crate) fn torch(node: &NodeProto, source: TchError) -> Self {
        Self::Torch { node: node.name().to_owned(), op: node.op_type().to_owned(), source }
    }
}

/// Checks that the opset and all nodes of a model are supported, and returns its graph.
pub(crate) fn supported_graph(model: &ModelProto) -> Result<&GraphProto, ExecuteError> {
    let graph = model.graph.as_ref().ok_or(ExecuteError::NoGraph)?;
    let standard = model.opset_import.iter().find(|opset| matches!(opset.domain(), "" | "ai.onnx"));
    // ONNX: a missing version means 1.
    let opset = standard.map_or(1, OperatorSetIdProto::version);
    if !OPSETS.contains(&opset) {
        return Err(ExecuteError::Opset(opset));
    }
    graph.node.iter().try_for_each(check)?;
    Ok(graph)
}

/// The supported operators, for error messages.
fn supported() -> String {
    OPERATORS.iter().map(|&(op, _)| op).collect::<Vec<_>>().join(", ")
}

/// Checks that the operator and its attributes are supported. Ignoring one of them would train a different network.
fn check(node: &NodeProto) -> Result<(), ExecuteError> {
    let (name, op) = (node.name().to_owned(), node.op_type().to_owned());
    let known = OPERATORS.iter().find(|(known, _)| *known == op && node.domain().is_empty());
    let Some((_, attributes)) = known else { return Err(ExecuteError::Operator { node: name, op }) };
    match node.attribute.iter().find(|attribute| !attributes.contains(&attribute.name())) {
        Some(unknown) => {
            Err(ExecuteError::Unsupported { node: name, op, what: format!("the attribute `{}`", unknown.name()) })
        }
        None => Ok(()),
    }
}
