//! What is known of the values of a graph.

use std::collections::HashMap;

use crate::onnx::{AttributeProto, DimensionValue, GraphProto, NodeProto, TensorProto};

/// Largest edge of an array that is considered, voxels. Files may contain any number.
const MAX_EDGE: usize = 1 << 16;

/// Lookup tables of a graph, by the name of a value.
pub(super) struct GraphIndex<'a> {
    /// Initialisers and constants.
    pub constants: HashMap<&'a str, &'a TensorProto>,
    /// The node that computes a value.
    pub producers: HashMap<&'a str, &'a NodeProto>,
    /// The edge of a value of shape `[batch, channels, edge, edge, edge]`.
    pub edges: HashMap<&'a str, usize>,
}

impl<'a> GraphIndex<'a> {
    pub fn new(graph: &'a GraphProto) -> Self {
        let mut index = Self { constants: HashMap::new(), producers: HashMap::new(), edges: HashMap::new() };
        index.constants.extend(graph.initializer.iter().map(|tensor| (tensor.name(), tensor)));
        for input in &graph.input {
            if let Some(edge) = cube_edge(input) {
                index.edges.insert(input.name(), edge);
            }
        }
        for node in &graph.node {
            if let ("Constant", Some(value)) = (node.op_type(), node.attribute("value").and_then(|a| a.t.as_ref())) {
                index.constants.extend(node.output.iter().map(|name| (name.as_str(), value)));
            }
            if let Some(edge) = index.edge_after(node) {
                index.edges.extend(node.output.iter().map(|name| (name.as_str(), edge)));
            }
            index.producers.extend(node.output.iter().map(|name| (name.as_str(), node)));
        }
        index
    }

    pub fn numbers(&self, name: &str) -> Option<Vec<f32>> {
        self.constants.get(name)?.to_f32().ok()
    }

    pub fn whole_numbers(&self, name: &str) -> Option<Vec<i64>> {
        self.constants.get(name)?.to_i64().ok()
    }

    fn edge_after(&self, node: &NodeProto) -> Option<usize> {
        let edge = *self.edges.get(node.input.first()?.as_str())?;
        match node.op_type() {
            "Relu" | "LeakyRelu" | "Transpose" | "Concat" => Some(edge),
            // Only a slice that reverses whole axes keeps the size.
            "Slice" => {
                let all = |input: usize, value: i64| {
                    let values = self.whole_numbers(node.input.get(input)?)?;
                    values.iter().all(|&one| one == value).then_some(())
                };
                (all(1, -1), all(2, i64::MIN), all(4, -1)).eq(&(Some(()), Some(()), Some(()))).then_some(edge)
            }
            "Resize" => self.is_upsampling_by_2(node).then_some(2 * edge).filter(|edge| *edge <= MAX_EDGE),
            "Conv" => {
                let ConvShape { kernel, pad, stride } = conv_shape(node)?;
                Some((edge + 2 * pad).checked_sub(kernel)? / stride + 1)
            }
            _ => None,
        }
    }

    /// Whether a node is a nearest-neighbour upsampling by 2 along each axis.
    pub fn is_upsampling_by_2(&self, node: &NodeProto) -> bool {
        let has = |name: &str, value: &str| node.attribute(name).is_some_and(|a| a.s() == value.as_bytes());
        let scales = node.input.get(2).and_then(|scales| self.numbers(scales));
        has("mode", "nearest")
            && has("coordinate_transformation_mode", "asymmetric")
            && has("nearest_mode", "floor")
            && node.attribute("axes").is_none()
            && (scales.is_some_and(|scales| scales == [1.0, 1.0, 2.0, 2.0, 2.0]) || self.sizes_double(node))
    }

    /// Whether the output sizes of a Resize are the batch and channels of its input and twice its edge: the export of
    /// `interpolate(x, 40)` by `torch.onnx.export` for an x with edge 20.
    fn sizes_double(&self, node: &NodeProto) -> bool {
        let [of, _, _, sizes] = node.input.as_slice() else { return false };
        let (Some(sizes), Some(&edge)) = (self.producers.get(sizes.as_str()), self.edges.get(of.as_str())) else {
            return false;
        };
        let [kept, doubled] = sizes.input.as_slice() else { return false };
        // Other policies keep the aspect ratio over all dimensions, including the batch.
        let stretches = |policy: &AttributeProto| policy.s() == b"stretch";
        node.attribute("keep_aspect_ratio_policy").is_none_or(stretches)
            && sizes.op_type() == "Concat"
            && self.whole_numbers(doubled).is_some_and(|sizes| sizes == [2 * edge as i64; 3])
            && self.is_batch_and_channels(kept, of)
    }

    /// Whether a value is the first two dimensions of another, as either of torch's exporters writes it.
    fn is_batch_and_channels(&self, value: &str, of: &str) -> bool {
        let shape = |name: &str| {
            let node = self.producers.get(name)?;
            (node.op_type() == "Shape" && node.input == [of]).then(|| {
                let integer = |name: &str| node.attribute(name).map(AttributeProto::i);
                (integer("start").unwrap_or(0), integer("end"))
            })
        };
        let Some(node) = self.producers.get(value) else { return false };
        match (node.op_type(), node.input.as_slice()) {
            ("Shape", _) => shape(value) == Some((0, Some(2))),
            ("Slice", [all, start, end, axes]) => {
                shape(all) == Some((0, None))
                    && [(start, 0), (end, 2), (axes, 0)]
                        .into_iter()
                        .all(|(name, value)| self.whole_numbers(name).is_some_and(|values| values == [value]))
            }
            _ => false,
        }
    }
}

/// Parameters of a convolution that are equal along every axis.
pub(super) struct ConvShape {
    pub kernel: usize,
    pub pad: usize,
    pub stride: usize,
}

/// The parameters of a convolution, if they are equal along every axis and there are no groups or dilations.
pub(super) fn conv_shape(node: &NodeProto) -> Option<ConvShape> {
    let same = |name: &str, count: usize, default: Option<usize>| {
        let Some(attribute) = node.attribute(name) else { return default };
        let first = attribute.ints.first()?;
        (attribute.ints.len() == count && attribute.ints.iter().all(|one| one == first)).then_some(())?;
        usize::try_from(*first).ok().filter(|number| *number <= MAX_EDGE)
    };
    let whole = |name: &str| node.attribute(name).map_or(1, AttributeProto::i);
    let padded = node.attribute("auto_pad").is_none_or(|pad| pad.s() == b"NOTSET");
    if whole("group") != 1 || same("dilations", 3, Some(1)) != Some(1) || !padded {
        return None;
    }
    let stride = same("strides", 3, Some(1)).filter(|&stride| stride > 0)?;
    Some(ConvShape { kernel: same("kernel_shape", 3, None)?, pad: same("pads", 6, Some(0))?, stride })
}

/// The edge of an input `[batch, channels, edge, edge, edge]`.
fn cube_edge(input: &crate::onnx::ValueInfoProto) -> Option<usize> {
    let shape = input.tensor_type()?.shape.as_ref()?;
    let [_, _, x, y, z] = shape.dim.as_slice() else { return None };
    match (&x.value, x == y && y == z) {
        (Some(DimensionValue::DimValue(edge)), true) => usize::try_from(*edge).ok().filter(|edge| *edge <= MAX_EDGE),
        _ => None,
    }
}
