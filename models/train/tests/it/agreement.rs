//! Agreement of libtorch with ONNX Runtime.

use std::path::Path;

use grasp::gpd::{CHANNELS, Candidate, Cloud, IMAGE_SIZE, Image};
use grasp::{Maps, SurfacePoint, Volume};
use grasp_models::onnx::ModelProto;
use grasp_models::{Architecture, Classifier, ClassifierKind, Network, Options, Orientation, gpd};
use grasp_train::{ExecutionOptions, Executor};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Device, Tensor, no_grad};

fn volume(seed: u64) -> Volume {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let values = (0..64_000).map(|_| rng.random::<f32>()).collect();
    Volume::new(40, 0.0075, Isometry3::identity(), values).unwrap()
}

/// The largest difference of any output over a batch of two volumes.
fn difference(path: &Path, execution: ExecutionOptions) -> f32 {
    assert!(std::env::var_os("ORT_DYLIB_PATH").is_some(), "ORT_DYLIB_PATH is not set: run the tests by `make test`");
    let volumes = [volume(0), volume(1)];
    let executor = Executor::new(ModelProto::read(path).unwrap(), execution).unwrap();
    let values: Vec<f32> = volumes.iter().flat_map(Volume::values).copied().collect();
    let input = Tensor::from_slice(&values).reshape([2, 1, 40, 40, 40]);
    let torch = no_grad(|| executor.forward(&input)).unwrap();

    let mut network = Network::load(path, &Options { threads: Some(2), ..Options::default() }).unwrap();
    let onnx = network.infer(&volumes.each_ref()).unwrap();
    let mut worst = 0.0_f32;
    for index in 0..2 {
        let Maps { quality, rotation, width } = onnx.maps(index);
        for (onnx, torch) in [(quality, &torch.quality), (rotation, &torch.rotation), (width, &torch.width)] {
            let onnx = Tensor::from_slice(onnx);
            let torch = torch.get(index as i64).flatten(0, -1);
            worst = worst.max((onnx - torch).abs().max().try_into().unwrap());
        }
    }
    worst
}

#[test]
fn every_network_agrees_with_onnx_runtime() {
    let folder = tempfile::tempdir().unwrap();
    let published = Architecture::ALL.map(|architecture| (architecture, Orientation::Quaternion));
    for (architecture, orientation) in published.into_iter().chain([(Architecture::Vgn, Orientation::Axes)]) {
        let path = folder.path().join(format!("{architecture}-{}.onnx", orientation.name()));
        architecture.build_with(40, orientation, 1).unwrap().write(&path).unwrap();
        for channels_last in [false, true] {
            let execution = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last };
            let worst = difference(&path, execution);
            println!("{architecture}, channels last {channels_last}: |libtorch − ONNX Runtime| ≤ {worst:.1e}");
            assert!(worst <= 1e-4, "{architecture} differs by {worst}");
        }
    }
}

#[test]
fn the_classifier_agrees_with_onnx_runtime() {
    assert!(std::env::var_os("ORT_DYLIB_PATH").is_some(), "ORT_DYLIB_PATH is not set: run the tests by `make test`");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gpd.onnx");
    gpd::gpd(1).write(&path).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut image = || {
        let mut within = |range: std::ops::Range<f64>| rng.random_range(range);
        let mut point = || SurfacePoint {
            position: Point3::new(within(-0.02..0.02), within(-0.05..0.05), within(0.0..0.06)),
            normal: Vector3::x(),
        };
        let cloud = Cloud::new((0..300).map(|_| point()).collect::<Vec<_>>());
        Image::new(&cloud, &Candidate { pose: Isometry3::identity(), width: 0.05, point: Point3::origin() })
    };
    let images: Vec<Image> = (0..3).map(|_| image()).collect();
    let pixels: Vec<f32> = images.iter().flat_map(Image::pixels).map(|&value| f32::from(value) / 255.0).collect();

    let execution = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: false };
    let executor = Executor::new(ModelProto::read(&path).unwrap(), execution).unwrap();
    let input = Tensor::from_slice(&pixels).reshape([3, CHANNELS as i64, IMAGE_SIZE as i64, IMAGE_SIZE as i64]);
    let torch = no_grad(|| executor.output(&input, gpd::OUTPUT)).unwrap();
    let torch = Vec::<f32>::try_from(torch.select(1, 1) - torch.select(1, 0)).unwrap();
    let mut onnx = Classifier::load(&path, ClassifierKind::Gpd, &Options::default()).unwrap();
    let onnx = onnx.score(images.len(), |index, values| images[index].write(values)).unwrap();
    assert_ne!(onnx[0], onnx[1], "the images differ");
    for (torch, onnx) in torch.iter().zip(onnx) {
        assert!((torch - onnx).abs() <= 1e-4, "{torch} and {onnx}");
    }
}

/// An external model, such as VGN's released weights, whose three heads are separate convolutions.
#[test]
#[ignore = "needs an external model: set GRASPD_REFERENCE_ONNX to its file"]
fn an_external_model_agrees_with_onnx_runtime() {
    let path = std::env::var_os("GRASPD_REFERENCE_ONNX").expect("GRASPD_REFERENCE_ONNX is not set");
    let execution = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: false };
    let worst = difference(Path::new(&path), execution);
    println!("{}: |libtorch − ONNX Runtime| ≤ {worst:.1e}", Path::new(&path).display());
    assert!(worst <= 1e-4, "differs by {worst}");
}
