//! Executes an ONNX graph with libtorch and autograd.
//!
//! Training runs the graph that is served: each node becomes the equivalent libtorch operation, each weight a trainable
//! tensor. Weights are the floating-point initializers, except scalars (rank 0) and parameters of an operator, such as
//! the bounds of a `Clip`. Only the operators of grasp networks are implemented. A graph with other operators or
//! attributes is an error when it is loaded, because ignoring them would train a different network.

use std::collections::HashSet;
use std::collections::hash_map::{Entry, HashMap};

use grasp_models::onnx::{ModelProto, NodeProto};
use grasp_models::{upsampled_convolutions, with_full_weights};
use tch::{Device, Kind, Tensor};

use crate::execution_options::ExecutionOptions;
use crate::gelu::Gelus;
use crate::occupancy::OccupancyHead;
use crate::operators::NodeCall;
use crate::pointwise::{PaddedFeatures, head_convolutions, largest_kernel};
use crate::supported::{ExecuteError, supported_graph};
use crate::tensors::{constant, tensor_of, values_of};

/// A network whose weights can be trained.
pub struct Executor {
    model: ModelProto,
    execution: ExecutionOptions,
    /// The weights, in the order of the initializers, and those of the head that completes shapes.
    parameters: Vec<(String, Tensor)>,
    constants: HashMap<String, Tensor>,
    /// Convolutions after which the graph is pointwise.
    heads: HashSet<usize>,
    /// Convolutions that are computed on their input before upsampling, with the upsampling node.
    upsampled: HashMap<usize, usize>,
    gelus: Gelus,
    occupancy: Option<OccupancyHead>,
}

/// The outputs of a grasp network, f32: for a batch of volumes, or at single voxels, which are volumes of 1³.
pub struct NetworkOutputs {
    /// `[batch, 1, N, N, N]`, in [0, 1].
    pub quality: Tensor,
    /// `[batch, 4, N, N, N]`, unit quaternions x y z w.
    pub rotation: Tensor,
    /// `[batch, 1, N, N, N]`, voxels.
    pub width: Tensor,
}

/// The values of a graph by name.
struct Values {
    all: HashMap<String, Tensor>,
    /// The features of heads that were computed at single voxels.
    padded: HashMap<String, PaddedFeatures>,
}

impl NetworkOutputs {
    /// Removes the outputs from the values of a graph.
    fn take(values: &mut HashMap<String, Tensor>) -> Result<Self, ExecuteError> {
        let [quality, rotation, width] = ["quality", "rotation", "width"].map(|name| take_output(values, name));
        Ok(Self { quality: quality?, rotation: rotation?, width: width? })
    }

    /// The outputs of `count` volumes or voxels, from index `first`.
    pub(crate) fn narrow(&self, first: usize, count: usize) -> Self {
        let part = |map: &Tensor| map.narrow(0, first as i64, count as i64);
        Self { quality: part(&self.quality), rotation: part(&self.rotation), width: part(&self.width) }
    }
}

impl Executor {
    /// Checks that every node of a model is supported and makes its weights trainable, as f32.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that cannot be executed, or the opset.
    pub fn new(model: ModelProto, execution: ExecutionOptions) -> Result<Self, ExecuteError> {
        let model = with_full_weights(&model)?;
        let graph = supported_graph(&model)?;
        let excluded: HashSet<&str> = graph.node.iter().flat_map(operator_parameters).map(String::as_str).collect();
        let mut parameters = Vec::new();
        let mut constants = HashMap::new();
        for initializer in &graph.initializer {
            let name = initializer.name().to_owned();
            if initializer.is_float() && !initializer.dims.is_empty() && !excluded.contains(initializer.name()) {
                let weight = tensor_of(initializer)?.to_device(execution.device);
                parameters.push((name, execution.arrange(&weight).set_requires_grad(true)));
            } else {
                constants.insert(name, constant(initializer, execution.device)?);
            }
        }
        for node in &graph.node {
            if node.op_type() == "Constant"
                && let Some(value) = node.attribute("value").and_then(|value| value.t.as_ref())
            {
                constants.insert(output_name(node, 0), constant(value, execution.device)?);
            }
        }
        let (heads, upsampled, gelus) = (head_convolutions(graph), upsampled_convolutions(graph), Gelus::new(graph));
        Ok(Self { model, execution, parameters, constants, heads, upsampled, gelus, occupancy: None })
    }

    /// Adds a head that completes shapes, with random weights.
    ///
    /// # Errors
    /// [`ExecuteError::NoFeatures`] if the output heads do not read the same features.
    pub fn with_occupancy_head(mut self, seed: u64) -> Result<Self, ExecuteError> {
        let graph = self.model.graph.as_ref().ok_or(ExecuteError::NoGraph)?;
        let head = OccupancyHead::new(graph, seed).ok_or(ExecuteError::NoFeatures)?;
        let head = head.map(|weight| weight.to_device(self.execution.device).set_requires_grad(true));
        let parameters = head.parameters().map(|(name, weight)| (name.to_owned(), weight.shallow_clone()));
        self.parameters.extend(parameters);
        self.occupancy = Some(head);
        Ok(self)
    }

    /// Disables the convolutions before upsampling and the GELUs in one operation, so that every value of the graph is
    /// computed.
    #[must_use]
    pub fn without_optimizations(self) -> Self {
        Self { upsampled: HashMap::new(), gelus: Gelus::default(), ..self }
    }

    /// The weights with the names of their initializers.
    pub fn parameters(&self) -> &[(String, Tensor)] {
        &self.parameters
    }

    /// The device.
    #[must_use]
    pub fn device(&self) -> Device {
        self.execution.device
    }

    /// The model with the current weights, without the head that completes shapes.
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
    pub fn forward(&self, volumes: &Tensor) -> Result<NetworkOutputs, ExecuteError> {
        self.maps(volumes, None)
    }

    /// Runs any graph with one input, and returns one of its outputs in f32.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that failed, or the missing output.
    pub fn output(&self, input: &Tensor, name: &str) -> Result<Tensor, ExecuteError> {
        take_output(&mut self.execute(input, None)?.all, name)
    }

    /// Runs any graph with one input, and returns intermediate values by name, in f32.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that failed, or the missing value.
    pub fn intermediate_values(&self, input: &Tensor, names: &[String]) -> Result<Vec<Tensor>, ExecuteError> {
        let values = self.execute(input, None)?.all;
        let value = |name: &String| values.get(name).map(|value| value.to_kind(Kind::Float));
        names.iter().map(|name| value(name).ok_or_else(|| ExecuteError::Output(name.clone()))).collect()
    }

    /// Runs the network with the heads only at some voxels, given as flat indices into `[batch, N, N, N]`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn forward_at(&self, volumes: &Tensor, voxels: &[i64]) -> Result<NetworkOutputs, ExecuteError> {
        if !self.heads.is_empty() {
            return self.maps(volumes, Some(voxels));
        }
        let NetworkOutputs { quality, rotation, width } = self.forward(volumes)?;
        let at = |map: &Tensor, channels: i64| {
            PaddedFeatures::new(map, 1)
                .and_then(|map| map.cubes(voxels, 1))
                .and_then(|values| values.f_reshape([-1, channels, 1, 1, 1]))
                .map_err(ExecuteError::Voxels)
        };
        Ok(NetworkOutputs { quality: at(&quality, 1)?, rotation: at(&rotation, 4)?, width: at(&width, 1)? })
    }

    /// Runs the network with the output heads only at `voxels`, and the head that completes shapes at `occupancy_voxels`.
    /// Returns the outputs and the logits. Both lists are flat indices into `[batch, N, N, N]`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed, or tells that there is no such head.
    pub(crate) fn forward_with_occupancy(
        &self,
        volumes: &Tensor,
        voxels: &[i64],
        occupancy_voxels: &[i64],
    ) -> Result<(NetworkOutputs, Tensor), ExecuteError> {
        let head = self.occupancy.as_ref().ok_or(ExecuteError::NoFeatures)?;
        let mut values = self.execute(volumes, Some(voxels))?;
        let features = values.padded.get(head.features()).ok_or(ExecuteError::NoFeatures)?;
        let logits = head.logits(features, occupancy_voxels).map_err(ExecuteError::Voxels)?;
        Ok((NetworkOutputs::take(&mut values.all)?, logits))
    }

    fn maps(&self, volumes: &Tensor, voxels: Option<&[i64]>) -> Result<NetworkOutputs, ExecuteError> {
        NetworkOutputs::take(&mut self.execute(volumes, voxels)?.all)
    }

    /// Computes the values of all nodes in order; the heads only at `voxels`, if given.
    fn execute(&self, input: &Tensor, voxels: Option<&[i64]>) -> Result<Values, ExecuteError> {
        let graph = self.model.graph.as_ref().ok_or(ExecuteError::NoGraph)?;
        let mut values: HashMap<String, Tensor> = HashMap::with_capacity(graph.node.len());
        let mut padded: HashMap<String, PaddedFeatures> = HashMap::new();
        if let Some(declared) = graph.input.first() {
            values.insert(declared.name().to_owned(), input.shallow_clone());
        }
        for (name, tensor) in self.constants.iter().chain(self.parameters.iter().map(|(name, weight)| (name, weight))) {
            values.insert(name.clone(), tensor.shallow_clone());
        }
        // Heads at single voxels need their input after upsampling.
        let is_at_voxels = |index: &usize| voxels.is_some() && self.heads.contains(index);
        let upsampled: HashMap<usize, &NodeProto> = self
            .upsampled
            .iter()
            .filter(|(conv, _)| !is_at_voxels(conv))
            .map(|(&conv, &resize)| (conv, &graph.node[resize]))
            .collect();
        let skipped: HashSet<&String> = upsampled.values().flat_map(|resize| &resize.output).collect();
        let nodes = graph.node.iter().enumerate().filter(|(_, node)| node.op_type() != "Constant");
        let is_skipped = |index: usize, node: &NodeProto| {
            self.gelus.inner.contains(&index) || node.output.iter().any(|name| skipped.contains(name))
        };
        for (index, node) in nodes.filter(|&(index, node)| !is_skipped(index, node)) {
            if let Some(x) = self.gelus.inputs.get(&index).and_then(|x| values.get(x)) {
                let gelu = x.f_gelu("none").map_err(|source| ExecuteError::torch(node, source))?;
                values.extend(node.output.first().map(|name| (name.clone(), gelu)));
                continue;
            }
            let small = upsampled.get(&index).and_then(|resize| resize.input.first());
            let inputs = small
                .into_iter()
                .chain(node.input.iter().skip(usize::from(small.is_some())))
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
            let call = NodeCall { node, inputs, execution: self.execution };
            let outputs = match voxels.filter(|_| self.heads.contains(&index)) {
                Some(voxels) => {
                    let features = match padded.entry(node.input.first().cloned().unwrap_or_default()) {
                        Entry::Occupied(entry) => entry.into_mut(),
                        Entry::Vacant(entry) => entry.insert(call.padded_features(largest_kernel(graph, &self.heads))?),
                    };
                    vec![call.convolution_at(features, voxels)?]
                }
                None if small.is_some() => vec![call.convolution_before_upsampling()?],
                None => call.run()?,
            };
            values.extend(node.output.iter().cloned().zip(outputs));
        }
        Ok(Values { all: values, padded })
    }
}

/// Removes an output from the values and returns it in f32.
fn take_output(values: &mut HashMap<String, Tensor>, name: &str) -> Result<Tensor, ExecuteError> {
    values.remove(name).map(|value| value.to_kind(Kind::Float)).ok_or_else(|| ExecuteError::Output(name.to_owned()))
}

/// The inputs of a node that are parameters of its operator, which must not be trained.
fn operator_parameters(node: &NodeProto) -> &[String] {
    match node.op_type() {
        "Clip" | "Resize" => node.input.get(1..).unwrap_or_default(),
        _ => &[],
    }
}

fn output_name(node: &NodeProto, index: usize) -> String {
    node.output.get(index).cloned().unwrap_or_default()
}
