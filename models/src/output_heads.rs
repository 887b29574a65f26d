//! The output heads of every network (the paper, section "Grasping Heads"; the layers are VGN's).

use std::iter;

use crate::graph::{Builder, Conv};
use crate::onnx::{AttributeProto, ModelProto, NodeProto, TensorProto};
use crate::{INPUT, OUTPUTS};

/// Name of the heads' convolution.
pub(crate) const HEADS: &str = "heads";

/// The regressed representation of a grasp's orientation. The output is a quaternion with both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Orientation {
    /// The four components of a quaternion, as in VGN and in the paper. q, −q and the hand rotated by 180° are
    /// equivalent, so there is no continuous choice of q for all orientations, and predictions near a discontinuity are
    /// interpolated.
    #[default]
    Quaternion,
    /// The approach direction and the closing line of the fingers: six numbers that do not change when the hand is
    /// rotated by 180°, and that are continuous except for an approach from straight below.
    Axes,
}

impl Orientation {
    /// Name in metadata and options.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Quaternion => "quaternion",
            Self::Axes => "axes",
        }
    }

    /// Number of regressed values.
    fn channels(self) -> usize {
        match self {
            Self::Quaternion => 4,
            Self::Axes => 6,
        }
    }

    /// Number of values per voxel: the quality, these values, and the width.
    pub(crate) fn outputs(self) -> usize {
        1 + self.channels() + 1
    }
}

/// Declares the input of a network and returns it: the volume, `[batch, 1, N, N, N]`.
pub(crate) fn volume_input(b: &mut Builder, resolution: usize) -> String {
    b.input(INPUT, &[1, resolution, resolution, resolution])
}

/// Declares the three outputs on `features`, `[batch, channels, N, N, N]`: quality (sigmoid), rotation (unit quaternion
/// x, y, z, w) and width (linear, in voxels).
///
/// The 5³ convolutions of all three heads read the same features, so they are merged into one convolution. The result
/// is the same, and it takes half the time of the whole of VGN.
pub(crate) fn output_heads(
    b: &mut Builder,
    features: &str,
    channels: usize,
    resolution: usize,
    orientation: Orientation,
) {
    let outputs = orientation.outputs();
    let all = b.conv(HEADS, features, Conv { inputs: channels, outputs, kernel: 5, stride: 1, bias: true });
    let sizes = b.integers(&[1, orientation.channels() as i64, 1]);
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

/// Splits the merged convolution of the heads into one convolution per head, as published by VGN and the paper, to
/// compare speeds. The result is the same at the published cost. `None` if the network was not created by this crate
/// with f32 weights.
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

/// Converts three regressed values to a quaternion: the approach direction (−z, x, y); the direction (cos 2ψ, sin 2ψ);
/// and a weight of level closing. They need not be normalised. The rotation starts with the hand pointing down, its
/// axes along x, −y, −z. It tilts the hand by the smallest rotation that aligns its z with the approach, and then
/// rotates it by −ψ about z.
///
/// For an approach from the azimuth α the fingers close horizontally if ψ = α, and vertically if ψ = α + 90°. A level
/// grasp therefore winds twice around (cos 2ψ, sin 2ψ) while α makes one turn around an object. The third value,
/// multiplied by (x + iy)², which is the level direction for a flat approach, represents a level grasp for all azimuths
/// with one number.
fn from_axes(b: &mut Builder, axes: &str) -> String {
    let sizes = b.integers(&[3, 2, 1]);
    let [approach, turn, level] = b.nodes("Split", &[axes, &sizes], vec![AttributeProto::int("axis", 1)]);

    // The tilt maps (1, 0, 0) to the approach; its quaternion is 1 + approach, normalised. Multiplied by the half turn
    // about x that points the hand down, it is (a, 0, x, −y).
    let approach = normalize(b, &approach);
    let tilt = halfway(b, &approach, 3);
    let [a, x, y] = split(b, &tilt);

    let direction = level_direction(b, &approach);
    let level = b.node("Mul", &[&direction, &level], vec![]);
    let turn = b.node("Add", &[&turn, &level], vec![]);
    // The angle is halved twice: the quaternion (0, 0, −s, c) rotates by −ψ.
    let turn = normalize(b, &turn);
    let turn = halfway(b, &turn, 2);
    let turn = halfway(b, &turn, 2);
    let [c, s] = split(b, &turn);

    let [ac, r#as, xc, xs, yc, ys] = [[&a, &c], [&a, &s], [&x, &c], [&x, &s], [&y, &c], [&y, &s]]
        .map(|[left, right]| b.node("Mul", &[left, right], vec![]));
    let z = b.node("Add", &[&xc, &ys], vec![]);
    let w = b.node("Sub", &[&xs, &yc], vec![]);
    b.node("Concat", &[&ac, &r#as, &z, &w], vec![AttributeProto::int("axis", 1)])
}

/// (x + iy)² of an approach (−z, x, y): real and imaginary part.
fn level_direction(b: &mut Builder, approach: &str) -> String {
    let [_, x, y] = split(b, approach);
    let [minus, plus] = ["Sub", "Add"].map(|op| b.node(op, &[&x, &y], vec![]));
    let re = b.node("Mul", &[&minus, &plus], vec![]);
    let half = b.node("Mul", &[&x, &y], vec![]);
    let im = b.node("Add", &[&half, &half], vec![]);
    b.node("Concat", &[&re, &im], vec![AttributeProto::int("axis", 1)])
}

/// The unit vector halfway between (1, 0, …) and a unit vector.
fn halfway(b: &mut Builder, x: &str, channels: usize) -> String {
    let mut first = vec![0.0; channels];
    first[0] = 1.0;
    let first = b.tensor(&[1, channels, 1, 1, 1], &first);
    let sum = b.node("Add", &[x, &first], vec![]);
    normalize(b, &sum)
}

/// Splits an array into its channels.
fn split<const N: usize>(b: &mut Builder, x: &str) -> [String; N] {
    let sizes = b.integers(&[1; N]);
    b.nodes("Split", &[x, &sizes], vec![AttributeProto::int("axis", 1)])
}

/// Normalises over the channels, with a smallest divisor of 1e-12 (PyTorch's `normalize`).
fn normalize(b: &mut Builder, x: &str) -> String {
    let axes = AttributeProto::ints("axes", &[1]);
    let length = b.node("ReduceL2", &[x], vec![axes, AttributeProto::int("keepdims", 1)]);
    let smallest = b.number(1e-12);
    let length = b.node("Clip", &[&length, &smallest], vec![]);
    b.node("Div", &[x, &length], vec![])
}
