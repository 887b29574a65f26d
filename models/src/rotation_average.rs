//! Rotation averaging: the network runs on a volume rotated about the vertical by 0, 90, 180 and 270°, as one batch,
//! and the results are rotated back and averaged. The average uses the same weights, takes four times the computation
//! and is more accurate. Its output rotates exactly with the volume.
//!
//! The average is taken over the output of the last convolution, before sigmoid and normalisation. Only networks that
//! regress axes can be averaged, because a mean of quaternions is meaningless.

use thiserror::Error;

use crate::onnx::{AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto};
use crate::output_heads::{HEADS, Orientation};

/// Why a network cannot be averaged over rotations.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum RotationAverageError {
    /// It was not created by this crate, or it regresses quaternions.
    #[error(
        "only networks that regress axes can be averaged over rotations; train one with `grasp-train train \
         --orientation axes`"
    )]
    NotAxes,
    /// It is already averaged.
    #[error("the network is already averaged over rotations")]
    Already,
}

/// The axes of an array `[batch, channel, x, y, z]` that a rotation about the vertical changes.
const X: i64 = 2;
const Y: i64 = 3;

/// Name of the batch of the four rotated volumes. Files that earlier versions exported have the same name.
const ROTATED_VOLUMES: &str = "turns.all";

/// Returns the model averaged over the four quarter rotations of its volume.
///
/// # Errors
/// [`RotationAverageError`] if the network cannot be averaged.
pub fn averaged_over_rotations(model: &ModelProto) -> Result<ModelProto, RotationAverageError> {
    let graph = model.graph.as_ref().ok_or(RotationAverageError::NotAxes)?;
    let input = graph.input.first().ok_or(RotationAverageError::NotAxes)?.name();
    let heads = head_convolution(graph).ok_or(RotationAverageError::NotAxes)?;
    if graph.node.iter().flat_map(|node| &node.output).any(|name| name == ROTATED_VOLUMES) {
        return Err(RotationAverageError::Already);
    }
    let output = &heads.output[0];
    let rotated_output = format!("{output}.turned");

    let mut nodes = Nodes::default();
    let volumes: Vec<String> = (0..4).map(|quarters| nodes.rotated(input, quarters)).collect();
    nodes.push("Concat", &volumes, &[ROTATED_VOLUMES], vec![AttributeProto::int("axis", 0)]);
    for node in &graph.node {
        let mut node = node.clone();
        node.input.iter_mut().filter(|name| *name == input).for_each(|name| ROTATED_VOLUMES.clone_into(name));
        let is_last = node.output.first() == Some(output);
        if is_last {
            node.output[0].clone_from(&rotated_output);
        }
        nodes.list.push(node);
        if is_last {
            nodes.average(&rotated_output, output);
        }
    }
    let graph = GraphProto { node: nodes.list, value_info: Vec::new(), ..graph.clone() };
    Ok(ModelProto { graph: Some(graph), ..model.clone() })
}

/// The convolution of the heads, if the network regresses axes.
fn head_convolution(graph: &GraphProto) -> Option<&NodeProto> {
    let name = format!("{HEADS}.weight");
    let weight = graph.initializer.iter().find(|tensor| tensor.name() == name)?;
    let regresses_axes = weight.dims.first() == Some(&(Orientation::Axes.outputs() as i64));
    graph.node.iter().find(|node| node.input.get(1) == Some(&name)).filter(|_| regresses_axes)
}

/// Nodes in execution order.
#[derive(Default)]
struct Nodes {
    list: Vec<NodeProto>,
}

impl Nodes {
    fn push(&mut self, op: &str, inputs: &[String], outputs: &[&str], attribute: Vec<AttributeProto>) {
        self.list.push(NodeProto {
            input: inputs.to_vec(),
            output: outputs.iter().map(|&output| output.to_owned()).collect(),
            name: Some(format!("turns.{}", self.list.len())),
            op_type: Some(op.to_owned()),
            attribute,
            ..NodeProto::default()
        });
    }

    fn node(&mut self, op: &str, inputs: &[String], attribute: Vec<AttributeProto>) -> String {
        let name = format!("turns.{}", self.list.len());
        self.push(op, inputs, &[&name], attribute);
        name
    }

    fn constant(&mut self, value: TensorProto) -> String {
        self.node("Constant", &[], vec![AttributeProto::tensor("value", value)])
    }

    /// `array` rotated about the vertical by `quarters` · 90°. A rotation by 90° moves the value at (x, y), measured from
    /// the middle, to (−y, x).
    fn rotated(&mut self, array: &str, quarters: usize) -> String {
        match quarters % 4 {
            0 => array.to_owned(),
            1 => self.transposed_and_reversed(array, X),
            2 => self.reversed(array, &[X, Y]),
            _ => self.transposed_and_reversed(array, Y),
        }
    }

    /// Exchanges x and y, then reverses one of them.
    fn transposed_and_reversed(&mut self, array: &str, reversed: i64) -> String {
        let order = AttributeProto::ints("perm", &[0, 1, Y, X, 4]);
        let exchanged = self.node("Transpose", &[array.to_owned()], vec![order]);
        self.reversed(&exchanged, &[reversed])
    }

    fn reversed(&mut self, array: &str, axes: &[i64]) -> String {
        let [from, to, step] = [-1, i64::MIN, -1].map(|value| vec![value; axes.len()]);
        let settings = [&from, &to, axes, &step]
            .map(|values| self.constant(TensorProto::from_i64("", &[axes.len() as i64], values)));
        let inputs = [&[array.to_owned()][..], &settings].concat();
        self.node("Slice", &inputs, vec![])
    }

    /// The mean of the four results, each rotated back.
    fn average(&mut self, rotated_output: &str, mean: &str) {
        let parts: [String; 4] = std::array::from_fn(|quarters| format!("turns.answer.{quarters}"));
        let names = parts.each_ref().map(String::as_str);
        self.push("Split", &[rotated_output.to_owned()], &names, vec![AttributeProto::int("axis", 0)]);
        let back: Vec<String> =
            parts.iter().enumerate().map(|(quarters, part)| self.rotated_back(part, quarters)).collect();
        self.push("Sum", &back, &[mean], vec![]);
    }

    /// The result for the volume rotated by `quarters` · 90°, rotated back and divided by 4.
    ///
    /// The channels are the quality; the approach (−z, x, y), whose x and y rotate with the volume; cosine and sine of
    /// 2ψ, which rotate by twice the angle; the weight of level closing, which does not change; and the width.
    fn rotated_back(&mut self, output: &str, quarters: usize) -> String {
        let in_place = self.rotated(output, 4 - quarters);
        let (order, [x, y], double) = match quarters {
            0 => ([0, 1, 2, 3, 4, 5, 6, 7], [1.0, 1.0], 1.0),
            1 => ([0, 1, 3, 2, 4, 5, 6, 7], [1.0, -1.0], -1.0),
            2 => ([0, 1, 2, 3, 4, 5, 6, 7], [-1.0, -1.0], 1.0),
            _ => ([0, 1, 3, 2, 4, 5, 6, 7], [-1.0, 1.0], -1.0),
        };
        let order = self.constant(TensorProto::from_i64("", &[8], &order));
        let signs = [1.0, 1.0, x, y, double, double, 1.0, 1.0].map(|sign: f32| sign / 4.0);
        let signs = self.constant(TensorProto::from_f32("", &[1, 8, 1, 1, 1], &signs));
        let ordered = self.node("Gather", &[in_place, order], vec![AttributeProto::int("axis", 1)]);
        self.node("Mul", &[ordered, signs], vec![])
    }
}
