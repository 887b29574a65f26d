//! The definitions of the networks, as files.

use std::process::Command;

use grasp_models::onnx::{ModelProto, TensorProto};
use grasp_models::{
    ActivationRange, Architecture, BuildError, Orientation, averaged_over_rotations, build, coarse_evaluator,
    evaluator, gpd, quantized_activations, with_coarse_evaluator, with_full_weights, with_half_weights, with_int8,
};
use prost::Message;

#[test]
fn networks_have_the_published_number_of_parameters() {
    let parameters = |name| {
        let initializers = build(name, 0).unwrap().graph.unwrap().initializer;
        initializers.iter().filter(|tensor| tensor.is_float()).map(TensorProto::elements).sum::<usize>()
    };
    assert_eq!(parameters("vgn"), 313_238, "the number of VGN's released weights");
    // ViT-B's twelve blocks (85,026,816), its final norm, the patches and their positions, and the decoder.
    let blocks = 12 * (3 * 768 * 768 + (768 + 1) * 768 + (768 + 1) * 3072 + (3072 + 1) * 768 + 4 * 768);
    let ends = 2 * 768 + (512 + 1) * 768 + 125 * 768;
    let up = 8 * (768 * 64 + 768 * 32 + 32 * 32 + 768 * 64 + 64 * 32 + 32 * 16);
    let residual = |i: usize, o: usize| 27 * (i * o + o * o) + i * o;
    let decoder = residual(1, 16) + residual(128, 64) + residual(64, 32) + residual(32, 16);
    let heads = 125 * 16 * 6 + 6;
    assert_eq!(parameters("transformer"), blocks + ends + up + decoder + heads);
    assert_eq!((parameters("transformer") as f64 / 1e6).round(), 87.0, "the paper's size, in millions");
    assert!(parameters("transformer-small") < 4_000_000);
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    for architecture in [Architecture::Vgn, Architecture::TransformerSmall] {
        let bytes = |seed| architecture.build(16, seed).unwrap().encode_to_vec();
        assert_eq!(bytes(7), bytes(7));
        assert_ne!(bytes(7), bytes(8));
    }
}

#[test]
fn weights_are_initialised_as_in_pytorch() {
    let model = build("vgn", 1).unwrap();
    let tensor = &model.graph.as_ref().unwrap().initializer[2];
    assert_eq!(tensor.name(), "encoder.1.weight");
    let values = tensor.to_f32().unwrap();
    let bound = 1.0 / (16.0_f32 * 27.0).sqrt();
    let variance = values.iter().map(|v| v * v).sum::<f32>() / values.len() as f32;
    assert!(values.iter().all(|v| v.abs() <= bound));
    assert!((variance / (bound * bound / 3.0) - 1.0).abs() < 0.05, "uniform in ±{bound} has variance bound²/3");
}

#[test]
fn an_unknown_network_or_resolution_is_an_error() {
    let error = build("vng", 0).unwrap_err();
    assert!(matches!(error, BuildError::Name(_)));
    assert!(error.to_string().contains("`vng`") && error.to_string().contains("transformer-small"), "{error}");
    assert!(Architecture::Vgn.build(42, 0).unwrap_err().to_string().contains("42"));
    for resolution in [0, 264] {
        assert_eq!(Architecture::Vgn.build(resolution, 0), Err(BuildError::Resolution(resolution)));
    }
}

#[test]
fn model_files_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("vgn.onnx");
    let model = build("vgn", 3).unwrap();
    model.write(&path).unwrap();
    assert_eq!(ModelProto::read(&path).unwrap(), model);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left behind");

    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = ModelProto::read(&path).unwrap_err().to_string();
    assert!(error.contains("vgn.onnx") && error.contains("cut short"), "{error}");
}

#[test]
fn tensors_are_read_in_every_encoding() {
    let raw = TensorProto::from_f32("x", &[2], &[1.5, -2.0]);
    let typed = TensorProto { raw_data: None, float_data: vec![1.5, -2.0], ..raw.clone() };
    assert_eq!(raw.to_f32().unwrap(), typed.to_f32().unwrap());
    let halves = TensorProto { data_type: Some(10), raw_data: Some(vec![0x00, 0x3e, 0x00, 0xc0]), ..raw.clone() };
    assert_eq!(halves.to_f32().unwrap(), [1.5, -2.0]);
    let typed = TensorProto { raw_data: None, int32_data: vec![0x3e00, 0xc000], ..halves.clone() };
    assert_eq!(typed.to_f32().unwrap(), [1.5, -2.0]);
    assert_eq!(TensorProto::from_i64("n", &[2], &[-1, 7]).to_i64().unwrap(), [-1, 7]);

    let short = TensorProto { dims: vec![3], ..raw.clone() };
    assert!(short.to_f32().unwrap_err().to_string().contains("holds 2 values"));
    assert!(raw.to_i64().is_err());
    let elsewhere = TensorProto { data_location: Some(1), ..raw };
    assert!(elsewhere.to_f32().unwrap_err().to_string().contains("another file"));
}

#[test]
fn weights_are_stored_as_f16_and_restored() {
    let model = build("vgn", 5).unwrap();
    let halves = with_half_weights(&model).unwrap();
    let (before, after) = (model.encode_to_vec().len(), halves.encode_to_vec().len());
    assert!(after < before * 55 / 100, "{after} of {before} bytes");
    assert_eq!(with_half_weights(&halves).unwrap(), halves, "a second conversion changes nothing");
    let restored = with_full_weights(&halves).unwrap();
    let (graph, original) = (restored.graph.as_ref().unwrap(), model.graph.as_ref().unwrap());
    assert_eq!(graph.node, original.node);
    for (weight, original) in graph.initializer.iter().zip(&original.initializer) {
        assert_eq!((weight.name(), &weight.dims), (original.name(), &original.dims));
        if original.is_float() {
            let pairs = weight.to_f32().unwrap().into_iter().zip(original.to_f32().unwrap());
            assert!(pairs.into_iter().all(|(half, full)| (half - full).abs() <= full.abs() / 2048.0 + 1e-7));
        }
    }
    let mut large = model.clone();
    let weight = &mut large.graph.as_mut().unwrap().initializer[0];
    weight.set_f32(&vec![1e5; weight.elements()]);
    let kept = with_half_weights(&large).unwrap().graph.unwrap().initializer[0].clone();
    assert_eq!(kept, large.graph.unwrap().initializer[0], "weights beyond the range of f16 stay f32");
}

#[test]
fn the_onnx_checker_accepts_every_network() {
    let python = std::env::var("GRASPD_PYTHON").expect("GRASPD_PYTHON is not set: run the tests by `make test`");
    let folder = tempfile::tempdir().unwrap();
    let networks = Architecture::ALL.map(|architecture| (architecture.name(), architecture.build(40, 0).unwrap()));
    let vgn = build("vgn", 0).unwrap();
    let half = with_half_weights(&vgn).unwrap();
    let ranges =
        quantized_activations(&vgn).into_iter().map(|name| (name, ActivationRange { low: -1.0, high: 2.0 })).collect();
    let int8 = with_int8(&vgn, &ranges).unwrap();
    let axes = Architecture::Vgn.build_with(40, Orientation::Axes, 0).unwrap();
    let averaged = averaged_over_rotations(&axes).unwrap();
    let evaluators = with_coarse_evaluator(&evaluator(0), &coarse_evaluator(0));
    let others = [
        ("gpd", gpd::gpd(0)),
        ("evaluators", evaluators),
        ("half", half),
        ("int8", int8),
        ("axes", axes),
        ("averaged", averaged),
    ];
    for (name, model) in networks.into_iter().chain(others) {
        let path = folder.path().join(format!("{name}.onnx"));
        model.write(&path).unwrap();
        let script = "import onnx, sys; onnx.checker.check_model(sys.argv[1], full_check=True)";
        let output = Command::new(&python).args(["-c", script]).arg(&path).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    }
}
