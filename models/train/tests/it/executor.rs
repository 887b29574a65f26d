//! ONNX graphs that the executor supports, beyond the networks of this repository, and those that it rejects.

use grasp_models::onnx::{AttributeProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, TensorProto};
use grasp_models::{Architecture, Orientation, gpd};
use grasp_train::{Adam, ExecuteError, ExecutionOptions, Executor, NetworkOutputs};
use tch::{Device, Kind, Tensor, no_grad};

const N: usize = 16;
const EXECUTION: ExecutionOptions = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: false };

fn vgn() -> ModelProto {
    Architecture::Vgn.build(N, 0).unwrap()
}

fn run(model: ModelProto, execution: ExecutionOptions) -> Result<NetworkOutputs, ExecuteError> {
    let edge = N as i64;
    // Deterministic values. libtorch's generator is shared with tests that run in parallel.
    let volumes = (Tensor::arange(2 * edge.pow(3), (Kind::Float, Device::Cpu)) * 0.7).sin() * 0.5 + 0.5;
    let volumes = volumes.view([2, 1, edge, edge, edge]);
    let executor = Executor::new(model, execution)?;
    no_grad(|| executor.forward(&volumes))
}

fn difference(a: &NetworkOutputs, b: &NetworkOutputs) -> f64 {
    let pairs = [(&a.quality, &b.quality), (&a.rotation, &b.rotation), (&a.width, &b.width)];
    pairs.iter().map(|(a, b)| (*a - *b).abs().max().double_value(&[])).fold(0.0, f64::max)
}

fn node(op: &str, inputs: &[&str], output: &str, attribute: Vec<AttributeProto>) -> NodeProto {
    NodeProto {
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        name: Some(output.to_owned()),
        op_type: Some(op.to_owned()),
        attribute,
        ..NodeProto::default()
    }
}

fn whole_numbers(name: &str, values: &[i64]) -> NodeProto {
    let value = TensorProto::from_i64("", &[values.len() as i64], values);
    node("Constant", &[], name, vec![AttributeProto::tensor("value", value)])
}

/// The same network in the style of PyTorch's export of VGN: three heads, sizes computed from shapes, expanded norms.
fn as_exported(mut model: ModelProto) -> ModelProto {
    let graph = model.graph.as_mut().unwrap();
    unfuse_heads(graph);
    let mut nodes = vec![whole_numbers("zero", &[0]), whole_numbers("two", &[2])];
    let mut size = N as i64 / 8;
    for mut it in std::mem::take(&mut graph.node) {
        let output = it.output[0].clone();
        let name = |suffix: &str| format!("{output}.{suffix}");
        match it.op_type() {
            "Resize" => {
                size *= 2;
                nodes.push(node("Shape", &[&it.input[0]], &name("shape"), vec![]));
                nodes.push(node("Slice", &[&name("shape"), "zero", "two", "zero"], &name("first"), vec![]));
                nodes.push(whole_numbers(&name("edges"), &[size; 3]));
                let axis = AttributeProto::int("axis", 0);
                nodes.push(node("Concat", &[&name("first"), &name("edges")], &name("size"), vec![axis]));
                it.input = vec![it.input[0].clone(), String::new(), String::new(), name("size")];
                it.attribute.push(AttributeProto::float("cubic_coeff_a", -0.75));
            }
            "Div" => {
                nodes.push(node("Shape", &[&it.input[0]], &name("shape"), vec![]));
                nodes.push(node("Expand", &[&it.input[1], &name("shape")], &name("length"), vec![]));
                it.input[1] = name("length");
            }
            _ => {}
        }
        nodes.push(it);
    }
    graph.node = nodes;
    model
}

fn unfuse_heads(graph: &mut GraphProto) {
    let split = graph.node.iter().position(|node| node.op_type() == "Split").unwrap();
    let outputs = graph.node[split].output.clone();
    let fused = graph.node.iter().position(|node| node.op_type() == "Conv" && node.input[1] == "heads.weight").unwrap();
    let [weight, bias] = ["heads.weight", "heads.bias"].map(|name| {
        let index = graph.initializer.iter().position(|tensor| tensor.name() == name).unwrap();
        graph.initializer.remove(index)
    });
    let (weights, biases) = (weight.to_f32().unwrap(), bias.to_f32().unwrap());
    let per_channel = weights.len() / 6;
    let mut heads = Vec::new();
    for (output, channels) in outputs.iter().zip([0..1, 1..5, 5..6]) {
        let mut dims = weight.dims.clone();
        dims[0] = channels.len() as i64;
        let (weight, bias) = (format!("{output}.weight"), format!("{output}.bias"));
        let part = &weights[channels.start * per_channel..channels.end * per_channel];
        graph.initializer.push(TensorProto::from_f32(&weight, &dims, part));
        graph.initializer.push(TensorProto::from_f32(&bias, &[channels.len() as i64], &biases[channels]));
        let mut attributes = graph.node[fused].attribute.clone();
        attributes.push(AttributeProto::ints("dilations", &[1; 3]));
        attributes.push(AttributeProto::int("group", 1));
        heads.push(node("Conv", &[&graph.node[fused].input[0], &weight, &bias], output, attributes));
    }
    graph.node.splice(split..=split, heads);
    graph.node.remove(fused);
}

/// The same network for opset 18, in which the axes of `ReduceL2` are an input.
fn with_axes_as_input(mut model: ModelProto) -> ModelProto {
    model.opset_import[0].version = Some(18);
    let graph = model.graph.as_mut().unwrap();
    let reduce = graph.node.iter_mut().find(|node| node.op_type() == "ReduceL2").unwrap();
    reduce.attribute.retain(|attribute| attribute.name() != "axes");
    reduce.attribute.push(AttributeProto::int("noop_with_empty_axes", 0));
    reduce.input.push("axes".to_owned());
    graph.initializer.push(TensorProto::from_i64("axes", &[1], &[1]));
    model
}

#[test]
fn axes_are_an_attribute_or_an_input() {
    let (setting, input) = (run(vgn(), EXECUTION).unwrap(), run(with_axes_as_input(vgn()), EXECUTION).unwrap());
    assert!(difference(&setting, &input) == 0.0);
}

#[test]
fn only_weights_are_trained() {
    let mut model = vgn();
    let graph = model.graph.as_mut().unwrap();
    // A factor, and bounds and scales of operators, as initializers.
    let width = graph.node.iter_mut().flat_map(|node| &mut node.output).find(|output| *output == "width").unwrap();
    *width = "raw".to_owned();
    let product = node("Mul", &["raw", "factor"], "product", vec![]);
    graph.node.extend([product, node("Clip", &["product", "low", "high"], "width", vec![])]);
    let resize = graph.node.iter_mut().find(|node| node.op_type() == "Resize").unwrap();
    resize.input[2] = "scales".to_owned();
    let constants = [
        TensorProto::from_f32("factor", &[], &[2.0]),
        TensorProto::from_f32("low", &[1], &[-100.0]),
        TensorProto::from_f32("high", &[], &[100.0]),
        TensorProto::from_f32("scales", &[5], &[1.0, 1.0, 2.0, 2.0, 2.0]),
    ];
    graph.initializer.splice(1..1, constants);

    let executor = Executor::new(model.clone(), EXECUTION).unwrap();
    let edge = N as i64;
    let outputs = executor.forward(&Tensor::ones([1, 1, edge, edge, edge], (Kind::Float, Device::Cpu))).unwrap();
    (outputs.quality.sum(None) + outputs.rotation.sum(None) + outputs.width.sum(None)).backward();
    Adam::new(executor.parameters(), 0.0).step(executor.parameters(), 0.1);
    let (before, after) = (model.graph.unwrap().initializer, executor.to_model().graph.unwrap().initializer);
    for (before, after) in before.iter().zip(&after) {
        let constant = ["factor", "low", "high", "scales"].contains(&before.name());
        assert_eq!(before == after, constant, "{}", before.name());
    }
}

#[test]
fn unsupported_opsets_are_errors() {
    let of = |opsets: &[(&str, i64)]| {
        let import = |&(domain, version): &(&str, i64)| OperatorSetIdProto {
            domain: Some(domain.to_owned()),
            version: Some(version),
        };
        let model = ModelProto { opset_import: opsets.iter().map(import).collect(), ..vgn() };
        Executor::new(model, EXECUTION).err().map(|error| error.to_string())
    };
    for version in [13, 20] {
        assert_eq!(of(&[("com.example", 1), ("", version)]), None);
    }
    for version in [12, 21] {
        let error = of(&[("", version)]).unwrap();
        assert!(error.contains(&format!("opset {version},")) && error.contains("from 13 to 20"), "{error}");
    }
    assert!(of(&[]).unwrap().contains("opset 1,"));
}

#[test]
fn a_graph_in_the_style_of_pytorchs_export_gives_the_same_outputs() {
    let exported = as_exported(vgn());
    let parameters = |model: &ModelProto| -> usize {
        model.graph.as_ref().unwrap().initializer.iter().map(TensorProto::elements).sum()
    };
    assert_eq!(parameters(&exported), parameters(&vgn()));
    let (ours, theirs) = (run(vgn(), EXECUTION).unwrap(), run(exported, EXECUTION).unwrap());
    let worst = difference(&ours, &theirs);
    assert!(worst < 1e-5, "differs by {worst}");
}

#[test]
fn outputs_at_single_voxels_equal_those_of_the_whole_maps() {
    let edge = N as i64;
    let volumes = Tensor::rand([2, 1, edge, edge, edge], (Kind::Float, Device::Cpu));
    // Corners, edges, faces and the inside, of both volumes.
    let voxels: Vec<i64> = (0..2 * edge.pow(3)).step_by(37).chain([0, edge.pow(3) - 1, 2 * edge.pow(3) - 1]).collect();
    let index = Tensor::from_slice(&voxels);
    // A network whose width has no head is computed at all voxels.
    let mut whole = vgn();
    let graph = whole.graph.as_mut().unwrap();
    let last = graph.node.iter_mut().find(|node| node.output.contains(&"width".to_owned())).unwrap();
    last.output[2] = "narrow".to_owned();
    let size = whole_numbers("size", &[0, 1, edge, edge, edge]);
    graph.node.extend([size, node("Reshape", &["narrow", "size"], "width", vec![])]);
    for model in [
        vgn(),
        as_exported(vgn()),
        with_axes_as_input(vgn()),
        Architecture::Vgn.build_with(N, Orientation::Axes, 0).unwrap(),
        Architecture::TransformerSmall.build(N, 0).unwrap(),
        whole,
    ] {
        for channels_last in [false, true] {
            let executor = Executor::new(model.clone(), ExecutionOptions { channels_last, ..EXECUTION }).unwrap();
            let maps = executor.forward(&volumes).unwrap();
            let at = executor.forward_at(&volumes, &voxels).unwrap();
            let same = |map: &Tensor, at: &Tensor| {
                let expected = map.permute([0, 2, 3, 4, 1]).reshape([-1, map.size()[1]]).index_select(0, &index);
                let difference = (expected - at.reshape([voxels.len() as i64, -1])).abs().max().double_value(&[]);
                assert!(difference < 1e-5, "differs by {difference}");
            };
            same(&maps.quality, &at.quality);
            same(&maps.rotation, &at.rotation);
            same(&maps.width, &at.width);
        }
    }
}

#[test]
fn bf16_changes_the_outputs_little() {
    for architecture in [Architecture::Vgn, Architecture::TransformerSmall] {
        let model = || architecture.build(N, 0).unwrap();
        let full = run(model(), EXECUTION).unwrap();
        let half = run(model(), ExecutionOptions { bf16: true, channels_last: true, ..EXECUTION }).unwrap();
        let worst = (&full.quality - &half.quality).abs().max().double_value(&[]);
        println!("{architecture}: bf16 moves the quality by {worst:.4}");
        assert!(worst > 0.0 && worst < 0.03, "{architecture}: by {worst}");
    }
}

#[test]
fn gradients_in_bf16_are_reproducible() {
    // At this size one convolution is over 2³ voxels, and reused memory is not zero.
    let edge = N as i64;
    let volumes = Tensor::ones([8, 1, edge, edge, edge], (Kind::Float, Device::Cpu));
    for architecture in [Architecture::Vgn, Architecture::TransformerSmall] {
        let model = architecture.build(N, 0).unwrap();
        let executor = Executor::new(model, ExecutionOptions { bf16: true, channels_last: true, ..EXECUTION }).unwrap();
        let gradients = || {
            drop([1_000, 20_000, 300_000].map(|size| Tensor::full([size], f64::NAN, (Kind::Float, Device::Cpu))));
            let outputs = executor.forward(&volumes).unwrap();
            (outputs.quality.sum(None) + outputs.width.sum(None)).backward();
            let take = |(_, weight): &(String, Tensor)| {
                let gradient = weight.grad().copy();
                weight.shallow_clone().zero_grad();
                gradient
            };
            executor.parameters().iter().map(take).collect::<Vec<_>>()
        };
        let first = gradients();
        assert!(first.iter().all(|gradient| gradient.isfinite().all().int64_value(&[]) == 1), "{architecture}");
        for _ in 0..3 {
            assert!(gradients() == first, "{architecture}");
        }
    }
}

#[test]
fn optimizations_give_the_same_maps_and_gradients() {
    let edge = N as i64;
    let volumes = (Tensor::arange(2 * edge.pow(3), (Kind::Float, Device::Cpu)) * 0.7).sin() * 0.5 + 0.5;
    let volumes = volumes.view([2, 1, edge, edge, edge]);
    // Convolutions before upsampling, and GELUs in one operation.
    let transformer = Architecture::TransformerSmall.build(N, 0).unwrap();
    for (model, channels_last) in [(vgn(), false), (vgn(), true), (transformer, true)] {
        let execution = ExecutionOptions { channels_last, ..EXECUTION };
        for voxels in [None, Some([5, 700, 4100, 8191])] {
            let run = |executor: Executor| {
                let outputs = match voxels {
                    None => executor.forward(&volumes).unwrap(),
                    Some(voxels) => executor.forward_at(&volumes, &voxels).unwrap(),
                };
                let loss = outputs.quality.square().sum(Kind::Float) + outputs.width.square().sum(Kind::Float);
                (loss + outputs.rotation.get(0).sum(Kind::Float)).backward();
                let gradients = executor.parameters().iter().map(|(_, weight)| weight.grad().contiguous());
                gradients.collect::<Vec<_>>()
            };
            let optimized = run(Executor::new(model.clone(), execution).unwrap());
            let written = run(Executor::new(model.clone(), execution).unwrap().without_optimizations());
            for (optimized, written) in optimized.iter().zip(&written) {
                let scale = written.abs().max().double_value(&[]).max(1e-3);
                let apart = (optimized - written).abs().max().double_value(&[]) / scale;
                assert!(apart < 1e-3, "{apart} of {scale}, voxels {voxels:?}, channels last {channels_last}");
            }
        }
    }
}

#[test]
fn an_untrained_model_is_returned_unchanged() {
    for channels_last in [false, true] {
        let executor = Executor::new(vgn(), ExecutionOptions { channels_last, ..EXECUTION }).unwrap();
        assert_eq!(executor.to_model(), vgn());
    }
}

fn refusal(change: impl FnOnce(&mut GraphProto)) -> String {
    let mut model = vgn();
    change(model.graph.as_mut().unwrap());
    run(model, EXECUTION).err().expect("it cannot be executed").to_string()
}

#[test]
fn errors_name_unsupported_operators_and_attributes() {
    let error = refusal(|graph| graph.node[1].op_type = Some("Tan".to_owned()));
    assert!(error.contains("Relu_1") && error.contains("`Tan`"), "{error}");
    let error = refusal(|graph| graph.node[1].domain = Some("com.example".to_owned()));
    assert!(error.contains("Relu_1"), "{error}");
    let error = refusal(|graph| graph.node[0].attribute.push(AttributeProto::string("auto_pad", "SAME_UPPER")));
    assert!(error.contains("Conv_0") && error.contains("`auto_pad`"), "{error}");
    let error = refusal(|graph| {
        let pads = graph.node[0].attribute.iter_mut().find(|a| a.name() == "pads").unwrap();
        pads.ints = vec![2, 2, 2, 1, 1, 1];
    });
    assert!(error.contains("[2, 2, 2] before and [1, 1, 1] after"), "{error}");
    let error = refusal(|graph| {
        let resize = graph.node.iter_mut().find(|node| node.op_type() == "Resize").unwrap();
        resize.attribute[1] = AttributeProto::string("coordinate_transformation_mode", "align_corners");
    });
    assert!(error.contains("Resize") && error.contains("`align_corners`"), "{error}");
    let error = refusal(|graph| graph.node[1].input[0] = "nowhere".to_owned());
    assert!(error.contains("Relu_1") && error.contains("`nowhere`"), "{error}");
    let error = refusal(|graph| graph.initializer[0].dims = vec![16, 1, 125]);
    assert!(error.contains("Conv_0"), "{error}");
    let error = refusal(|graph| {
        graph.node.pop();
    });
    assert!(error.contains("`rotation`"), "{error}");
}

#[test]
fn pooling_windows_follow_onnx_or_are_errors() {
    let pooled = |attributes: Vec<AttributeProto>| {
        let mut model = gpd::gpd(0);
        let nodes = &mut model.graph.as_mut().unwrap().node;
        nodes.truncate(nodes.iter().position(|node| node.op_type() == "MaxPool").unwrap());
        let input = model.graph.as_ref().unwrap().input[0].name().to_owned();
        let pool = node("MaxPool", &[&input], "pooled", attributes);
        model.graph.as_mut().unwrap().node = vec![pool];
        let image = Tensor::arange(9, (Kind::Float, Device::Cpu)).view([1, 1, 3, 3]);
        let pooled = Executor::new(model, EXECUTION)?.output(&image, "pooled")?;
        Ok::<_, ExecuteError>(Vec::<f32>::try_from(pooled.flatten(0, -1)).unwrap())
    };
    let kernel = || AttributeProto::ints("kernel_shape", &[2, 2]);
    let strides = || AttributeProto::ints("strides", &[2, 2]);
    assert_eq!(pooled(vec![kernel()]).unwrap(), [4.0, 5.0, 7.0, 8.0]);
    assert_eq!(pooled(vec![kernel(), strides()]).unwrap(), [4.0]);
    assert_eq!(pooled(vec![kernel(), strides(), AttributeProto::int("ceil_mode", 1)]).unwrap(), [4.0, 5.0, 7.0, 8.0]);
    assert_eq!(pooled(vec![kernel(), strides(), AttributeProto::ints("pads", &[1; 4])]).unwrap(), [0.0, 2.0, 6.0, 8.0]);
    let error = pooled(vec![kernel(), AttributeProto::ints("pads", &[0, 0, 1, 1])]).unwrap_err().to_string();
    assert!(error.contains("`pooled` (MaxPool): a padding of [0, 0] before and [1, 1] after"), "{error}");
    let error = pooled(vec![AttributeProto::ints("kernel_shape", &[2; 3])]).unwrap_err().to_string();
    assert!(error.contains("a window of [2, 2, 2]"), "{error}");
}
