//! What every network here ends in (the paper, section "Grasping Heads"; the layers are VGN's).

use std::iter;

use crate::graph::{Builder, Conv};
use crate::onnx::{AttributeProto, ModelProto, NodeProto, TensorProto};
use crate::{INPUT, OUTPUTS};

/// The name of the heads' convolution.
pub(crate) const HEADS: &str = "heads";

/// What a network regresses of a grasp's orientation. Its output is a quaternion either way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Orientation {
    /// The four numbers of a quaternion, as in VGN and in the paper. A hand turned by 180° is the same hand, and so are
    /// q and −q; no continuous choice of q covers all orientations, and near every jump the network answers in between.
    #[default]
    Quaternion,
    /// The direction of the approach, and of the line along which the fingers close: six numbers that no turn of the hand
    /// by 180° changes, and that nowhere jump, except for an approach from straight below.
    Axes,
}

impl Orientation {
    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Quaternion => "quaternion",
            Self::Axes => "axes",
        }
    }

    /// How many numbers are regressed.
    fn channels(self) -> usize {
        match self {
            Self::Quaternion => 4,
            Self::Axes => 6,
        }
    }

    /// How many numbers the heads regress for a voxel: with the quality before these, and the width after them.
    pub(crate) fn outputs(self) -> usize {
        1 + self.channels() + 1
    }
}

/// Declares the network's input and returns it: the volume, `[batch, 1, N, N, N]`.
pub(crate) fn volume(b: &mut Builder, resolution: usize) -> String {
    b.input(INPUT, &[1, resolution, resolution, resolution])
}

/// Declares the three outputs over `features`, `[batch, channels, N, N, N]`:
/// quality (sigmoid), rotation (a unit quaternion x y z w) and width (linear, in voxels).
///
/// The 5³ convolutions of all three read the same features, so they are one convolution: the mathematics is the same
/// and it takes half the time of the whole of VGN.
pub(crate) fn heads(b: &mut Builder, features: &str, channels: usize, resolution: usize, orientation: Orientation) {
    let outputs = orientation.outputs();
    let all = b.conv(HEADS, features, Conv { inputs: channels, outputs, kernel: 5, stride: 1, bias: true });
    let sizes = b.whole(&[1, orientation.channels() as i64, 1]);
    let [quality, rotation, width] = b.nodes("Split", &[&all, &sizes], vec![AttributeProto::int("axis", 1)]);
    let quality = b.node("Sigmoid", &[&quality], vec![]);
    let rotation = match orientation {
        Orientation::Quaternion => normalize(b, &rotation),
        Orientation::Axes => from_axes(b, &rotation),
    };
    for ((name, channels), value) in OUTPUTS.into_iter().zip([quality, rotation, width]) {
        b.output(name, &value, &[channels, resolution, resolution, resolution]);
    }
}

/// A network made here, with weights in f32, with a convolution for each of its heads, as VGN and the paper have it: the
/// same mathematics at the published cost, to compare speeds with. `None` if it was made elsewhere.
#[must_use]
pub fn with_published_heads(model: &ModelProto) -> Option<ModelProto> {
    let mut model = model.clone();
    let graph = model.graph.as_mut()?;
    let (weight, bias) = (format!("{HEADS}.weight"), format!("{HEADS}.bias"));
    let conv = graph.node.iter().position(|node| node.input.get(1) == Some(&weight))?;
    let all = graph.node[conv].output.first()?.clone();
    let split = graph.node.iter().position(|node| node.op_type() == "Split" && node.input.first() == Some(&all))?;
    let fused = graph.node[conv].clone();
    let outputs = graph.node[split].output.clone();
    let parameter = |name: &str| graph.initializer.iter().find(|tensor| tensor.name() == name).cloned();
    let (weight, bias) = (parameter(&weight)?, parameter(&bias)?);
    let (weights, biases) = (weight.to_f32().ok()?, bias.to_f32().ok()?);
    let channels = biases.len().checked_sub(2)?;
    let each = weights.len() / biases.len();

    let mut first = 0;
    let mut convolutions = Vec::new();
    for (output, count) in outputs.into_iter().zip([1, channels, 1]) {
        let part = |values: &[f32], each: usize| values[first * each..(first + count) * each].to_vec();
        let names = ["weight", "bias"].map(|name| format!("{HEADS}.{output}.{name}"));
        let dims: Vec<i64> = iter::once(count as i64).chain(weight.dims.iter().skip(1).copied()).collect();
        graph.initializer.push(TensorProto::from_f32(&names[0], &dims, &part(&weights, each)));
        graph.initializer.push(TensorProto::from_f32(&names[1], &[count as i64], &part(&biases, 1)));
        let input = iter::once(fused.input[0].clone()).chain(names).collect();
        convolutions.push(NodeProto { input, name: Some(output.clone()), output: vec![output], ..fused.clone() });
        first += count;
    }
    graph.initializer.retain(|tensor| tensor.name() != weight.name() && tensor.name() != bias.name());
    graph.node.remove(split);
    graph.node.splice(conv..=conv, convolutions);
    Some(model)
}

/// The quaternion of an approach (−z, x, y), of 2ψ (its cosine, its sine), and of how level the fingers close, none of unit
/// length yet: the hand points down with its axes along x, −y, −z, is tilted the shortest way until its z is the approach,
/// and turns by −ψ about it.
///
/// After an approach from the azimuth α the fingers close level when ψ = α, and upright when ψ = α + 90°. What is level
/// thus winds twice around (cos 2ψ, sin 2ψ) as an object is walked around once, although it is the same grasp; the last
/// number, times (x + iy)², which is the level direction as long as the approach is flat, says it once for all azimuths.
fn from_axes(b: &mut Builder, axes: &str) -> String {
    let sizes = b.whole(&[3, 2, 1]);
    let [approach, turn, level] = b.nodes("Split", &[axes, &sizes], vec![AttributeProto::int("axis", 1)]);

    // The tilt takes (1, 0, 0) to the approach; half-way between them stands its rotation (1 + approach, normalised).
    // Times the half turn about x that points the hand down it is the quaternion (a, 0, x, −y).
    let approach = normalize(b, &approach);
    let tilt = half_way(b, &approach, 3);
    let [a, x, y] = split(b, &tilt);

    let direction = level_direction(b, &approach);
    let level = b.node("Mul", &[&direction, &level], vec![]);
    let turn = b.node("Add", &[&turn, &level], vec![]);
    // Half an angle, and again half of it: the quaternion (0, 0, −s, c) turns by −ψ.
    let turn = normalize(b, &turn);
    let turn = half_way(b, &turn, 2);
    let turn = half_way(b, &turn, 2);
    let [c, s] = split(b, &turn);

    let [ac, r#as, xc, xs, yc, ys] = [[&a, &c], [&a, &s], [&x, &c], [&x, &s], [&y, &c], [&y, &s]]
        .map(|[left, right]| b.node("Mul", &[left, right], vec![]));
    let z = b.node("Add", &[&xc, &ys], vec![]);
    let w = b.node("Sub", &[&xs, &yc], vec![]);
    b.node("Concat", &[&ac, &r#as, &z, &w], vec![AttributeProto::int("axis", 1)])
}

/// (x + iy)² of an approach (−z, x, y): its real and its imaginary part.
fn level_direction(b: &mut Builder, approach: &str) -> String {
    let [_, x, y] = split(b, approach);
    let [minus, plus] = ["Sub", "Add"].map(|op| b.node(op, &[&x, &y], vec![]));
    let re = b.node("Mul", &[&minus, &plus], vec![]);
    let half = b.node("Mul", &[&x, &y], vec![]);
    let im = b.node("Add", &[&half, &half], vec![]);
    b.node("Concat", &[&re, &im], vec![AttributeProto::int("axis", 1)])
}

/// The unit vector half-way between (1, 0, …) and a unit vector.
fn half_way(b: &mut Builder, x: &str, channels: usize) -> String {
    let mut first = vec![0.0; channels];
    first[0] = 1.0;
    let first = b.tensor(&[1, channels, 1, 1, 1], &first);
    let sum = b.node("Add", &[x, &first], vec![]);
    normalize(b, &sum)
}

/// The channels one by one.
fn split<const N: usize>(b: &mut Builder, x: &str) -> [String; N] {
    let sizes = b.whole(&[1; N]);
    b.nodes("Split", &[x, &sizes], vec![AttributeProto::int("axis", 1)])
}

/// Scales to length 1 over the channels; no length below 1e-12 is divided by (PyTorch's `normalize`).
fn normalize(b: &mut Builder, x: &str) -> String {
    let axes = AttributeProto::ints("axes", &[1]);
    let length = b.node("ReduceL2", &[x], vec![axes, AttributeProto::int("keepdims", 1)]);
    let smallest = b.number(1e-12);
    let length = b.node("Clip", &[&length, &smallest], vec![]);
    b.node("Div", &[x, &length], vec![])
}
