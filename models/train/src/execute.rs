//! Executes an ONNX graph with libtorch, under autograd.
//!
//! What is trained is what is served: each node becomes the libtorch operation of the same meaning, each weight a tensor
//! that learns. Weights are the floating-point initialisers, except numbers (rank 0) and those that say how an operator
//! works, such as the bounds of a `Clip`. Only what grasp networks use is here, and anything else is refused when the
//! graph is loaded, by its name: an operator or a setting that was skipped would train another network.

use std::collections::{HashMap, HashSet};
use std::ops::RangeInclusive;

use grasp_models::onnx::{AttributeProto, ModelProto, NodeProto, OperatorSetIdProto, TensorError, TensorProto};
use tch::{Device, Kind, TchError, Tensor, no_grad};
use thiserror::Error;

use crate::heads::{cubes, heads};

/// The versions of ONNX's operators that are understood. `Split`, `Softmax` and others meant something else before, or
/// took as settings what are inputs now; later ones were never tried.
const OPSETS: RangeInclusive<i64> = 13..=20;

/// An operator as ONNX names it, with the settings of it that are understood.
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
    ("Transpose", &["perm"]),
];

/// Why a graph cannot be executed.
#[derive(Debug, Error)]
pub enum ExecuteError {
    /// The file holds no graph.
    #[error("the model holds no graph")]
    NoGraph,
    /// The model is written in operators of another version.
    #[error(
        "the model is of opset {0}, it must be from {first} to {last} to be trained; export it again with one of these",
        first = OPSETS.start(),
        last = OPSETS.end()
    )]
    Opset(i64),
    /// The operator is not implemented.
    #[error("node `{node}`: the operator `{op}` cannot be trained; there are {}", supported())]
    Operator {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
    },
    /// A setting of an operator is not implemented.
    #[error("node `{node}` ({op}): {what} is not supported")]
    Setting {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// The setting.
        what: String,
    },
    /// A node reads what no node before it computed.
    #[error("node `{node}` ({op}): `{value}` is not computed before it")]
    Missing {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// What it reads.
        value: String,
    },
    /// libtorch refused.
    #[error("node `{node}` ({op}): {source}")]
    Torch {
        /// The node.
        node: String,
        /// Its operator.
        op: String,
        /// What it said.
        source: TchError,
    },
    /// The graph does not compute this output.
    #[error("the graph has no output `{0}`")]
    Output(&'static str),
    /// The voxels asked for are not in the batch.
    #[error("these voxels cannot be taken from the maps: {0}")]
    Cells(TchError),
    /// An initialiser's values cannot be used.
    #[error(transparent)]
    Tensor(#[from] TensorError),
}

fn supported() -> String {
    OPERATORS.iter().map(|&(op, _)| op).collect::<Vec<_>>().join(", ")
}

/// How the graph is executed. None of it changes the mathematics; bf16 changes the precision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Execution {
    /// Where.
    pub device: Device,
    /// Convolutions and matrix products in bfloat16, and what follows them as far as it does no harm (as in PyTorch's
    /// autocast); weights, sums, softmax, layer norms and outputs in f32.
    pub bf16: bool,
    /// The channels of a voxel next to each other in memory.
    pub channels_last: bool,
}

/// A network whose weights can be trained.
pub struct Executor {
    model: ModelProto,
    execution: Execution,
    /// The weights, in the order of the initialisers.
    parameters: Vec<(String, Tensor)>,
    constants: HashMap<String, Tensor>,
    /// The nodes from which on single voxels can be computed.
    heads: HashSet<usize>,
}

/// What a grasp network computes, f32: over a batch of volumes, or at single voxels, which are then volumes of 1³.
pub struct Outputs {
    /// `[batch, 1, N, N, N]`, in [0, 1].
    pub quality: Tensor,
    /// `[batch, 4, N, N, N]`, unit quaternions x y z w.
    pub rotation: Tensor,
    /// `[batch, 1, N, N, N]`, voxels.
    pub width: Tensor,
}

impl Executor {
    /// Takes over a model: checks that every node can be executed and makes its weights trainable.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that cannot be executed, or the opset.
    pub fn new(model: ModelProto, execution: Execution) -> Result<Self, ExecuteError> {
        let graph = model.graph.as_ref().ok_or(ExecuteError::NoGraph)?;
        let standard = model.opset_import.iter().find(|opset| matches!(opset.domain(), "" | "ai.onnx"));
        // A file that does not say is of the first.
        let opset = standard.map_or(1, OperatorSetIdProto::version);
        if !OPSETS.contains(&opset) {
            return Err(ExecuteError::Opset(opset));
        }
        let settings: HashSet<&str> = graph.node.iter().flat_map(settings_of).map(String::as_str).collect();
        let mut parameters = Vec::new();
        let mut constants = HashMap::new();
        for initializer in &graph.initializer {
            let name = initializer.name().to_owned();
            if initializer.is_float() && !initializer.dims.is_empty() && !settings.contains(initializer.name()) {
                let weight = tensor_of(initializer)?.to_device(execution.device);
                parameters.push((name, execution.arrange(&weight).set_requires_grad(true)));
            } else {
                constants.insert(name, constant(initializer, execution.device)?);
            }
        }
        for node in &graph.node {
            check(node)?;
            if node.op_type() == "Constant"
                && let Some(value) = node.attribute("value").and_then(|value| value.t.as_ref())
            {
                constants.insert(output_name(node, 0), constant(value, execution.device)?);
            }
        }
        let heads = heads(graph);
        Ok(Self { model, execution, parameters, constants, heads })
    }

    /// The weights, by the names of their initialisers.
    pub fn parameters(&self) -> &[(String, Tensor)] {
        &self.parameters
    }

    /// Where it is executed.
    #[must_use]
    pub fn device(&self) -> Device {
        self.execution.device
    }

    /// The model with the weights as they are now.
    #[must_use]
    pub fn to_model(&self) -> ModelProto {
        let mut model = self.model.clone();
        let initializers = model.graph.iter_mut().flat_map(|graph| &mut graph.initializer);
        let weights: HashMap<&str, &Tensor> = self.parameters.iter().map(|(name, w)| (name.as_str(), w)).collect();
        for initializer in initializers {
            if let Some(weight) = weights.get(initializer.name()) {
                initializer.set_f32(&values_of(weight));
            }
        }
        model
    }

    /// Runs the network over `[batch, 1, N, N, N]`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn forward(&self, volumes: &Tensor) -> Result<Outputs, ExecuteError> {
        self.maps(volumes, None)
    }

    /// Runs any graph with one input, and returns one of its outputs in f32.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed, or the output that there is not.
    pub fn output(&self, input: &Tensor, name: &'static str) -> Result<Tensor, ExecuteError> {
        take(&mut self.execute(input, None)?, name)
    }

    /// Runs the network as far as some voxels need it, which are given as flat indices into `[batch, N, N, N]`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn forward_at(&self, volumes: &Tensor, cells: &[i64]) -> Result<Outputs, ExecuteError> {
        if !self.heads.is_empty() {
            return self.maps(volumes, Some(cells));
        }
        let Outputs { quality, rotation, width } = self.forward(volumes)?;
        let at = |map: &Tensor, channels: i64| {
            cubes(map, cells, 1)
                .and_then(|values| values.f_reshape([-1, channels, 1, 1, 1]))
                .map_err(ExecuteError::Cells)
        };
        Ok(Outputs { quality: at(&quality, 1)?, rotation: at(&rotation, 4)?, width: at(&width, 1)? })
    }

    fn maps(&self, volumes: &Tensor, cells: Option<&[i64]>) -> Result<Outputs, ExecuteError> {
        let mut values = self.execute(volumes, cells)?;
        let [quality, rotation, width] = ["quality", "rotation", "width"].map(|name| take(&mut values, name));
        Ok(Outputs { quality: quality?, rotation: rotation?, width: width? })
    }

    /// The value of every node, computed in order; the heads at `cells` alone, if any are given.
    fn execute(&self, input: &Tensor, cells: Option<&[i64]>) -> Result<HashMap<String, Tensor>, ExecuteError> {
        let graph = self.model.graph.as_ref().ok_or(ExecuteError::NoGraph)?;
        let mut values: HashMap<String, Tensor> = HashMap::with_capacity(graph.node.len());
        if let Some(declared) = graph.input.first() {
            values.insert(declared.name().to_owned(), input.shallow_clone());
        }
        for (name, tensor) in self.constants.iter().chain(self.parameters.iter().map(|(name, weight)| (name, weight))) {
            values.insert(name.clone(), tensor.shallow_clone());
        }
        for (index, node) in graph.node.iter().enumerate().filter(|(_, node)| node.op_type() != "Constant") {
            let inputs = node
                .input
                .iter()
                .map(|name| match values.get(name) {
                    Some(value) => Ok(Some(value)),
                    None if name.is_empty() => Ok(None),
                    None => Err(ExecuteError::Missing {
                        node: node.name().to_owned(),
                        op: node.op_type().to_owned(),
                        value: name.clone(),
                    }),
                })
                .collect::<Result<Vec<_>, _>>()?;
            let step = Step { node, inputs, execution: self.execution };
            let outputs = match cells.filter(|_| self.heads.contains(&index)) {
                Some(cells) => vec![step.convolution_at(cells)?],
                None => step.run()?,
            };
            values.extend(node.output.iter().cloned().zip(outputs));
        }
        Ok(values)
    }
}

/// An output among the values, in f32.
fn take(values: &mut HashMap<String, Tensor>, name: &'static str) -> Result<Tensor, ExecuteError> {
    values.remove(name).map(|value| value.to_kind(Kind::Float)).ok_or(ExecuteError::Output(name))
}

impl Execution {
    /// A weight as it should lie in memory; the numbers stay the same.
    pub fn arrange(self, weight: &Tensor) -> Tensor {
        if self.channels_last && weight.dim() == 5 {
            weight.permute([0, 2, 3, 4, 1]).contiguous().permute([0, 4, 1, 2, 3])
        } else {
            weight.contiguous()
        }
    }
}

/// A tensor's numbers, row-major.
pub(crate) fn values_of(tensor: &Tensor) -> Vec<f32> {
    let tensor = no_grad(|| tensor.to_device(Device::Cpu).contiguous());
    let mut values = vec![0.0; tensor.numel()];
    let count = values.len();
    tensor.copy_data(&mut values, count);
    values
}

pub(crate) fn tensor_of(tensor: &TensorProto) -> Result<Tensor, TensorError> {
    let flat =
        if tensor.is_float() { Tensor::from_slice(&tensor.to_f32()?) } else { Tensor::from_slice(&tensor.to_i64()?) };
    Ok(flat.reshape(&tensor.dims))
}

/// A tensor that does not learn. Whole numbers are shapes and sizes, which are read on the CPU.
fn constant(tensor: &TensorProto, device: Device) -> Result<Tensor, TensorError> {
    let device = if tensor.is_float() { device } else { Device::Cpu };
    Ok(tensor_of(tensor)?.to_device(device))
}

/// The inputs of a node that say how it works, rather than being worked on: a network must not learn them.
fn settings_of(node: &NodeProto) -> &[String] {
    match node.op_type() {
        "Clip" | "Resize" => node.input.get(1..).unwrap_or_default(),
        _ => &[],
    }
}

fn output_name(node: &NodeProto, index: usize) -> String {
    node.output.get(index).cloned().unwrap_or_default()
}

fn check(node: &NodeProto) -> Result<(), ExecuteError> {
    let (name, op) = (node.name().to_owned(), node.op_type().to_owned());
    let known = OPERATORS.iter().find(|(known, _)| *known == op && node.domain().is_empty());
    let Some((_, settings)) = known else { return Err(ExecuteError::Operator { node: name, op }) };
    match node.attribute.iter().find(|attribute| !settings.contains(&attribute.name())) {
        Some(unknown) => {
            Err(ExecuteError::Setting { node: name, op, what: format!("the setting `{}`", unknown.name()) })
        }
        None => Ok(()),
    }
}

/// One node with the values it reads.
struct Step<'a> {
    node: &'a NodeProto,
    inputs: Vec<Option<&'a Tensor>>,
    execution: Execution,
}

impl Step<'_> {
    fn run(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let one = |result: Result<Tensor, TchError>| Ok(vec![result.map_err(|source| self.torch(source))?]);
        match self.node.op_type() {
            "Add" => one(self.input(0)?.f_add(self.input(1)?)),
            "Clip" => one(self.input(0)?.f_clamp_tensor(self.optional(1), self.optional(2))),
            "Concat" => {
                let values: Vec<&Tensor> = self.inputs.iter().copied().flatten().collect();
                one(Tensor::f_cat(&values, self.int("axis", 0)))
            }
            "Conv" => self.convolution(false),
            "ConvTranspose" => self.convolution(true),
            "Div" => one(self.input(0)?.f_div(self.input(1)?)),
            "Erf" => one(self.input(0)?.f_erf()),
            "Expand" => one(self.input(0)?.f_broadcast_to(self.whole(1)?)),
            "Flatten" => {
                let x = self.input(0)?;
                let size = x.size();
                let axis = self.axis("axis", 1, size.len())?;
                one(x.f_reshape([size[..axis].iter().product(), -1]))
            }
            "InstanceNormalization" => {
                let [x, scale, bias] = [self.input(0)?, self.input(1)?, self.input(2)?];
                let epsilon = self.float("epsilon", 1e-5);
                one(x.f_instance_norm(Some(scale), Some(bias), None, None, true, 0.0, epsilon, false))
            }
            "LayerNormalization" => {
                let [x, scale, bias] = [self.full(0)?, self.full(1)?, self.full(2)?];
                let size = x.size();
                let axis = self.axis("axis", -1, size.len())?;
                one(x.f_layer_norm(&size[axis..], Some(scale), Some(bias), self.float("epsilon", 1e-5), false))
            }
            "LeakyRelu" => {
                let (x, slope) = (self.input(0)?, self.float("alpha", 0.01));
                if slope as f32 == 0.01 {
                    one(x.f_leaky_relu())
                } else {
                    // The binding has that slope built in; PReLU is the same function with any, and six times slower.
                    one(x.f_prelu(&Tensor::from(slope).to_kind(x.kind()).to_device(x.device())))
                }
            }
            "MatMul" => one(self.reduced(0)?.f_matmul(&self.reduced(1)?)),
            "MaxPool" => self.max_pool(),
            "Mul" => one(self.input(0)?.f_mul(self.input(1)?)),
            "ReduceL2" => {
                // A setting until opset 17, an input since.
                let axes = if self.optional(1).is_some() { self.whole(1)? } else { self.ints("axes", &[]) };
                if axes.is_empty() && self.int("noop_with_empty_axes", 0) != 0 {
                    return Err(self.setting("`noop_with_empty_axes`".to_owned()));
                }
                one(self.full(0)?.f_norm_scalaropt_dim(2, axes, self.int("keepdims", 1) != 0))
            }
            "Relu" => one(self.input(0)?.f_relu()),
            "Reshape" => one(self.input(0)?.f_reshape(self.new_shape()?)),
            "Resize" => one(self.nearest()?),
            "Shape" => one(Tensor::f_from_slice(&self.input(0)?.size())),
            "Sigmoid" => one(self.full(0)?.f_sigmoid()),
            "Slice" => self.slice(),
            "Softmax" => one(self.full(0)?.f_softmax(self.int("axis", -1), Kind::Float)),
            "Split" => {
                let sizes = self.whole(1)?;
                let split = self.input(0)?.f_split_with_sizes(sizes, self.int("axis", 0));
                split.map_err(|source| self.torch(source))
            }
            "Transpose" => {
                let x = self.input(0)?;
                let reversed: Vec<i64> = (0..x.dim() as i64).rev().collect();
                one(x.f_permute(self.ints("perm", &reversed)))
            }
            op => Err(ExecuteError::Operator { node: self.node.name().to_owned(), op: op.to_owned() }),
        }
    }

    fn convolution(&self, transposed: bool) -> Result<Vec<Tensor>, ExecuteError> {
        // oneDNN's bf16 gradient of a weight reads memory it never wrote when a volume is narrower than the kernel.
        let narrow =
            self.input(0)?.size().iter().zip(self.input(1)?.size()).skip(2).any(|(size, kernel)| *size < kernel);
        let [x, weight] = if narrow { [self.full(0)?, self.full(1)?] } else { [self.reduced(0)?, self.reduced(1)?] };
        let bias = self.optional(2).map(|bias| bias.to_kind(x.kind()));
        let axes = weight.dim().saturating_sub(2);
        let (ones, zeros) = (vec![1; axes], vec![0; axes]);
        let pads = self.ints("pads", &[0].repeat(2 * axes));
        let (begin, end) = pads.split_at(axes);
        if begin != end {
            return Err(self.setting(format!("a padding of {begin:?} before and {end:?} after")));
        }
        let y = x.f_convolution(
            &weight,
            bias.as_ref(),
            self.ints("strides", &ones),
            begin,
            self.ints("dilations", &ones),
            transposed,
            &zeros,
            self.int("group", 1),
        );
        Ok(vec![y.map_err(|source| self.torch(source))?])
    }

    /// The maximum over windows of images.
    fn max_pool(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let x = self.input(0)?;
        let kernel = self.ints("kernel_shape", &[]);
        if x.dim() != 4 || kernel.len() != 2 {
            return Err(self.setting(format!("a window of {kernel:?} over {:?}", x.size())));
        }
        let pads = self.ints("pads", &[0; 4]);
        let (begin, end) = pads.split_at(2);
        if begin != end {
            return Err(self.setting(format!("a padding of {begin:?} before and {end:?} after")));
        }
        let (strides, dilations) = (self.ints("strides", &[1; 2]), self.ints("dilations", &[1; 2]));
        let y = x.f_max_pool2d(kernel, strides, begin, dilations, self.int("ceil_mode", 0) != 0);
        Ok(vec![y.map_err(|source| self.torch(source))?])
    }

    /// A convolution that keeps the size, at some voxels: `[voxels, channels, 1, 1, 1]`. In f32, there are few of them.
    fn convolution_at(&self, cells: &[i64]) -> Result<Tensor, ExecuteError> {
        let (x, weight) = (self.input(0)?, self.input(1)?);
        let edge = weight.size().last().copied().unwrap_or(1);
        // Channels fastest, as in the cubes.
        let compute = || {
            let weight = weight.f_permute([0, 2, 3, 4, 1])?.f_reshape([weight.size()[0], -1])?;
            let y = cubes(x, cells, edge)?.f_linear(&weight, self.optional(2))?;
            y.f_reshape([cells.len() as i64, -1, 1, 1, 1])
        };
        compute().map_err(|source| self.torch(source))
    }

    /// Repeats voxels: `Resize` as far as it agrees with libtorch's `nearest`.
    fn nearest(&self) -> Result<Result<Tensor, TchError>, ExecuteError> {
        for (name, expected) in
            [("mode", "nearest"), ("coordinate_transformation_mode", "asymmetric"), ("nearest_mode", "floor")]
        {
            let got = self.node.attribute(name).map(AttributeProto::s).unwrap_or_default();
            if got != expected.as_bytes() {
                let got = String::from_utf8_lossy(got);
                return Err(self.setting(format!("{name} `{got}` (only `{expected}`)")));
            }
        }
        let x = self.input(0)?;
        let size = match (self.optional(2).filter(|scales| scales.numel() > 0), self.optional(3)) {
            (Some(scales), _) => {
                let scales = values_of(scales);
                x.size().iter().zip(scales).map(|(&size, scale)| (size as f32 * scale).floor() as i64).collect()
            }
            (None, Some(_)) => self.whole(3)?,
            (None, None) => return Err(self.setting("neither scales nor sizes".to_owned())),
        };
        if x.dim() != 5 || size.len() != 5 || size[..2] != x.size()[..2] {
            return Err(self.setting(format!("enlarging {:?} to {size:?}", x.size())));
        }
        Ok(x.f_upsample_nearest3d(&size[2..], None, None, None))
    }

    fn slice(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let mut x = self.input(0)?.shallow_clone();
        let [starts, ends] = [self.whole(1)?, self.whole(2)?];
        let axes = if self.optional(3).is_some() { self.whole(3)? } else { (0..starts.len() as i64).collect() };
        let steps = if self.optional(4).is_some() { self.whole(4)? } else { vec![1; starts.len()] };
        for (((axis, start), end), step) in axes.into_iter().zip(starts).zip(ends).zip(steps) {
            x = x.f_slice(axis, start, end, step).map_err(|source| self.torch(source))?;
        }
        Ok(vec![x])
    }

    /// The target of a `Reshape`, where 0 means the size there is.
    fn new_shape(&self) -> Result<Vec<i64>, ExecuteError> {
        let size = self.input(0)?.size();
        let shape = self.whole(1)?.into_iter().enumerate();
        Ok(shape.map(|(axis, dim)| if dim == 0 { size.get(axis).copied().unwrap_or(0) } else { dim }).collect())
    }

    fn optional(&self, index: usize) -> Option<&Tensor> {
        self.inputs.get(index).copied().flatten()
    }

    fn input(&self, index: usize) -> Result<&Tensor, ExecuteError> {
        self.optional(index).ok_or_else(|| self.setting(format!("leaving out input {index}")))
    }

    /// An input in f32: where bf16 would cost accuracy.
    fn full(&self, index: usize) -> Result<Tensor, ExecuteError> {
        Ok(self.input(index)?.to_kind(Kind::Float))
    }

    /// An input in the precision of convolutions and matrix products.
    fn reduced(&self, index: usize) -> Result<Tensor, ExecuteError> {
        let kind = if self.execution.bf16 { Kind::BFloat16 } else { Kind::Float };
        Ok(self.input(index)?.to_kind(kind))
    }

    /// An input of whole numbers.
    fn whole(&self, index: usize) -> Result<Vec<i64>, ExecuteError> {
        let tensor = self.input(index)?;
        Vec::<i64>::try_from(tensor.to_device(Device::Cpu)).map_err(|source| self.torch(source))
    }

    fn int(&self, name: &str, default: i64) -> i64 {
        self.node.attribute(name).and_then(|attribute| attribute.i).unwrap_or(default)
    }

    fn float(&self, name: &str, default: f32) -> f64 {
        self.node.attribute(name).and_then(|attribute| attribute.f).unwrap_or(default).into()
    }

    fn ints(&self, name: &str, default: &[i64]) -> Vec<i64> {
        self.node.attribute(name).map_or_else(|| default.to_vec(), |attribute| attribute.ints.clone())
    }

    /// An axis, counted from the end when negative.
    fn axis(&self, name: &str, default: i64, dims: usize) -> Result<usize, ExecuteError> {
        let axis = self.int(name, default);
        let from_start = if axis < 0 { axis + dims as i64 } else { axis };
        usize::try_from(from_start).ok().filter(|&axis| axis < dims).ok_or_else(|| self.setting(format!("axis {axis}")))
    }

    fn setting(&self, what: String) -> ExecuteError {
        ExecuteError::Setting { node: self.node.name().to_owned(), op: self.node.op_type().to_owned(), what }
    }

    fn torch(&self, source: TchError) -> ExecuteError {
        ExecuteError::Torch { node: self.node.name().to_owned(), op: self.node.op_type().to_owned(), source }
    }
}
