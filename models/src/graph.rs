//! A builder of ONNX graphs.
//!
//! Every floating-point initialiser is a trainable parameter; constants are `Constant` nodes. The trainer relies on
//! this distinction.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, Uniform};

use crate::onnx::{
    AttributeProto, Dimension, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, TensorProto, ValueInfoProto,
};

/// Opset 17 is the oldest with `LayerNormalization`. All current versions of ONNX Runtime and OpenVINO support it.
const OPSET: i64 = 17;
/// The file format version of opset 17.
const IR_VERSION: i64 = 8;

/// Initialisation of a parameter.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Init {
    /// A constant value.
    Constant(f32),
    /// PyTorch's default for convolutions and linear layers: uniform in ±1/√`fan_in` (Kaiming-uniform with a = √5).
    FanIn(usize),
    /// Normal with mean 0 and this standard deviation.
    Normal(f32),
}

/// A graph under construction. Values are identified by their names.
pub(crate) struct Builder {
    graph: GraphProto,
    rng: ChaCha8Rng,
}

impl Builder {
    /// An empty graph; `seed` determines all random parameters.
    pub fn new(name: &str, seed: u64) -> Self {
        let graph = GraphProto { name: Some(name.to_owned()), ..GraphProto::default() };
        Self { graph, rng: ChaCha8Rng::seed_from_u64(seed) }
    }

    /// Declares an input of shape `[batch, dims…]`.
    pub fn input(&mut self, name: &str, dims: &[usize]) -> String {
        self.graph.input.push(batched(name, dims));
        name.to_owned()
    }

    /// Declares an output of shape `[batch, dims…]` and renames `value` to it.
    pub fn output(&mut self, name: &str, value: &str, dims: &[usize]) {
        // Only the producing node is renamed: no network here reads an output in another node.
        for output in self.graph.node.iter_mut().flat_map(|node| &mut node.output).filter(|o| *o == value) {
            name.clone_into(output);
        }
        self.graph.output.push(batched(name, dims));
    }

    /// Adds a trainable parameter.
    pub fn parameter(&mut self, name: &str, dims: &[usize], init: Init) -> String {
        let count = dims.iter().product();
        let values: Vec<f32> = match init {
            Init::Constant(value) => vec![value; count],
            Init::FanIn(fan_in) => {
                let bound = 1.0 / (fan_in as f32).sqrt();
                self.sample(count, Uniform::new_inclusive(-bound, bound))
            }
            Init::Normal(deviation) => self.sample(count, Normal::new(0.0, deviation)),
        };
        let dims: Vec<i64> = dims.iter().map(|&dim| dim as i64).collect();
        self.graph.initializer.push(TensorProto::from_f32(name, &dims, &values));
        name.to_owned()
    }

    fn sample<D: Distribution<f32>, E: std::fmt::Debug>(&mut self, count: usize, from: Result<D, E>) -> Vec<f32> {
        let from = from.expect("a layer has inputs, so the bounds are finite");
        from.sample_iter(&mut self.rng).take(count).collect()
    }

    /// A constant list of integers.
    pub fn integers(&mut self, values: &[i64]) -> String {
        self.constant(TensorProto::from_i64("", &[values.len() as i64], values))
    }

    /// A constant number.
    pub fn number(&mut self, value: f32) -> String {
        self.constant(TensorProto::from_f32("", &[], &[value]))
    }

    /// A constant list of numbers.
    pub fn numbers(&mut self, values: &[f32]) -> String {
        self.tensor(&[values.len()], values)
    }

    /// A constant tensor of numbers.
    pub fn tensor(&mut self, dims: &[usize], values: &[f32]) -> String {
        let dims: Vec<i64> = dims.iter().map(|&dim| dim as i64).collect();
        self.constant(TensorProto::from_f32("", &dims, values))
    }

    fn constant(&mut self, value: TensorProto) -> String {
        self.node("Constant", &[], vec![AttributeProto::tensor("value", value)])
    }

    /// An operation with one output.
    pub fn node(&mut self, op: &str, inputs: &[&str], attributes: Vec<AttributeProto>) -> String {
        let [output] = self.nodes(op, inputs, attributes);
        output
    }

    /// An operation with `N` outputs.
    pub fn nodes<const N: usize>(&mut self, op: &str, inputs: &[&str], attribute: Vec<AttributeProto>) -> [String; N] {
        let name = format!("{op}_{}", self.graph.node.len());
        let output =
            if N == 1 { [(); N].map(|()| name.clone()) } else { std::array::from_fn(|i| format!("{name}_{i}")) };
        self.graph.node.push(NodeProto {
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: output.to_vec(),
            name: Some(name),
            op_type: Some(op.to_owned()),
            attribute,
            ..NodeProto::default()
        });
        output
    }

    /// A 3D convolution with padding: the size is divided by the stride.
    pub fn conv(&mut self, name: &str, x: &str, conv: Conv) -> String {
        self.convolution::<3>(name, x, conv, (conv.kernel as i64 - 1) / 2)
    }

    /// A 2D convolution with `pad` zeros on each side. Without padding the size decreases by `kernel` - 1.
    pub fn conv_2d(&mut self, name: &str, x: &str, conv: Conv, pad: usize) -> String {
        self.convolution::<2>(name, x, conv, pad as i64)
    }

    /// 2D max pooling: the size is halved.
    pub fn max_pool_2d(&mut self, x: &str) -> String {
        let attributes = vec![AttributeProto::ints("kernel_shape", &[2; 2]), AttributeProto::ints("strides", &[2; 2])];
        self.node("MaxPool", &[x], attributes)
    }

    fn convolution<const AXES: usize>(&mut self, name: &str, x: &str, conv: Conv, pad: i64) -> String {
        let Conv { inputs, outputs, kernel, stride, bias } = conv;
        let fan_in = inputs * kernel.pow(AXES as u32);
        let dims = [&[outputs, inputs][..], &[kernel; AXES]].concat();
        let weight = self.parameter(&format!("{name}.weight"), &dims, Init::FanIn(fan_in));
        let attributes = vec![
            AttributeProto::ints("kernel_shape", &[kernel as i64; AXES]),
            AttributeProto::ints("pads", &[pad].repeat(2 * AXES)),
            AttributeProto::ints("strides", &[stride as i64; AXES]),
        ];
        if bias {
            let bias = self.parameter(&format!("{name}.bias"), &[outputs], Init::FanIn(fan_in));
            self.node("Conv", &[x, &weight, &bias], attributes)
        } else {
            self.node("Conv", &[x, &weight], attributes)
        }
    }

    /// Doubles the size with a transposed convolution of kernel 2 and stride 2, without bias.
    pub fn conv_transpose(&mut self, name: &str, x: &str, inputs: usize, outputs: usize) -> String {
        // PyTorch computes the fan-in of a transposed convolution from its output channels.
        let init = Init::FanIn(outputs * 8);
        let weight = self.parameter(&format!("{name}.weight"), &[inputs, outputs, 2, 2, 2], init);
        let attributes = vec![AttributeProto::ints("kernel_shape", &[2; 3]), AttributeProto::ints("strides", &[2; 3])];
        self.node("ConvTranspose", &[x, &weight], attributes)
    }

    /// A linear layer over the last dimension. The weight has the shape `[inputs, outputs]`.
    pub fn linear(&mut self, name: &str, x: &str, inputs: usize, outputs: usize, bias: bool) -> String {
        let weight = self.parameter(&format!("{name}.weight"), &[inputs, outputs], Init::FanIn(inputs));
        let product = self.node("MatMul", &[x, &weight], vec![]);
        if !bias {
            return product;
        }
        let bias = self.parameter(&format!("{name}.bias"), &[outputs], Init::FanIn(inputs));
        self.node("Add", &[&product, &bias], vec![])
    }

    /// The finished model.
    pub fn finish(self) -> ModelProto {
        ModelProto {
            ir_version: Some(IR_VERSION),
            producer_name: Some("graspd".to_owned()),
            producer_version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            graph: Some(self.graph),
            opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(OPSET) }],
            ..ModelProto::default()
        }
    }
}

/// Sizes of a convolution with a cubic or square kernel.
#[derive(Clone, Copy)]
pub(crate) struct Conv {
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Edge of the kernel: odd, or equal to the stride.
    pub kernel: usize,
    /// Stride along each axis.
    pub stride: usize,
    /// Whether a bias is added.
    pub bias: bool,
}

fn batched(name: &str, dims: &[usize]) -> ValueInfoProto {
    let mut shape = vec![Dimension::named("batch")];
    shape.extend(dims.iter().map(|&dim| Dimension::size(dim as i64)));
    ValueInfoProto::tensor(name, shape)
}
