//! The paper's network: UNETR (Hatamizadeh et al., WACV 2022) sized for a grasp volume, with VGN's heads.
//!
//! Where the paper gives no details, layers and initialisation follow MONAI's UNETR.

use crate::graph::{Builder, Conv, Init};
use crate::onnx::{AttributeProto, ModelProto};
use crate::output_heads::{Orientation, output_heads, volume_input};

/// Edge of a patch, voxels. The decoder doubles the size three times.
const PATCH: usize = 8;

/// ε of both normalisations.
const EPSILON: f32 = 1e-5;

/// The sizes of a transformer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sizes {
    /// K: dimension of tokens.
    pub hidden: usize,
    /// L: number of transformer blocks.
    pub layers: usize,
    /// H: number of attention heads; must divide K.
    pub heads: usize,
    /// Hidden units of the feed-forward block.
    pub mlp: usize,
    /// D: number of features per voxel.
    pub features: usize,
    /// The blocks, from 1, whose outputs are the skip connections to the decoder: the finer one, then the coarser one.
    pub skips: [usize; 2],
}

impl Sizes {
    /// The paper's network with the encoder of ViT-B, 87 M parameters.
    pub const PAPER: Self = Self { hidden: 768, layers: 12, heads: 12, mlp: 3072, features: 16, skips: [4, 7] };

    /// Small enough to train on a CPU. Most of the time goes into the decoder's convolutions at full resolution, so it
    /// has half the features. The skips are at the same relative depth.
    pub const SMALL: Self = Self { hidden: 192, layers: 6, heads: 6, mlp: 768, features: 8, skips: [2, 4] };
}

/// The transformer for volumes of `resolution`³ voxels, a multiple of 8.
pub(crate) fn transformer(sizes: &Sizes, resolution: usize, orientation: Orientation, seed: u64) -> ModelProto {
    let Sizes { hidden, features, skips, .. } = *sizes;
    let mut builder = Builder::new("transformer", seed);
    let b = &mut builder;
    let edge = resolution / PATCH;

    let input = volume_input(b, resolution);
    let mut tokens = patch_tokens(b, &input, hidden, edge);
    let mut skip_tokens = [String::new(), String::new()];
    for layer in 1..=sizes.layers {
        tokens = block(b, &format!("block.{layer}"), &tokens, sizes, edge.pow(3));
        if let Some(skip) = skips.iter().position(|&skip| skip == layer) {
            skip_tokens[skip] = tokens_to_grid(b, &tokens, hidden, edge);
        }
    }
    let tokens = layer_norm(b, "norm", &tokens, hidden);
    let [fine, coarse] = skip_tokens;

    // Each decoder step doubles the size, halves the features and concatenates a skip of equal size and features.
    let coarse = b.conv_transpose("skip.coarse.0", &coarse, hidden, 4 * features);
    let fine = b.conv_transpose("skip.fine.0", &fine, hidden, 2 * features);
    let fine = b.conv_transpose("skip.fine.1", &fine, 2 * features, 2 * features);
    let input = residual_block(b, "skip.input", &input, 1, features);
    let mut x = tokens_to_grid(b, &tokens, hidden, edge);
    let mut inputs = hidden;
    for (name, skip, outputs) in
        [("decoder.0", coarse, 4 * features), ("decoder.1", fine, 2 * features), ("decoder.2", input, features)]
    {
        x = b.conv_transpose(&format!("{name}.up"), &x, inputs, outputs);
        x = b.node("Concat", &[&x, &skip], vec![AttributeProto::int("axis", 1)]);
        x = residual_block(b, name, &x, 2 * outputs, outputs);
        inputs = outputs;
    }
    output_heads(b, &x, features, resolution, orientation);
    builder.finish()
}

/// The paper, section "Serialization": projects each patch to a token and adds a trainable position embedding. Returns
/// `[batch, M, K]`.
fn patch_tokens(b: &mut Builder, volume: &str, hidden: usize, edge: usize) -> String {
    // A convolution with stride equal to its kernel is a linear projection of every patch.
    let weight = b.parameter("patch.weight", &[hidden, 1, PATCH, PATCH, PATCH], Init::Normal(0.02));
    let bias = b.parameter("patch.bias", &[hidden], Init::Constant(0.0));
    let patch = PATCH as i64;
    let attributes =
        vec![AttributeProto::ints("kernel_shape", &[patch; 3]), AttributeProto::ints("strides", &[patch; 3])];
    let patches = b.node("Conv", &[volume, &weight, &bias], attributes);
    let tokens = reshape(b, &patches, &[0, hidden as i64, edge.pow(3) as i64]);
    let tokens = transpose(b, &tokens, &[0, 2, 1]);
    let position = b.parameter("position", &[1, edge.pow(3), hidden], Init::Normal(0.02));
    b.node("Add", &[&tokens, &position], vec![])
}

/// The paper, section "Encoding with Transformer Blocks": attention and a feed-forward network, each with a preceding
/// normalisation and a residual connection.
fn block(b: &mut Builder, name: &str, x: &str, sizes: &Sizes, tokens: usize) -> String {
    let Sizes { hidden, mlp, .. } = *sizes;
    let y = layer_norm(b, &format!("{name}.norm.0"), x, hidden);
    let y = attention(b, &format!("{name}.attention"), &y, sizes, tokens);
    let x = b.node("Add", &[x, &y], vec![]);
    let y = layer_norm(b, &format!("{name}.norm.1"), &x, hidden);
    let y = b.linear(&format!("{name}.mlp.0"), &y, hidden, mlp, true);
    let y = gelu(b, &y);
    let y = b.linear(&format!("{name}.mlp.1"), &y, mlp, hidden, true);
    b.node("Add", &[&x, &y], vec![])
}

/// Multi-head self-attention: softmax(q·k / √(K/H))·v per head, then one projection.
fn attention(b: &mut Builder, name: &str, x: &str, sizes: &Sizes, tokens: usize) -> String {
    let Sizes { hidden, heads, .. } = *sizes;
    let size = hidden / heads;
    let qkv = b.linear(&format!("{name}.qkv"), x, hidden, 3 * hidden, false);
    let parts = b.integers(&[hidden as i64; 3]);
    let [q, k, v] = b.nodes("Split", &[&qkv, &parts], vec![AttributeProto::int("axis", -1)]);
    let mut head = |value: &str, order: &[i64]| {
        let split = reshape(b, value, &[0, tokens as i64, heads as i64, size as i64]);
        transpose(b, &split, order)
    };
    let [q, k, v] = [head(&q, &[0, 2, 1, 3]), head(&k, &[0, 2, 3, 1]), head(&v, &[0, 2, 1, 3])];
    let scale = b.number(1.0 / (size as f32).sqrt());
    let q = b.node("Mul", &[&q, &scale], vec![]);
    let scores = b.node("MatMul", &[&q, &k], vec![]);
    let weights = b.node("Softmax", &[&scores], vec![AttributeProto::int("axis", -1)]);
    let y = b.node("MatMul", &[&weights, &v], vec![]);
    let y = transpose(b, &y, &[0, 2, 1, 3]);
    let y = reshape(b, &y, &[0, tokens as i64, hidden as i64]);
    b.linear(&format!("{name}.out"), &y, hidden, hidden, true)
}

/// The exact GELU x · Φ(x). A GELU operator exists only from opset 20; runtimes recognise and fuse these five nodes.
fn gelu(b: &mut Builder, x: &str) -> String {
    let [root, one, half] = [std::f32::consts::SQRT_2, 1.0, 0.5].map(|value| b.number(value));
    let y = b.node("Div", &[x, &root], vec![]);
    let y = b.node("Erf", &[&y], vec![]);
    let y = b.node("Add", &[&y, &one], vec![]);
    let y = b.node("Mul", &[x, &y], vec![]);
    b.node("Mul", &[&y, &half], vec![])
}

fn layer_norm(b: &mut Builder, name: &str, x: &str, hidden: usize) -> String {
    let weight = b.parameter(&format!("{name}.weight"), &[hidden], Init::Constant(1.0));
    let bias = b.parameter(&format!("{name}.bias"), &[hidden], Init::Constant(0.0));
    let attributes = vec![AttributeProto::int("axis", -1), AttributeProto::float("epsilon", EPSILON)];
    b.node("LayerNormalization", &[x, &weight, &bias], attributes)
}

/// Rearranges tokens to the grid of their patches (`Proj` in the paper): `[batch, K, n, n, n]`.
fn tokens_to_grid(b: &mut Builder, tokens: &str, hidden: usize, edge: usize) -> String {
    let channels_first = transpose(b, tokens, &[0, 2, 1]);
    let edge = edge as i64;
    reshape(b, &channels_first, &[0, hidden as i64, edge, edge, edge])
}

/// Two 3³ convolutions with a shortcut, which is a 1³ convolution if the number of channels changes.
fn residual_block(b: &mut Builder, name: &str, x: &str, inputs: usize, outputs: usize) -> String {
    let layer = |inputs, kernel| Conv { inputs, outputs, kernel, stride: 1, bias: false };
    let y = b.conv(&format!("{name}.conv.0"), x, layer(inputs, 3));
    let y = instance_norm(b, &y, outputs);
    let y = leaky_relu(b, &y);
    let y = b.conv(&format!("{name}.conv.1"), &y, layer(outputs, 3));
    let y = instance_norm(b, &y, outputs);
    let shortcut = if inputs == outputs {
        x.to_owned()
    } else {
        let x = b.conv(&format!("{name}.shortcut"), x, layer(inputs, 1));
        instance_norm(b, &x, outputs)
    };
    let sum = b.node("Add", &[&y, &shortcut], vec![]);
    leaky_relu(b, &sum)
}

/// Normalises each channel of each volume to mean 0 and variance 1, without trainable parameters.
fn instance_norm(b: &mut Builder, x: &str, channels: usize) -> String {
    let [scale, bias] = [1.0, 0.0].map(|value| b.numbers(&vec![value; channels]));
    b.node("InstanceNormalization", &[x, &scale, &bias], vec![AttributeProto::float("epsilon", EPSILON)])
}

fn leaky_relu(b: &mut Builder, x: &str) -> String {
    b.node("LeakyRelu", &[x], vec![AttributeProto::float("alpha", 0.01)])
}

fn reshape(b: &mut Builder, x: &str, dims: &[i64]) -> String {
    let shape = b.integers(dims);
    b.node("Reshape", &[x, &shape], vec![])
}

fn transpose(b: &mut Builder, x: &str, order: &[i64]) -> String {
    b.node("Transpose", &[x], vec![AttributeProto::ints("perm", order)])
}
