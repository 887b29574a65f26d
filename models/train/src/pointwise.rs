//! Finds the part of a graph that can be computed at single voxels.
//!
//! Only labelled voxels, a few dozen of 64,000, enter the loss. A grasp network is pointwise after its last convolutions,
//! the heads. Training therefore computes the heads only at labelled voxels, with the same result. In VGN the heads at
//! all voxels would take most of the time of a step.

use std::collections::HashSet;

use grasp_models::onnx::{GraphProto, NodeProto};
use tch::{Kind, TchError, Tensor};

/// Indices of the convolutions after which the graph is pointwise; empty if the graph has no such structure.
pub(crate) fn head_convolutions(graph: &GraphProto) -> HashSet<usize> {
    // Backwards from the outputs: values that are needed at more voxels than the computed one.
    let mut neighborhood: HashSet<&str> = HashSet::new();
    let (mut heads, mut pointwise) = (HashSet::new(), HashSet::new());
    for (index, node) in graph.node.iter().enumerate().rev() {
        let single = !node.output.iter().any(|output| neighborhood.contains(output.as_str()));
        if single && is_pointwise(graph, node) {
            pointwise.insert(index);
            continue;
        }
        if single && is_head(node) {
            heads.insert(index);
        }
        neighborhood.extend(node.input.iter().map(String::as_str));
    }
    // All nodes after the heads, and all outputs, must depend only on the heads and on constants.
    let mut known: HashSet<&str> = graph.initializer.iter().map(|tensor| tensor.name()).collect();
    for (index, node) in graph.node.iter().enumerate() {
        let fits = !pointwise.contains(&index) || node.input.iter().all(|input| known.contains(input.as_str()));
        if fits && (pointwise.contains(&index) || heads.contains(&index) || node.op_type() == "Constant") {
            known.extend(node.output.iter().map(String::as_str));
        }
    }
    let all = graph.output.iter().all(|output| known.contains(output.name()));
    if all { heads } else { HashSet::new() }
}

fn ints<'a>(node: &'a NodeProto, name: &str) -> &'a [i64] {
    node.attribute(name).map_or(&[], |attribute| &attribute.ints)
}

/// The largest edge of the kernels of `heads`.
pub(crate) fn largest_kernel(graph: &GraphProto, heads: &HashSet<usize>) -> i64 {
    heads.iter().filter_map(|&index| ints(&graph.node[index], "kernel_shape").first()).copied().max().unwrap_or(1)
}

/// Whether the node is a convolution with stride 1 that preserves the size.
fn is_head(node: &NodeProto) -> bool {
    let kernel = ints(node, "kernel_shape");
    node.op_type() == "Conv"
        && kernel.len() == 3
        && kernel.iter().all(|&edge| edge == kernel[0] && edge % 2 == 1)
        && ints(node, "pads").iter().all(|&pad| pad == kernel[0] / 2)
        && ["strides", "dilations"].iter().all(|name| ints(node, name).iter().all(|&step| step == 1))
        && node.attribute("group").is_none_or(|group| group.i() == 1)
}

/// Whether the node computes each voxel independently.
fn is_pointwise(graph: &GraphProto, node: &NodeProto) -> bool {
    match node.op_type() {
        "Add" | "Clip" | "Div" | "Expand" | "LeakyRelu" | "Mul" | "Relu" | "Shape" | "Sigmoid" | "Sub" => true,
        "ReduceL2" => match node.input.get(1) {
            Some(axes) => graph.stored(axes).is_some_and(|axes| axes.to_i64().is_ok_and(|axes| axes == [1])),
            None => ints(node, "axes") == [1],
        },
        "Concat" | "Split" => node.attribute("axis").is_some_and(|axis| axis.i() == 1),
        _ => false,
    }
}

/// Features `[batch, channels, N, N, N]`, padded with zeros, to be read at single voxels. Heads that read the same features
/// share one, so that they are padded once.
pub(crate) struct PaddedFeatures {
    /// `[voxels of the padded arrays, channels]`.
    rows: Tensor,
    /// Depth, height and width without padding.
    size: [i64; 3],
    /// Padding on each side.
    reach: i64,
}

impl PaddedFeatures {
    /// Features for kernels of at most `edge`³ voxels.
    pub fn new(x: &Tensor, edge: i64) -> Result<Self, TchError> {
        let (_, channels, depth, height, width) = x.size5()?;
        let reach = edge / 2;
        let padded = x.f_permute([0, 2, 3, 4, 1])?.f_constant_pad_nd([&[0; 2][..], &[reach; 6]].concat())?;
        Ok(Self { rows: padded.f_reshape([-1, channels])?, size: [depth, height, width], reach })
    }

    /// The cubes of `edge`³ voxels around `voxels`: `[voxels.len(), edge³ · channels]`, channels fastest. `voxels` are flat
    /// indices into `[batch, N, N, N]`.
    pub fn cubes(&self, voxels: &[i64], edge: i64) -> Result<Tensor, TchError> {
        let [depth, height, width] = self.size;
        let [planes, rows, columns] = self.size.map(|size| size + 2 * self.reach);
        let row_of = |volume: i64, [x, y, z]: [i64; 3]| ((volume * planes + x) * rows + y) * columns + z;
        // The first voxel of a cube that is as large as the padding allows has the coordinates in the padded array that
        // its centre has in the features. Smaller cubes begin later.
        let inset = self.reach - edge / 2;
        let corner = |&voxel: &i64| {
            row_of(
                voxel / (depth * height * width),
                [voxel / (height * width) % depth, voxel / width % height, voxel % width].map(|index| index + inset),
            )
        };
        let corners: Vec<i64> = voxels.iter().map(corner).collect();
        let offsets = |index: i64| row_of(0, [index / (edge * edge), index / edge % edge, index % edge]);
        let offsets: Vec<i64> = (0..edge.pow(3)).map(offsets).collect();
        let device = self.rows.device();
        let corners = Tensor::f_from_slice(&corners)?.f_to_device(device)?.f_unsqueeze(1)?;
        let offsets = Tensor::f_from_slice(&offsets)?.f_to_device(device)?;
        let cubes = self.rows.f_index_select(0, &corners.f_add(&offsets)?.f_reshape([-1])?)?;
        cubes.f_to_kind(Kind::Float)?.f_reshape([voxels.len() as i64, -1])
    }

    /// A convolution that preserves the size, at `voxels`: `[voxels.len(), outputs, 1, 1, 1]`.
    pub fn convolution(&self, weight: &Tensor, bias: Option<&Tensor>, voxels: &[i64]) -> Result<Tensor, TchError> {
        let (outputs, _, _, _, edge) = weight.size5()?;
        // Channels are the fastest axis, as in `cubes`.
        let weight = weight.f_permute([0, 2, 3, 4, 1])?.f_reshape([outputs, -1])?;
        let y = self.cubes(voxels, edge)?.f_linear(&weight, bias)?;
        y.f_reshape([voxels.len() as i64, -1, 1, 1, 1])
    }
}
