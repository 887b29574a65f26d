//! Conformance of every provider and precision: for each shipped network, the outputs must match those of ONNX Runtime's
//! CPU kernels in fp32, on several scenes and batch sizes. `ORT_DYLIB_PATH` must name ONNX Runtime's library; `make test`
//! sets it. Providers that this machine does not have are listed in the test's output.

use grasp::{Maps, Volume};
use grasp_models::{Backend, BackendError, LoadReason, Network, Options, Precision, Provider};

use crate::scenes;

const PROVIDERS: [Provider; 4] = [Provider::Cpu, Provider::OpenVino, Provider::Cuda, Provider::TensorRt];
const PRECISIONS: [Precision; 3] = [Precision::Fp32, Precision::Bf16, Precision::Fp16];
const BATCHES: [usize; 2] = [1, 3];

/// Limits on the differences from the reference.
struct Limits {
    /// Largest difference in any voxel.
    quality: f32,
    /// Mean difference where the quality is at least 0.5, voxels.
    width: f32,
    /// Mean angle where the quality is at least 0.5, degrees.
    rotation: f32,
}

fn limits(precision: Precision) -> Limits {
    match precision {
        // Over an empty table the feature maps of a transformer are nearly constant. The instance normalization then sums
        // 64,000 equal values in f32: against f64, ONNX Runtime's kernel is off by 2e-4 and OpenVINO's by 1e-3.
        Precision::Fp32 => Limits { quality: 3e-3, width: 0.005, rotation: 0.5 },
        Precision::Fp16 => Limits { quality: 0.02, width: 0.05, rotation: 3.0 },
        Precision::Bf16 | Precision::Int8 => Limits { quality: 0.12, width: 0.3, rotation: 10.0 },
    }
}

/// Backends that are known not to conform, with the network's name and the reason. An entry whose backend conforms is
/// an error, so the list stays short.
const IGNORED: [(&str, Provider, Precision, &str); 0] = [];

#[test]
fn every_available_backend_matches_the_reference_on_every_shipped_network() {
    let scenes = scenes::all();
    let volumes: Vec<&Volume> = scenes.iter().map(|(_, volume)| volume).collect();
    let mut failures = Vec::new();
    for path in scenes::shipped(".") {
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let mut reference = Network::load(&path, &Options { max_batch: volumes.len(), ..Options::default() }).unwrap();
        let expected = reference.infer(&volumes).unwrap();
        for (provider, precision) in PROVIDERS.into_iter().flat_map(|p| PRECISIONS.map(|precision| (p, precision))) {
            let backend = Backend { provider, precision, cuda_graph: false };
            let few = Options { threads: Some(2), max_batch: 3, cuda_graphs: false, ..Options::default() };
            let options = Options { provider: Some(provider), precision: Some(precision), ..few };
            let mut network = match Network::load(&path, &options) {
                Ok(network) => network,
                Err(error) if is_unavailable(&error.reason) => {
                    println!("{name} with {backend}: not available");
                    continue;
                }
                Err(error) => {
                    failures.push(format!("{name} with {backend}: {error}"));
                    continue;
                }
            };
            assert_eq!(network.backend(), backend);
            let mut found = Vec::new();
            for batch in BATCHES {
                for (index, volumes) in volumes.windows(batch).enumerate() {
                    let got = network.infer(volumes).unwrap();
                    for offset in 0..batch {
                        let scene = scenes[index + offset].0;
                        let differences = differences(&got.maps(offset), &expected.maps(index + offset), precision);
                        found.extend(differences.into_iter().map(|what| format!("{scene}, batch of {batch}: {what}")));
                    }
                }
            }
            let ignored = IGNORED.iter().find(|(n, p, q, _)| (*n, *p, *q) == (&name, provider, precision));
            match (ignored, found.is_empty()) {
                (None, true) => println!("{name} with {backend}: conforms"),
                (None, false) => failures.push(format!("{name} with {backend}: {}", found.join("; "))),
                (Some((.., reason)), false) => println!("{name} with {backend}: ignored: {reason}"),
                (Some(_), true) => failures.push(format!("{name} with {backend} conforms: remove it from IGNORED")),
            }
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

fn is_unavailable(reason: &LoadReason) -> bool {
    matches!(reason, LoadReason::Backend(BackendError::Provider { .. } | BackendError::Precision { .. }))
}

fn differences(got: &Maps, expected: &Maps, precision: Precision) -> Vec<String> {
    let limits = limits(precision);
    let voxels = expected.quality.len();
    let graspable: Vec<usize> = (0..voxels).filter(|&voxel| expected.quality[voxel] >= 0.5).collect();
    let mean = |difference: &dyn Fn(usize) -> f32| {
        graspable.iter().copied().map(difference).sum::<f32>() / graspable.len().max(1) as f32
    };
    let angle = |voxel: usize| {
        let dot: f32 = (0..4).map(|c| got.rotation[c * voxels + voxel] * expected.rotation[c * voxels + voxel]).sum();
        2.0 * dot.abs().min(1.0).acos().to_degrees()
    };
    let quality = got.quality.iter().zip(expected.quality).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let quantities = [
        ("quality", quality, limits.quality),
        ("width", mean(&|voxel| (got.width[voxel] - expected.width[voxel]).abs()), limits.width),
        ("rotation", mean(&angle), limits.rotation),
    ];
    let over = quantities.into_iter().filter(|(_, difference, limit)| difference.is_nan() || difference > limit);
    over.map(|(what, difference, limit)| format!("{what} differs by {difference} (limit {limit})")).collect()
}
