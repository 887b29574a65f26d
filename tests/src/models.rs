use std::collections::BTreeMap;
use std::path::Path;

use grasp_models::Metadata;
use grasp_models::onnx::{
    AttributeProto, AttributeType, Dimension, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, TensorProto,
    TypeValue, ValueInfoProto,
};

/// Resolution of the test models' volumes.
pub const RESOLUTION: usize = 16;

/// The width that the test models predict at every voxel, voxels.
pub const WIDTH: f32 = 5.0;

/// Element types in ONNX.
const FLOAT: i64 = 1;
const INT64: i64 = 7;
const BOOL: i64 = 9;

/// Channels of the convolutions that make a model slow.
const CHANNELS: i64 = 16;

/// A network with known outputs: the quality is the volume itself, every rotation is the identity by default, and every
/// width is [`WIDTH`].
///
/// It has the inputs and outputs of every grasp network, and runs in microseconds without `convolutions`.
#[derive(Clone, Debug)]
pub struct TestModel {
    name: String,
    version: String,
    resolution: usize,
    convolutions: usize,
    rotation: [f32; 4],
    camera_azimuth: Option<f64>,
    breaks_at: Option<f32>,
    fails_at_zero: bool,
    hangs_at: Option<f32>,
    needs_fp32: bool,
}

impl TestModel {
    /// Version 1, for volumes of [`RESOLUTION`]³.
    #[must_use]
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            version: "1".to_owned(),
            resolution: RESOLUTION,
            convolutions: 0,
            rotation: [0.0, 0.0, 0.0, 1.0],
            camera_azimuth: None,
            breaks_at: None,
            fails_at_zero: false,
            hangs_at: None,
            needs_fp32: false,
        }
    }

    /// Sets the version.
    #[must_use]
    pub fn version(self, version: &str) -> Self {
        Self { version: version.to_owned(), ..self }
    }

    /// Sets the resolution of the volumes.
    #[must_use]
    pub fn resolution(self, resolution: usize) -> Self {
        Self { resolution, ..self }
    }

    /// Adds this many convolutions, of about 0.1 GFLOP each at [`RESOLUTION`], that do not change the outputs.
    #[must_use]
    pub fn convolutions(self, convolutions: usize) -> Self {
        Self { convolutions, ..self }
    }

    /// Sets the quaternion to 0, which is invalid, where the volume is at least `value`.
    #[must_use]
    pub fn breaks_at(self, value: f32) -> Self {
        Self { breaks_at: Some(value), ..self }
    }

    /// Sets the rotation at every voxel, a unit quaternion x, y, z, w.
    #[must_use]
    pub fn rotation(self, rotation: [f32; 4]) -> Self {
        Self { rotation, ..self }
    }

    /// Sets the azimuth of the camera in training, degrees about the vertical.
    #[must_use]
    pub fn camera_azimuth(self, degrees: f64) -> Self {
        Self { camera_azimuth: Some(degrees), ..self }
    }

    /// ONNX Runtime fails on batches with any voxel of value 0.
    #[must_use]
    pub fn fails_at_zero(self) -> Self {
        Self { fails_at_zero: true, ..self }
    }

    /// The inference never ends if any voxel is greater than `value`.
    #[must_use]
    pub fn hangs_at(self, value: f32) -> Self {
        Self { hangs_at: Some(value), ..self }
    }

    /// Adds a large number to the volume and subtracts it again, so that in bf16 the quality is inaccurate.
    #[must_use]
    pub fn needs_fp32(self) -> Self {
        Self { needs_fp32: true, ..self }
    }

    /// Writes the model into a folder.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write(&self, folder: &Path) {
        let path = folder.join(format!("{}-{}.onnx", self.name, self.version));
        self.build().write(&path).expect("the temporary folder can be written");
    }

    fn build(&self) -> ModelProto {
        let mut graph = GraphProto { name: Some(self.name.clone()), ..GraphProto::default() };
        graph.input.push(self.tensor("tsdf", 1));
        for (name, channels) in [("quality", 1), ("rotation", 4), ("width", 1)] {
            graph.output.push(self.tensor(name, channels));
        }

        constant(&mut graph, "nought", 0.0);
        node(&mut graph, "Mul", &["tsdf", "nought"], "zeros", vec![]);
        constant(&mut graph, "breaks_at", self.breaks_at.unwrap_or(f32::INFINITY));
        node(&mut graph, "Less", &["tsdf", "breaks_at"], "is_sound", vec![]);
        node(&mut graph, "Cast", &["is_sound"], "sound", vec![AttributeProto::int("to", FLOAT)]);
        for (index, component) in self.rotation.into_iter().enumerate() {
            constant(&mut graph, &format!("component_{index}"), component);
            node(&mut graph, "Mul", &["sound", &format!("component_{index}")], &format!("channel_{index}"), vec![]);
        }
        let channels = ["channel_0", "channel_1", "channel_2", "channel_3"];
        node(&mut graph, "Concat", &channels, "rotation", vec![AttributeProto::int("axis", 1)]);
        constant(&mut graph, "opening", WIDTH);
        node(&mut graph, "Add", &["zeros", "opening"], "width", vec![]);

        let mut delay = "zeros".to_owned();
        for layer in 0..self.convolutions {
            let inputs = if layer == 0 { 1 } else { CHANNELS };
            delay = convolution(&mut graph, &delay, &format!("delay_{layer}"), inputs, CHANNELS);
        }
        if self.convolutions > 0 {
            delay = convolution(&mut graph, &delay, "delay", CHANNELS, 1);
        }
        if self.fails_at_zero {
            // The index is 1, out of range, if a voxel is 0.
            graph.initializer.push(TensorProto::from_f32("only", &[1], &[0.0]));
            constant(&mut graph, "low", 0.01);
            node(&mut graph, "ReduceMin", &["tsdf"], "least", vec![AttributeProto::int("keepdims", 0)]);
            node(&mut graph, "Less", &["least", "low"], "is_zero", vec![]);
            node(&mut graph, "Cast", &["is_zero"], "index", vec![AttributeProto::int("to", INT64)]);
            node(&mut graph, "Gather", &["only", "index"], "nothing", vec![]);
            node(&mut graph, "Add", &[&delay, "nothing"], "delay_or_failure", vec![]);
            delay = "delay_or_failure".to_owned();
        }
        if let Some(value) = self.hangs_at {
            delay = looping_above(&mut graph, &delay, value).to_owned();
        }
        let volume = if self.needs_fp32 { offset_and_restored(&mut graph, "tsdf") } else { "tsdf" };
        node(&mut graph, "Add", &[volume, &delay], "quality", vec![]);

        let mut model = ModelProto {
            ir_version: Some(8),
            producer_name: Some("grasp-tests".to_owned()),
            graph: Some(graph),
            opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(17) }],
            ..ModelProto::default()
        };
        let metadata = Metadata {
            name: self.name.clone(),
            version: self.version.clone(),
            resolution: self.resolution,
            voxel_size: grasp::WORKSPACE_SIZE / self.resolution as f64,
            voxel_origin: grasp::VoxelOrigin::Corner,
            camera_azimuth: self.camera_azimuth,
            former_name: None,
            network: None,
            provenance: BTreeMap::from([("data".to_owned(), "none".to_owned())]),
        };
        metadata.write_to(&mut model);
        model
    }

    fn tensor(&self, name: &str, channels: i64) -> ValueInfoProto {
        let edge = Dimension::size(self.resolution as i64);
        let shape = vec![Dimension::named("batch"), Dimension::size(channels), edge.clone(), edge.clone(), edge];
        ValueInfoProto::tensor(name, shape)
    }
}

/// A convolution with weights of 0: it takes its time, and its output is 0.
fn convolution(graph: &mut GraphProto, input: &str, output: &str, inputs: i64, outputs: i64) -> String {
    let weight = format!("{output}.weight");
    let values = vec![0.0; (outputs * inputs * 125) as usize];
    graph.initializer.push(TensorProto::from_f32(&weight, &[outputs, inputs, 5, 5, 5], &values));
    let attributes = vec![AttributeProto::ints("kernel_shape", &[5; 3]), AttributeProto::ints("pads", &[2; 6])];
    node(graph, "Conv", &[input, &weight], output, attributes);
    output.to_owned()
}

/// The identity, except for the rounding of numbers between 2^16 and 2^17. It uses convolutions, because providers
/// simplify sums.
fn offset_and_restored(graph: &mut GraphProto, input: &str) -> &'static str {
    for (name, scale, offset) in [("there", 256.0, 65_536.0), ("back", 1.0 / 256.0, -256.0)] {
        graph.initializer.push(TensorProto::from_f32(&format!("{name}.weight"), &[1; 5], &[scale]));
        graph.initializer.push(TensorProto::from_f32(&format!("{name}.bias"), &[1], &[offset]));
    }
    node(graph, "Conv", &[input, "there.weight", "there.bias"], "there", vec![]);
    // The identity, since its input is never negative. It prevents the fusion of the convolutions.
    node(graph, "Relu", &["there"], "between", vec![]);
    node(graph, "Conv", &["between", "back.weight", "back.bias"], "back", vec![]);
    "back"
}

/// The input. The computation of it loops for ever if any voxel is greater than `value`.
fn looping_above(graph: &mut GraphProto, input: &str, value: f32) -> &'static str {
    constant(graph, "hangs_at", value);
    node(graph, "ReduceMax", &["tsdf"], "greatest", vec![AttributeProto::int("keepdims", 0)]);
    node(graph, "Less", &["hangs_at", "greatest"], "hangs", vec![]);
    let named = |name: &str| ValueInfoProto { name: Some(name.to_owned()), ..ValueInfoProto::default() };
    let scalar = |name: &str, element: i64| {
        let mut value = ValueInfoProto::tensor(name, vec![]);
        if let Some(TypeValue::TensorType(tensor)) = value.r#type.as_mut().and_then(|kind| kind.value.as_mut()) {
            tensor.elem_type = i32::try_from(element).ok();
        }
        value
    };
    let mut body = GraphProto {
        name: Some("body".to_owned()),
        input: vec![scalar("iteration", INT64), scalar("continues", BOOL), named("before")],
        output: vec![named("still_continues"), named("after")],
        ..GraphProto::default()
    };
    node(&mut body, "Identity", &["continues"], "still_continues", vec![]);
    node(&mut body, "Identity", &["before"], "after", vec![]);
    let body = AttributeProto {
        name: Some("body".to_owned()),
        r#type: Some(AttributeType::Graph.into()),
        g: Some(body),
        ..AttributeProto::default()
    };
    // The first input, the number of iterations, is absent.
    node(graph, "Loop", &["", "hangs", input], "delay_or_loop", vec![body]);
    "delay_or_loop"
}

fn constant(graph: &mut GraphProto, name: &str, value: f32) {
    graph.initializer.push(TensorProto::from_f32(name, &[], &[value]));
}

fn node(graph: &mut GraphProto, op: &str, inputs: &[&str], output: &str, attribute: Vec<AttributeProto>) {
    graph.node.push(NodeProto {
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        name: Some(output.to_owned()),
        op_type: Some(op.to_owned()),
        attribute,
        ..NodeProto::default()
    });
}
