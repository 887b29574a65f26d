//! Folds nearest-neighbour upsampling by 2 into the convolution that follows it.
//!
//! Many of the 5³ voxels that such a convolution reads are equal: each output is a sum over 3³ distinct voxels, with
//! weights that depend only on the parity of its coordinates. One convolution of 3³ over the small array with eight
//! times the channels therefore computes the same result with a fifth of the multiplications, and its eight parts are
//! then interleaved. The graph is changed when a model is loaded and not in the file, so that training uses the
//! published weights.
//!
//! In VGN's network the heads alone take 70 % of the time without this.

mod graph_index;

use std::collections::{HashMap, HashSet};

use self::graph_index::{ConvShape, GraphIndex, conv_shape};
use crate::onnx::{AttributeProto, DataType, GraphProto, ModelProto, NodeProto, TensorProto};

/// The model with all suitable convolutions folded, or `None` if there are none. Weights must be f32.
pub(crate) fn with_upsampling_folded(model: &ModelProto) -> Option<ModelProto> {
    let graph = model.graph.as_ref()?;
    let index = GraphIndex::new(graph);
    let mut nodes = Vec::new();
    let mut weights = Vec::new();
    for node in &graph.node {
        match index.folded(node) {
            Some(folded) => {
                weights.extend(folded.initializers());
                nodes.extend(folded.nodes());
            }
            None => nodes.push(node.clone()),
        }
    }
    if weights.is_empty() {
        return None;
    }
    // Removes unused nodes. Repeated, because a removed node can be the only reader of another.
    loop {
        let mut read: HashSet<String> = nodes.iter().flat_map(|node| node.input.iter().cloned()).collect();
        read.extend(graph.output.iter().map(|output| output.name().to_owned()));
        let before = nodes.len();
        nodes.retain(|node| node.output.iter().any(|name| read.contains(name)));
        if nodes.len() == before {
            break;
        }
    }
    let mut initializer = graph.initializer.clone();
    initializer.extend(weights);
    initializer.retain(|tensor| nodes.iter().any(|node| node.input.iter().any(|input| input == tensor.name())));
    let graph = GraphProto { node: nodes, initializer, value_info: Vec::new(), ..graph.clone() };
    Some(ModelProto { graph: Some(graph), ..model.clone() })
}

/// The convolutions of a graph that can be folded: index of the convolution node → index of the upsampling node before
/// it. Only if no other node reads the upsampled array.
#[must_use]
pub fn upsampled_convolutions(graph: &GraphProto) -> HashMap<usize, usize> {
    let index = GraphIndex::new(graph);
    let pair = |(position, node): (usize, &NodeProto)| {
        index.folded(node)?;
        let large = node.input.first()?;
        let readers = graph.node.iter().filter(|node| node.input.contains(large)).count();
        let resize = graph.node.iter().position(|node| node.output.contains(large))?;
        (readers == 1).then_some((position, resize))
    };
    graph.node.iter().enumerate().filter_map(pair).collect()
}

/// For each parity of an output coordinate and each tap of a kernel: the tap of the small kernel it belongs to. Also
/// returns the size of the small kernel.
#[must_use]
pub fn upsampled_taps(kernel: usize) -> ([Vec<usize>; 2], usize) {
    let small = SmallKernel::new(kernel);
    ([0, 1].map(|parity| (0..kernel).map(|tap| small.position(parity, tap)).collect()), small.kernel)
}

/// A convolution over a small array that replaces one over an upsampled array.
struct FoldedConvolution<'a> {
    /// The replaced convolution.
    node: &'a NodeProto,
    /// Name of the small array.
    input: &'a str,
    /// Edge of the small array.
    edge: usize,
    /// Channels of the output.
    channels: usize,
    weight: TensorProto,
    bias: Option<TensorProto>,
}

impl<'a> GraphIndex<'a> {
    /// The replacement of a node, if it can be folded.
    fn folded(&self, node: &'a NodeProto) -> Option<FoldedConvolution<'a>> {
        let large = node.input.first()?;
        let resize = *self.producers.get(large.as_str())?;
        if node.op_type() != "Conv" || resize.op_type() != "Resize" || !self.is_upsampling_by_2(resize) {
            return None;
        }
        let ConvShape { kernel, pad, stride } = conv_shape(node)?;
        let small = SmallKernel::new(kernel);
        if stride != 1 || kernel % 2 == 0 || pad != kernel / 2 || small.kernel >= kernel {
            return None;
        }
        let weight = self.constants.get(node.input.get(1)?.as_str())?;
        let &[channels, inputs, ref edges @ ..] = weight.dims.as_slice() else { return None };
        if weight.element_type() != DataType::Float || edges != [kernel as i64; 3] {
            return None;
        }
        let name = node.output.first()?;
        let bias = match node.input.get(2).filter(|bias| !bias.is_empty()) {
            None => None,
            Some(bias) => {
                let values = self.numbers(bias)?.repeat(8);
                Some(TensorProto::from_f32(&format!("{name}.bias"), &[values.len() as i64], &values))
            }
        };
        let values = small.weights(&weight.to_f32().ok()?, channels as usize, inputs as usize);
        let edge = small.kernel as i64;
        let weight =
            TensorProto::from_f32(&format!("{name}.weight"), &[8 * channels, inputs, edge, edge, edge], &values);
        let input = resize.input.first()?;
        let edge = *self.edges.get(input.as_str())?;
        Some(FoldedConvolution { node, input, edge, channels: channels as usize, weight, bias })
    }
}

impl FoldedConvolution<'_> {
    fn initializers(&self) -> impl Iterator<Item = TensorProto> {
        let [split, join] = self.sizes();
        [Some(self.weight.clone()), self.bias.clone(), Some(split), Some(join)].into_iter().flatten()
    }

    /// Shapes of the separated parts, `[batch, 2, 2, 2, channels, edge, edge, edge]`, and of the interleaved output.
    fn sizes(&self) -> [TensorProto; 2] {
        let (channels, edge) = (self.channels as i64, self.edge as i64);
        // 0 keeps the batch dimension.
        let sizes = |name: &str, sizes: &[i64]| TensorProto::from_i64(&self.name(name), &[sizes.len() as i64], sizes);
        [
            sizes("split", &[0, 2, 2, 2, channels, edge, edge, edge]),
            sizes("join", &[0, channels, 2 * edge, 2 * edge, 2 * edge]),
        ]
    }

    fn name(&self, what: &str) -> String {
        format!("{}.{what}", self.node.output[0])
    }

    fn nodes(&self) -> [NodeProto; 4] {
        let kernel = self.weight.dims[2];
        let attributes = vec![
            AttributeProto::ints("kernel_shape", &[kernel; 3]),
            AttributeProto::ints("pads", &[kernel / 2; 6]),
            AttributeProto::ints("strides", &[1; 3]),
        ];
        let inputs = [self.input, self.weight.name()].into_iter().chain(self.bias.as_ref().map(TensorProto::name));
        let inputs: Vec<String> = inputs.map(str::to_owned).collect();
        let [parts, split, interleaved] = ["eight", "apart", "beside"].map(|what| self.name(what));
        let order = AttributeProto::ints("perm", &[0, 4, 5, 1, 6, 2, 7, 3]);
        [
            node("Conv", inputs, &parts, attributes),
            node("Reshape", vec![parts.clone(), self.name("split")], &split, vec![]),
            node("Transpose", vec![split.clone()], &interleaved, vec![order]),
            node("Reshape", vec![interleaved.clone(), self.name("join")], &self.node.output[0], vec![]),
        ]
    }
}

fn node(op: &str, input: Vec<String>, output: &str, attribute: Vec<AttributeProto>) -> NodeProto {
    NodeProto {
        input,
        output: vec![output.to_owned()],
        name: Some(output.to_owned()),
        op_type: Some(op.to_owned()),
        attribute,
        ..NodeProto::default()
    }
}

/// The convolution over the small array along one axis.
///
/// The output 2i + p, with p 0 or 1, reads the large array at 2i + p + d, for d from −r to r. This is the small array
/// at i + ⌊(p + d) / 2⌋.
struct SmallKernel {
    /// Radius of the large kernel.
    r: usize,
    kernel: usize,
}

impl SmallKernel {
    fn new(kernel: usize) -> Self {
        let r = kernel / 2;
        Self { r, kernel: 2 * r.div_ceil(2) + 1 }
    }

    /// The tap of the small kernel to which tap `tap` of the large kernel belongs.
    fn position(&self, parity: usize, tap: usize) -> usize {
        // ⌊(p + d) / 2⌋ counted from the first tap of the small kernel, with d = tap − r. An even offset keeps the
        // division exact.
        let half = self.kernel / 2;
        (parity + tap + 2 * half - self.r) / 2
    }

    /// The small weights, `[8 × channels, inputs, kernel³]`, from the large ones, `[channels, inputs, (2 r + 1)³]`. The
    /// first part is that of even x, y and z.
    fn weights(&self, large: &[f32], channels: usize, inputs: usize) -> Vec<f32> {
        let (taps, kernel) = (2 * self.r + 1, self.kernel);
        let mut small = vec![0.0; 8 * channels * inputs * kernel.pow(3)];
        for parity in 0..8 {
            let at = |axis: usize, tap: usize| self.position(parity >> (2 - axis) & 1, tap);
            for (filter, large) in large.chunks_exact(taps.pow(3)).enumerate() {
                let small = &mut small[(parity * channels * inputs + filter) * kernel.pow(3)..][..kernel.pow(3)];
                for (index, weight) in large.iter().enumerate() {
                    let [x, y, z] = [index / (taps * taps), index / taps % taps, index % taps];
                    small[(at(0, x) * kernel + at(1, y)) * kernel + at(2, z)] += weight;
                }
            }
        }
        small
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::DimensionValue;
    use crate::{Architecture, Orientation, averaged_over_rotations};

    #[test]
    fn taps_of_the_small_kernel_match_those_of_the_large_one() {
        for (kernel, small) in [(3, 3), (5, 3), (7, 5), (9, 5)] {
            let axis = SmallKernel::new(kernel);
            assert_eq!(axis.kernel, small);
            for parity in 0..2 {
                for tap in 0..kernel {
                    let (d, half) = (tap as i64 - (kernel / 2) as i64, (small / 2) as i64);
                    let expected = (parity as i64 + d).div_euclid(2) + half;
                    assert_eq!(
                        axis.position(parity, tap) as i64,
                        expected,
                        "kernel {kernel}, parity {parity}, tap {tap}"
                    );
                }
            }
        }
    }

    #[test]
    fn only_suitable_convolutions_are_folded() {
        let count = |model: &ModelProto, op: &str| {
            model.graph.as_ref().unwrap().node.iter().filter(|node| node.op_type() == op).count()
        };
        let vgn = Architecture::Vgn.build_with(40, Orientation::Axes, 0).unwrap();
        let folded = with_upsampling_folded(&vgn).unwrap();
        // The heads and the last convolution of the decoder. Kernels of 3³ do not gain.
        assert_eq!((count(&vgn, "Resize"), count(&folded, "Resize")), (3, 1));
        assert_eq!((count(&vgn, "Conv"), count(&folded, "Conv")), (7, 7));
        let scales = |model: &ModelProto| count(model, "Constant");
        assert_eq!(scales(&vgn) - scales(&folded), 2, "the scales of the two removed Resize nodes");
        let weights = |model: &ModelProto| -> usize {
            model.graph.as_ref().unwrap().initializer.iter().filter(|w| w.is_float()).map(TensorProto::elements).sum()
        };
        assert!(weights(&folded) < 2 * weights(&vgn), "the old weights are removed");
        assert!(with_upsampling_folded(&folded).is_none());

        let averaged = averaged_over_rotations(&vgn).unwrap();
        assert_eq!(count(&with_upsampling_folded(&averaged).unwrap(), "Resize"), 1);
        assert!(with_upsampling_folded(&Architecture::TransformerSmall.build(40, 0).unwrap()).is_none());
    }

    #[test]
    fn shapes_that_no_tensor_can_have_are_not_folded() {
        let vgn = Architecture::Vgn.build_with(40, Orientation::Axes, 0).unwrap();
        let folded = |change: &dyn Fn(&mut GraphProto)| {
            let mut model = vgn.clone();
            change(model.graph.as_mut().unwrap());
            with_upsampling_folded(&model).is_some()
        };
        assert!(folded(&|_| {}));
        let weights = |dims: [i64; 5]| {
            move |graph: &mut GraphProto| {
                for weight in graph.initializer.iter_mut().filter(|weight| weight.dims.len() == 5) {
                    weight.dims = dims.to_vec();
                }
            }
        };
        for dims in [[-1, 16, 5, 5, 5], [i64::MAX, i64::MAX, 5, 5, 5], [i64::MIN, -1, 5, 5, 5], [1 << 60, 16, 5, 5, 5]]
        {
            assert!(!folded(&weights(dims)), "{dims:?}");
        }
        for edge in [i64::MAX, -40, 1 << 50] {
            let resized = |graph: &mut GraphProto| {
                let shape = graph.input[0].r#type.as_mut().and_then(|of| match of.value.as_mut()? {
                    crate::onnx::TypeValue::TensorType(tensor) => tensor.shape.as_mut(),
                    _ => None,
                });
                shape.unwrap().dim[2..].iter_mut().for_each(|dim| dim.value = Some(DimensionValue::DimValue(edge)));
            };
            assert!(!folded(&resized), "{edge}");
        }
        let strides = |graph: &mut GraphProto| {
            for node in &mut graph.node {
                for attribute in node.attribute.iter_mut().filter(|a| ["strides", "pads"].contains(&a.name())) {
                    attribute.ints.iter_mut().for_each(|number| *number = i64::MAX);
                }
            }
        };
        assert!(!folded(&strides));
    }

    /// The graph with its Resize nodes as torch's exporters write `interpolate(x, 2 · edge)`.
    fn as_exported_by_torch(
        model: &ModelProto,
        edges: &[i64],
        sizes_of: fn(&str, &str) -> Vec<NodeProto>,
    ) -> ModelProto {
        let mut model = model.clone();
        let graph = model.graph.as_mut().unwrap();
        let mut edges = edges.iter();
        for mut resize in std::mem::take(&mut graph.node) {
            if resize.op_type() == "Resize" {
                let (x, name) = (resize.input[0].clone(), resize.output[0].clone());
                graph.node.extend(sizes_of(&x, &name));
                let size = TensorProto::from_i64(&format!("{name}.size"), &[3], &[*edges.next().unwrap(); 3]);
                graph.initializer.push(size);
                let sizes = vec![format!("{name}.kept"), format!("{name}.size")];
                let axis = AttributeProto::int("axis", 0);
                graph.node.push(node("Concat", sizes, &format!("{name}.sizes"), vec![axis]));
                resize.input = vec![x, String::new(), String::new(), format!("{name}.sizes")];
            }
            graph.node.push(resize);
        }
        model
    }

    fn shape(x: &str, output: &str, end: Option<i64>) -> NodeProto {
        let between = |end| vec![AttributeProto::int("start", 0), AttributeProto::int("end", end)];
        node("Shape", vec![x.to_owned()], output, end.map_or_else(Vec::new, between))
    }

    fn current_exporter(x: &str, name: &str) -> Vec<NodeProto> {
        vec![shape(x, &format!("{name}.kept"), Some(2))]
    }

    fn old_exporter(x: &str, name: &str) -> Vec<NodeProto> {
        let [all, from, to, axes] = ["all", "from", "to", "axes"].map(|what| format!("{name}.{what}"));
        let number = |name: &String, value| {
            node(
                "Constant",
                vec![],
                name,
                vec![AttributeProto::tensor("value", TensorProto::from_i64("", &[1], &[value]))],
            )
        };
        let numbers = [number(&from, 0), number(&to, 2), number(&axes, 0)];
        let slice = node("Slice", vec![all.clone(), from, to, axes], &format!("{name}.kept"), vec![]);
        [shape(x, &all, None)].into_iter().chain(numbers).chain([slice]).collect()
    }

    #[test]
    fn graphs_exported_by_torch_are_folded_too() {
        let vgn = Architecture::Vgn.build(40, 0).unwrap();
        let folded = with_upsampling_folded(&vgn).unwrap().graph.unwrap();
        let gained = |folded: &GraphProto| -> Vec<TensorProto> {
            folded.initializer.iter().filter(|tensor| tensor.is_float()).cloned().collect()
        };
        for sizes_of in [current_exporter, old_exporter] {
            let torchs =
                with_upsampling_folded(&as_exported_by_torch(&vgn, &[10, 20, 40], sizes_of)).unwrap().graph.unwrap();
            assert!(gained(&torchs) == gained(&folded), "the same weights");
            let count = |op: &str| torchs.node.iter().filter(|node| node.op_type() == op).count();
            assert_eq!((count("Resize"), count("Concat"), count("Shape")), (1, 1, 1), "the kernel of 3³ is not folded");

            let trebled = as_exported_by_torch(&vgn, &[10, 20, 60], sizes_of);
            let left = with_upsampling_folded(&trebled).unwrap().graph.unwrap();
            assert_eq!(
                left.node.iter().filter(|node| node.op_type() == "Resize").count(),
                2,
                "upsampling by 3 is not folded"
            );
        }
        let mut kept = as_exported_by_torch(&vgn, &[10, 20, 40], current_exporter);
        for node in kept.graph.as_mut().unwrap().node.iter_mut().filter(|node| node.op_type() == "Resize") {
            node.attribute.push(AttributeProto::string("keep_aspect_ratio_policy", "not_larger"));
        }
        assert!(with_upsampling_folded(&kept).is_none());
        // Sizes of another value or of other dimensions are not accepted.
        let another: fn(&str, &str) -> Vec<NodeProto> = |_, name| vec![shape("tsdf", &format!("{name}.kept"), Some(2))];
        let others: fn(&str, &str) -> Vec<NodeProto> = |x, name| vec![shape(x, &format!("{name}.kept"), Some(3))];
        for sizes_of in [another, others] {
            assert!(with_upsampling_folded(&as_exported_by_torch(&vgn, &[10, 20, 40], sizes_of)).is_none());
        }
    }
}
