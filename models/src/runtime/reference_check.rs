//! Compares the outputs of a backend with those of the reference.

use grasp::{Maps, Volume};
use nalgebra::Isometry3;

use super::{Network, batch_sizes};
use crate::RuntimeError;

/// Allowed differences from the outputs of ONNX Runtime's CPU kernels in f32, on [`sample`].
///
/// In bf16 the quality of the zoo's networks differs by at most 0.01. A provider that loses an operator or computes
/// another function exceeds these limits by far.
const QUALITY: Limit = Limit { mean: 0.01, largest: 0.2 };
/// In voxels.
const WIDTH: Limit = Limit { mean: 0.1, largest: 4.0 };
/// Half the squared distance between two quaternions, up to sign: 1 − |r·r*| for unit quaternions. Rounding can exchange
/// equivalent rotations of symmetric objects, so only the mean is limited: the largest possible difference is 1.
const ROTATION: Limit = Limit { mean: 0.02, largest: 1.0 };

struct Limit {
    mean: f32,
    largest: f32,
}

/// Describes the first difference beyond the limits, if any, for the batch sizes up to `max_batch`.
pub(super) fn difference(
    network: &mut Network,
    max_batch: usize,
    reference: &mut Network,
) -> Result<Option<String>, RuntimeError> {
    let metadata = network.metadata();
    let (resolution, voxel_size) = (metadata.resolution, metadata.voxel_size);
    // Another volume in a later run, because a recorded graph could repeat the outputs of the first.
    for (run, volume) in [sample(resolution, voxel_size), other_sample(resolution, voxel_size)].iter().enumerate() {
        let expected = reference.infer(&[volume])?;
        let expected = expected.maps(0);
        for size in batch_sizes(max_batch) {
            let got = network.infer(&vec![volume; size])?;
            // The last volume, because an error in the batching shows there.
            if let Some(what) = excess(&got.maps(size - 1), &expected) {
                let batch = if size == 1 { String::new() } else { format!("in a batch of {size}, ") };
                let later = if run == 0 { "" } else { "for a second volume, " };
                return Ok(Some(format!("{later}{batch}{what}")));
            }
        }
    }
    Ok(None)
}

fn excess(got: &Maps, expected: &Maps) -> Option<String> {
    let absolute = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>();
    let differences = [
        ("quality", absolute(got.quality, expected.quality), QUALITY),
        ("width", absolute(got.width, expected.width), WIDTH),
        ("rotation", rotation_differences(got, expected), ROTATION),
    ];
    differences.into_iter().find_map(|(name, differences, limit)| {
        let mean = differences.iter().sum::<f32>() / differences.len().max(1) as f32;
        let largest = differences.iter().copied().fold(0.0, f32::max);
        // With NaN both comparisons are false.
        let agrees = mean <= limit.mean && largest <= limit.largest;
        (!agrees).then(|| {
            format!(
                "`{name}` differs by {mean:.4} on average (limit {}) and by at most {largest:.4} (limit {})",
                limit.mean, limit.largest
            )
        })
    })
}

fn rotation_differences(got: &Maps, expected: &Maps) -> Vec<f32> {
    let voxels = got.quality.len();
    let at = |maps: &Maps, voxel: usize| [0, 1, 2, 3].map(|channel| maps.rotation[channel * voxels + voxel]);
    let difference = |voxel: usize| -> f32 {
        let pairs = || at(got, voxel).into_iter().zip(at(expected, voxel));
        let [same_sign, opposite_sign]: [f32; 2] =
            [pairs().map(|(a, b)| (a - b).powi(2)).sum(), pairs().map(|(a, b)| (a + b).powi(2)).sum()];
        same_sign.min(opposite_sign) / 2.0
    };
    (0..voxels).map(difference).collect()
}

/// [`sample`] mirrored in x.
fn other_sample(resolution: usize, voxel_size: f64) -> Volume {
    let volume = sample(resolution, voxel_size);
    let slice = resolution * resolution;
    let values = volume.values().chunks_exact(slice).rev().flatten().copied().collect();
    let mirrored = Volume::new(resolution, voxel_size, Isometry3::identity(), values);
    mirrored.expect("the values are those of a valid volume")
}

/// The test volume: a ball and a post on a table, seen from above.
pub(super) fn sample(resolution: usize, voxel_size: f64) -> Volume {
    let size = resolution as f64;
    // Signed distance to the nearest surface; lengths in units of the edge.
    let distance = |x: f64, y: f64, z: f64| {
        let table = z - 0.17;
        let ball = ((x - 0.35).powi(2) + (y - 0.4).powi(2) + (z - 0.3).powi(2)).sqrt() - 0.13;
        let post = ((x - 0.68).powi(2) + (y - 0.62).powi(2)).sqrt() - 0.08;
        table.min(ball).min(post.max(z - 0.6))
    };
    let truncation = grasp::TRUNCATION_VOXELS / size;
    let value = |index: usize| {
        let at = |c: usize| (c as f64 + 0.5) / size;
        let (x, y, z) = (index / (resolution * resolution), index / resolution % resolution, index % resolution);
        let distance = distance(at(x), at(y), at(z)) / truncation;
        if distance < -1.0 { 0.0 } else { (distance.min(1.0) as f32 + 1.0) / 2.0 }
    };
    let values = (0..resolution.pow(3)).map(value).collect();
    let volume = Volume::new(resolution, voxel_size, Isometry3::identity(), values);
    volume.expect("metadata has a positive resolution and voxel size, and the values are in [0, 1], not all 0")
}
