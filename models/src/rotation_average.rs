//! Rotation averaging: the network runs on a volume rotated about the vertical by 0, 90, 180 and 270°, as one batch,
//! and the results are rotated back and averaged. It uses the same weights, takes four times the computation and is
//! more accurate, and its output rotates exactly with the volume.
//!
//! The average is taken over the output of the last convolution, before sigmoid and normalisation. Only networks that
//! regress axes can be averaged, because a mean of quaternions is meaningless.

use thiserror::Error;

use crate::heads::{HEADS, Orientation};
use crate::onnx::{AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto};

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

/// Name of the batch of the four rotated volumes.
const TURNED: &str = "turns.all";

/// Returns the model averaged over the four quarter rotations of its volume.
///
/// # Errors
/// [`RotationAverageError`] if the network cannot be averaged.
pub fn averaged_over_rotations(model: &ModelProto) -> Result<ModelProto, RotationAverageError> {
    let graph = model.graph.as_ref().ok_or(RotationAverageError::NotAxes)?;
    let input = graph.input.first().ok_or(RotationAverageError::NotAxes)?.name();
    let heads = heads(graph).ok_or(RotationAverageError::NotAxes)?;
    if graph.node.iter().flat_map(|node| &node.output).any(|output| output == TURNED) {
        return Err(RotationAverageError::Already);
    }
    let answer = &heads.output[0];
    let answers = format!("{answer}.turned");

    let mut nodes = Nodes::default();
    let turns: Vec<String> = (0..4).map(|turns| nodes.turn(input, turns)).collect();
    nodes.push("Concat", &turns, &[TURNED], vec![AttributeProto::int("axis", 0)]);
    for node in &graph.node {
        let mut node = node.clone();
        node.input.iter_mut().filter(|name| *name == input).for_each(|name| TURNED.clone_into(name));
        let is_last = node.output.first() == Some(answer);
        if is_last {
            node.output[0].clone_from(&answers);
        }
        nodes.list.push(node);
        if is_last {
            nodes.average(&answers, answer);
        }
    }
    let graph = GraphProto { node: nodes.list, value_info: Vec::new(), ..graph.clone() };
    Ok(ModelProto { graph: Some(graph), ..model.clone() })
}

/// The convolution of the heads, if the network regresses axes.
fn heads(graph: &GraphProto) -> Option<&NodeProto> {
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

    /// The array rotated by `turns` quarter turns: the value at (x, y), counted from the middle, moves to (−y, x).
    fn turn(&mut self, array: &str, turns: usize) -> String {
        match turns % 4 {
            0 => array.to_owned(),
            1 => self.transposed(array, X),
            2 => self.flipped(array, &[X, Y]),
            _ => self.transposed(array, Y),
        }
    }

    /// Exchanges x and y, then reverses one of them.
    fn transposed(&mut self, array: &str, reversed: i64) -> String {
        let order = AttributeProto::ints("perm", &[0, 1, Y, X, 4]);
        let exchanged = self.node("Transpose", &[array.to_owned()], vec![order]);
        self.flipped(&exchanged, &[reversed])
    }

    fn flipped(&mut self, array: &str, axes: &[i64]) -> String {
        let [from, to, step] = [-1, i64::MIN, -1].map(|value| vec![value; axes.len()]);
        let settings = [&from, &to, axes, &step]
            .map(|values| self.constant(TensorProto::from_i64("", &[axes.len() as i64], values)));
        let inputs = [&[array.to_owned()][..], &settings].concat();
        self.node("Slice", &inputs, vec![])
    }

    /// The mean of the four results, each rotated back.
    fn average(&mut self, answers: &str, mean: &str) {
        let parts: [String; 4] = std::array::from_fn(|turns| format!("turns.answer.{turns}"));
        let names = parts.each_ref().map(String::as_str);
        self.push("Split", &[answers.to_owned()], &names, vec![AttributeProto::int("axis", 0)]);
        let back: Vec<String> = parts.iter().enumerate().map(|(turns, part)| self.turn_back(part, turns)).collect();
        self.push("Sum", &back, &[mean], vec![]);
    }

    /// A quarter of the result for the volume after `turns` quarter turns, rotated back.
    ///
    /// The channels are the quality; the approach (−z, x, y), whose x and y rotate with the volume; cosine and sine of
    /// 2ψ, which rotate by twice the angle; the weight of level closing, which does not change; and the width.
    fn turn_back(&mut self, answer: &str, turns: usize) -> String {
        let in_place = self.turn(answer, 4 - turns);
        let (order, [x, y], double) = match turns {
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
