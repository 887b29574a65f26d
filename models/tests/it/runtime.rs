//! The networks in ONNX Runtime. `ORT_DYLIB_PATH` must name its library, which `make test` sets.

use std::fs;
use std::path::{Path, PathBuf};

use grasp::gpd::{Candidate, Cloud, Image};
use grasp::{SurfacePoint, Volume};
use grasp_models::onnx::{Dimension, ModelProto, StringStringEntryProto, ValueInfoProto};
use grasp_models::{
    Architecture, Backend, Classifier, ClassifierKind, Network, Options, Orientation, Precision, Provider,
    RotationAverageError, RuntimeError, averaged_over_rotations, build, gpd, init, with_published_heads,
};
use nalgebra::{Isometry3, Point3, Quaternion, UnitQuaternion, Vector3};
use tempfile::TempDir;

fn save(model: &ModelProto) -> (TempDir, PathBuf) {
    assert!(std::env::var_os("ORT_DYLIB_PATH").is_some(), "ORT_DYLIB_PATH is not set: run the tests by `make test`");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("network.onnx");
    model.write(&path).unwrap();
    (folder, path)
}

fn load(model: &ModelProto) -> Network {
    let (_folder, path) = save(model);
    Network::load(&path, &Options { threads: Some(2), ..Options::default() }).unwrap()
}

fn volume(resolution: usize, seed: usize) -> Volume {
    let values = (0..resolution.pow(3)).map(|i| ((i * 7919 + seed * 104_729) % 1009) as f32 / 1009.0).collect();
    Volume::new(resolution, 0.3 / resolution as f64, Isometry3::identity(), values).unwrap()
}

#[test]
fn the_version_of_the_library_is_reported() {
    let (_folder, _) = save(&build("vgn", 0).unwrap());
    let info = init().unwrap();
    let numbers: Vec<u32> = info.version.split('.').map(|part| part.parse().unwrap()).collect();
    assert!(numbers[0] == 1 && numbers[1] >= 24, "{info:?}");
}

#[test]
fn vgn_outputs_qualities_unit_quaternions_and_widths() {
    let mut network = load(&build("vgn", 0).unwrap());
    assert_eq!(network.metadata().name, "vgn");
    let output = network.infer(&[&volume(40, 0)]).unwrap();
    assert_eq!(output.len(), 1);
    let maps = output.maps(0);
    let voxels = 40 * 40 * 40;
    assert_eq!([maps.quality.len(), maps.rotation.len(), maps.width.len()], [voxels, 4 * voxels, voxels]);
    assert!(maps.quality.iter().all(|q| (0.0..=1.0).contains(q)));
    assert!(maps.width.iter().all(|w| w.is_finite()));
    for voxel in 0..voxels {
        let length: f32 = (0..4).map(|c| maps.rotation[c * voxels + voxel].powi(2)).sum();
        assert!((length - 1.0).abs() < 1e-4, "voxel {voxel}: |r|² = {length}");
    }
}

#[test]
fn separate_heads_give_the_same_outputs_as_the_merged_convolution() {
    let volume = volume(40, 3);
    for (name, orientation) in [("vgn", Orientation::Axes), ("transformer-small", Orientation::Quaternion)] {
        let model = name.parse::<Architecture>().unwrap().build_with(40, orientation, 5).unwrap();
        let published = with_published_heads(&model).unwrap();
        let convolutions = |model: &ModelProto| {
            model.graph.as_ref().unwrap().node.iter().filter(|node| node.op_type() == "Conv").count()
        };
        assert_eq!(convolutions(&published), convolutions(&model) + 2);
        let [mut together, mut apart] = [load(&model), load(&published)];
        let (together, apart) = (together.infer(&[&volume]).unwrap(), apart.infer(&[&volume]).unwrap());
        let (together, apart) = (together.maps(0), apart.maps(0));
        for (a, b) in
            [(together.quality, apart.quality), (together.rotation, apart.rotation), (together.width, apart.width)]
        {
            let largest = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(largest < 1e-4, "{name}: {largest}");
        }
    }
    assert!(with_published_heads(&gpd::gpd(0)).is_none());
}

/// The rotation that a network which regresses axes gives for these six numbers.
fn rotation_of(axes: [f32; 6]) -> UnitQuaternion<f64> {
    let mut model = Architecture::Vgn.build_with(8, Orientation::Axes, 0).unwrap();
    for weight in &mut model.graph.as_mut().unwrap().initializer {
        let mut values = vec![0.0; weight.elements()];
        if weight.name() == "heads.bias" {
            values[1..7].copy_from_slice(&axes);
        }
        weight.set_f32(&values);
    }
    let mut network = load(&model);
    let output = network.infer(&[&volume(8, 0)]).unwrap();
    let [x, y, z, w] = [0, 1, 2, 3].map(|channel| f64::from(output.maps(0).rotation[channel * 8 * 8 * 8]));
    let quaternion = Quaternion::new(w, x, y, z);
    assert!((quaternion.norm() - 1.0).abs() < 1e-5, "{quaternion}");
    UnitQuaternion::from_quaternion(quaternion)
}

/// The volume rotated by 90° about the vertical through its middle: the value at (x, y) moves to (−y, x).
fn rotated(volume: &Volume) -> Volume {
    let n = volume.resolution();
    let value = |index: usize| {
        let (x, y, z) = (index / (n * n), index / n % n, index % n);
        volume.values()[(y * n + n - 1 - x) * n + z]
    };
    Volume::new(n, volume.voxel_size(), Isometry3::identity(), (0..n.pow(3)).map(value).collect()).unwrap()
}

#[test]
fn the_output_of_a_rotation_average_rotates_with_the_volume() {
    const N: usize = 16;
    let single = Architecture::Vgn.build_with(N, Orientation::Axes, 3).unwrap();
    let mut network = load(&averaged_over_rotations(&single).unwrap());
    let (volume, other) = (volume(N, 1), volume(N, 2));
    let rotated = rotated(&volume);
    let output = network.infer(&[&volume, &rotated, &other]).unwrap();
    let (before, after) = (output.maps(0), output.maps(1));
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let voxels = N.pow(3);
    let rotation = |map: &[f32], voxel: usize| {
        let [x, y, z, w] = [0, 1, 2, 3].map(|channel| f64::from(map[channel * voxels + voxel]));
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
    };
    for voxel in 0..voxels {
        let (x, y, z) = (voxel / (N * N), voxel / N % N, voxel % N);
        let from = (y * N + N - 1 - x) * N + z;
        assert!((before.quality[from] - after.quality[voxel]).abs() < 1e-5);
        assert!((before.width[from] - after.width[voxel]).abs() < 1e-4);
        let (expected, got) = (quarter * rotation(before.rotation, from), rotation(after.rotation, voxel));
        let same_hand = expected * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
        let angle = got.angle_to(&expected).min(got.angle_to(&same_hand));
        assert!(angle < 1e-2, "voxel {voxel}: {angle}");
    }
    let mut single = load(&single);
    let alone = single.infer(&[&volume, &rotated]).unwrap();
    let difference = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(
        difference(alone.maps(0).quality, before.quality) > 1e-4,
        "the output of the network alone does not rotate exactly"
    );

    let quaternions = build("vgn", 0).unwrap();
    assert_eq!(averaged_over_rotations(&quaternions), Err(RotationAverageError::NotAxes));
    let averaged = averaged_over_rotations(&Architecture::Vgn.build_with(N, Orientation::Axes, 3).unwrap()).unwrap();
    assert_eq!(averaged_over_rotations(&averaged), Err(RotationAverageError::Already));
}

#[test]
fn regressed_axes_are_converted_to_their_rotation() {
    for approach in [[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [-0.6, 0.64, -0.48], [0.0, 1.0, 0.0], [0.8, -0.36, 0.48]] {
        let [x, y, z] = approach;
        // Only the ratio of the components has an effect.
        let given = [-3.0 * z, 3.0 * x, 3.0 * y];
        let rotation =
            |turn: [f32; 2], level: f32| rotation_of([given[0], given[1], given[2], turn[0], turn[1], level]);
        let closing = |turn, level| rotation(turn, level) * Vector3::y();
        let approach = Vector3::new(f64::from(x), f64::from(y), f64::from(z));
        let along = |a: Vector3<f64>, b: Vector3<f64>| (a.dot(&b).abs() - 1.0).abs() < 1e-3;
        let across = |a: Vector3<f64>, b: Vector3<f64>| a.dot(&b).abs() < 2e-3;
        for turn in [[1.0, 0.02], [0.5, 0.5], [-0.7, 0.1], [0.2, -0.9]] {
            assert!((rotation(turn, 0.0) * Vector3::z() - approach).norm() < 1e-5, "{approach} turned by {turn:?}");
            assert!(across(closing(turn, 0.0), closing(turn.map(|t| -t), 0.0)), "the opposite direction closes at 90°");
        }
        // Half the angle: the closing lines of directions at 90° are at 45°.
        let cosine = closing([1.0, 0.0], 0.0).dot(&closing([0.0, 1.0], 0.0)).abs();
        assert!((cosine - 0.5_f64.sqrt()).abs() < 1e-5, "{cosine}");
        if x != 0.0 || y != 0.0 {
            let level = Vector3::z().cross(&approach).normalize();
            assert!(
                along(closing([1e-3, 2e-3], 9.0), level) && across(closing([1e-3, 2e-3], -9.0), level),
                "{approach}"
            );
        }
    }
    let down = |turn| rotation_of([1.0, 0.0, 0.0, turn, 1e-3, 0.0]) * Vector3::y();
    assert!((down(1.0).y.abs() - 1.0).abs() < 1e-5 && (down(-1.0).x.abs() - 1.0).abs() < 1e-3, "from above");
}

#[test]
fn a_batch_gives_the_same_outputs_as_single_volumes() {
    for architecture in Architecture::ALL {
        let mut network = load(&architecture.build(16, 0).unwrap());
        let volumes = [0, 1, 2].map(|seed| volume(16, seed));
        let alone: Vec<Vec<f32>> = volumes
            .iter()
            .map(|volume| {
                let output = network.infer(&[volume]).unwrap();
                let maps = output.maps(0);
                [maps.quality, maps.rotation, maps.width].concat()
            })
            .collect();
        let output = network.infer(&volumes.each_ref()).unwrap();
        assert_eq!(output.len(), 3);
        for (index, alone) in alone.iter().enumerate() {
            let maps = output.maps(index);
            let together = [maps.quality, maps.rotation, maps.width].concat();
            let worst = together.iter().zip(alone).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst <= 1e-4, "{architecture}: volume {index} differs by {worst}");
        }
        assert_ne!(alone[0], alone[1], "other volumes have other maps");
    }
}

#[test]
fn repeated_runs_give_the_same_outputs() {
    let mut network = load(&Architecture::Vgn.build(16, 0).unwrap());
    let first = network.infer(&[&volume(16, 0)]).unwrap().maps(0).quality.to_vec();
    let other = network.infer(&[&volume(16, 1)]).unwrap().maps(0).quality.to_vec();
    assert_ne!(first, other, "another volume has another output");
    network.fill(&[&volume(16, 0)]).unwrap();
    assert_eq!(network.run(1).unwrap().maps(0).quality, first);
}

#[test]
fn an_empty_batch_or_another_resolution_is_an_error() {
    let mut network = load(&Architecture::Vgn.build(16, 0).unwrap());
    assert!(matches!(network.infer(&[]), Err(RuntimeError::EmptyBatch)));
    let error = network.infer(&[&volume(8, 0)]).err().unwrap().to_string();
    assert_eq!(error, "resolution is 8, the model `vgn` needs 16");
}

fn refusal(change: impl FnOnce(&mut ModelProto)) -> String {
    let mut model = Architecture::Vgn.build(8, 0).unwrap();
    change(&mut model);
    let (_folder, path) = save(&model);
    let error = Network::load(&path, &Options::default()).err().expect("it does not fit").to_string();
    assert!(error.contains("network.onnx"), "{error}");
    error
}

#[test]
fn a_file_with_another_signature_is_an_error() {
    let output = |index: usize| {
        move |model: &mut ModelProto| {
            model.graph.as_mut().unwrap().output.remove(index);
        }
    };
    assert!(refusal(output(2)).contains("`width` is missing"));
    let swap = |model: &mut ModelProto| {
        let graph = model.graph.as_mut().unwrap();
        for name in graph.node.iter_mut().flat_map(|node| &mut node.output) {
            match name.as_str() {
                "rotation" => "width".clone_into(name),
                "width" => "rotation".clone_into(name),
                _ => {}
            }
        }
        graph.output[1].r#type = None;
        graph.output[2].r#type = None;
    };
    assert!(refusal(swap).contains("rotation"));
    let renamed = |model: &mut ModelProto| {
        let graph = model.graph.as_mut().unwrap();
        graph.input[0].name = Some("grid".to_owned());
        graph.node[0].input[0] = "grid".to_owned();
    };
    assert!(refusal(renamed).contains("unexpected input `grid`"));
    let lying = |model: &mut ModelProto| {
        let property = model.metadata_props.iter_mut().find(|p| p.key() == "graspd.resolution").unwrap();
        property.value = Some("16".to_owned());
    };
    assert!(refusal(lying).contains("N is 16 in the metadata and 8 in the input"));
    let large = |model: &mut ModelProto| {
        let graph = model.graph.as_mut().unwrap();
        for (value, channels) in graph.input.iter_mut().chain(&mut graph.output).zip([1, 1, 4, 1]) {
            let edges = [264; 3].map(Dimension::size);
            let shape = [Dimension::named("batch"), Dimension::size(channels)].into_iter().chain(edges).collect();
            *value = ValueInfoProto::tensor(value.name(), shape);
        }
    };
    assert!(refusal(large).contains("resolution is 264, must be from 1 to 256"));
    let one_by_one = |model: &mut ModelProto| {
        let graph = model.graph.as_mut().unwrap();
        graph.input[0] = ValueInfoProto::tensor("tsdf", [1, 1, 8, 8, 8].map(Dimension::size).to_vec());
    };
    assert!(refusal(one_by_one).contains("`tsdf` has a fixed batch size of 1"));
    let split = |model: &mut ModelProto| {
        let tensor = &mut model.graph.as_mut().unwrap().initializer[0];
        tensor.data_location = Some(1);
        let (key, value) = (Some("location".to_owned()), Some("network.onnx.data".to_owned()));
        tensor.external_data = vec![StringStringEntryProto { key, value }];
    };
    assert!(refusal(split).contains("the weights are in a second file, `network.onnx.data`; save both as one file"));
}

#[test]
fn a_truncated_file_is_an_error() {
    let (_folder, path) = save(&build("vgn", 0).unwrap());
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = Network::load(&path, &Options::default()).err().unwrap().to_string();
    assert!(error.contains("network.onnx") && error.contains("truncated"), "{error}");
    let error = Network::load(Path::new("nowhere.onnx"), &Options::default()).err().unwrap().to_string();
    assert!(error.starts_with("nowhere.onnx: No such file"), "{error}");
}

fn images(count: u64) -> Vec<Image> {
    let point = |i: u64| SurfacePoint {
        position: Point3::new(0.0, (i % 7) as f64 * 0.01 - 0.03, (i % 11) as f64 * 0.005),
        normal: Vector3::y(),
    };
    let candidate = Candidate { pose: Isometry3::identity(), width: 0.04, point: Point3::origin() };
    (0..count).map(|seed| Image::new(&Cloud::new((0..20).map(|i| point(i * (seed + 3)))), &candidate)).collect()
}

#[test]
fn a_classifier_scores_images_independently() {
    let (_folder, path) = save(&gpd::gpd(0));
    let mut classifier = Classifier::load(&path, ClassifierKind::Gpd, &Options::default()).unwrap();
    let images = images(40);
    let together = classifier.score(images.len(), |index, values| images[index].write(values)).unwrap();
    assert_eq!(together.len(), images.len());
    assert!(together.iter().any(|score| (score - together[0]).abs() > 1e-5), "other images have other scores");
    for (image, together) in images.iter().zip(together) {
        let alone = classifier.score(1, |_, values| image.write(values)).unwrap();
        assert!((alone[0] - together).abs() < 1e-5);
    }
    assert_eq!(classifier.score(0, |_, _| ()).unwrap(), Vec::<f32>::new());
}

#[test]
fn weights_may_be_listed_among_the_inputs() {
    let mut model = build("vgn", 0).unwrap();
    let graph = model.graph.as_mut().unwrap();
    for weight in &graph.initializer {
        let dims = weight.dims.iter().map(|&edge| Dimension::size(edge)).collect();
        graph.input.push(ValueInfoProto::tensor(weight.name(), dims));
    }
    let (_folder, path) = save(&model);
    Network::load(&path, &Options::default()).unwrap();
}

#[test]
fn a_network_is_not_loaded_as_a_classifier_nor_a_classifier_as_a_network() {
    let (_folder, path) = save(&build("vgn", 0).unwrap());
    let error = Classifier::load(&path, ClassifierKind::Gpd, &Options::default()).err().unwrap().to_string();
    assert!(error.contains("network.onnx: found `tsdf` instead of `images`; a classifier has the input"), "{error}");
    let (_folder, path) = save(&gpd::gpd(0));
    let error = Network::load(&path, &Options::default()).err().unwrap().to_string();
    assert!(error.contains("unexpected input `images`"), "{error}");
    // Small enough to be shipped.
    assert!(fs::metadata(&path).unwrap().len() < 3_000_000);
}

#[test]
fn a_network_runs_on_the_requested_backend() {
    let (_folder, path) = save(&build("vgn", 0).unwrap());
    let reference = Network::load(&path, &Options::default()).unwrap();
    assert_eq!(reference.backend(), Backend::REFERENCE);
    let auto = Network::load(&path, &Options::auto(2)).unwrap().backend();
    let explicit = Options {
        threads: Some(2),
        provider: Some(auto.provider),
        precision: Some(auto.precision),
        ..Options::default()
    };
    assert_eq!(
        Network::load(&path, &explicit).unwrap().backend(),
        auto,
        "the backend that `auto` selects can be requested"
    );

    let refused = |options: Options| Network::load(&path, &options).err().unwrap().to_string();
    let card = refused(Options { provider: Some(Provider::TensorRt), ..Options::default() });
    assert!(card.contains("network.onnx") && card.contains("provider `tensorrt` not found"), "{card}");
    let int8 = refused(Options { precision: Some(Precision::Int8), ..Options::default() });
    assert!(int8.contains("not an int8 model"), "{int8}");
    let half = refused(Options { precision: Some(Precision::Fp16), ..Options::default() });
    assert!(half.contains("`cpu` does not support fp16"), "{half}");
}

/// The library that `make` downloads on x86-64 Linux has OpenVINO.
#[test]
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
fn openvino_outputs_match_the_reference() {
    let (_folder, path) = save(&Architecture::Vgn.build_with(40, Orientation::Axes, 0).unwrap());
    let volumes = [volume(40, 1), volume(40, 2), volume(40, 3)];
    let mut reference = Network::load(&path, &Options::default()).unwrap();
    let precisions = [(Precision::Fp32, 1e-4), (Precision::Bf16, 0.02)];
    for (precision, tolerance) in precisions {
        let provider = Some(Provider::OpenVino);
        let options =
            Options { threads: Some(2), provider, precision: Some(precision), max_batch: 3, ..Options::default() };
        let mut network = match Network::load(&path, &options) {
            Ok(network) => network,
            // Older processors have no bf16 instructions.
            Err(error) if precision == Precision::Bf16 && error.to_string().contains("does not support bf16") => {
                break;
            }
            Err(error) => panic!("{error}"),
        };
        assert_eq!(network.backend(), Backend { provider: Provider::OpenVino, precision, cuda_graph: false });
        for batch in [1, 3, 2, 1] {
            let batch: Vec<&Volume> = volumes.iter().take(batch).collect();
            let (got, expected) = (network.infer(&batch).unwrap(), reference.infer(&batch).unwrap());
            for index in 0..batch.len() {
                let (got, expected) = (got.maps(index).quality, expected.maps(index).quality);
                let largest = got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(largest < tolerance, "{precision}: {largest}");
                assert!(precision == Precision::Fp32 || largest > 0.0, "bf16 rounds");
            }
        }
        let error = network.infer(&[&volumes[0]; 4]).err().unwrap().to_string();
        assert_eq!(error, "the batch has 4 volumes, the network was loaded for at most 3");
    }
}
