//! Completion of shapes: a head that predicts which voxels are inside an object, seen or not. It reads the features of
//! the output heads, so that these represent whole objects. GIGA (Jiang et al., "Synergies Between Affordance and
//! Geometry", RSS 2021) trains grasps and occupancy together in this way.
//!
//! The head is used in training only, and is not part of the model file.

use grasp_data::Occupancy;
use grasp_models::onnx::GraphProto;
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Reduction, TchError, Tensor};

use crate::augment::Transform;
use crate::pointwise::{PaddedFeatures, head_convolutions, largest_kernel};

/// Edge of the kernel, as in the output heads. With 3 and half of the voxels a trained network was no better than without
/// this head (models/ablations.md).
const KERNEL: usize = 5;

/// Voxels per volume: this many inside objects, and as many anywhere. Three in 100 voxels are inside an object.
const VOXELS: usize = 256;

/// Names of the parameters.
const WEIGHT: &str = "occupancy.weight";
const BIAS: &str = "occupancy.bias";

/// The convolution of the head.
pub(crate) struct OccupancyHead {
    /// Name of the features in the graph.
    features: String,
    weight: Tensor,
    bias: Tensor,
}

impl OccupancyHead {
    /// A head with random weights for the features of a graph's output heads; `None` if the output heads do not read the
    /// same features, or with smaller kernels. The initialisation is that of the other convolutions.
    pub fn new(graph: &GraphProto, seed: u64) -> Option<Self> {
        let heads = head_convolutions(graph);
        let largest_kernel = largest_kernel(graph, &heads);
        let heads: Vec<_> = heads.into_iter().map(|index| &graph.node[index]).collect();
        let (features, weight) = (heads.first()?.input.first()?, heads.first()?.input.get(1)?);
        let channels = *graph.stored(weight)?.dims.get(1)?;
        if heads.iter().any(|head| head.input.first() != Some(features)) || largest_kernel < KERNEL as i64 {
            return None;
        }
        let count = channels as usize * KERNEL.pow(3);
        let bound = 1.0 / (count as f32).sqrt();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let values: Vec<f32> = (0..count).map(|_| rng.random_range(-bound..=bound)).collect();
        let edge = KERNEL as i64;
        let weight = Tensor::from_slice(&values).reshape([1, channels, edge, edge, edge]);
        Some(Self { features: features.clone(), weight, bias: Tensor::from_slice(&[0f32]) })
    }

    /// The parameters with their names.
    pub fn parameters(&self) -> [(&'static str, &Tensor); 2] {
        [(WEIGHT, &self.weight), (BIAS, &self.bias)]
    }

    /// The same head with parameters changed by `change`.
    pub fn map(self, change: impl Fn(&Tensor) -> Tensor) -> Self {
        Self { weight: change(&self.weight), bias: change(&self.bias), ..self }
    }

    /// Name of the features in the graph.
    pub fn features(&self) -> &str {
        &self.features
    }

    /// The logits at voxels, given as flat indices into `[batch, N, N, N]`.
    pub fn logits(&self, features: &PaddedFeatures, voxels: &[i64]) -> Result<Tensor, TchError> {
        features.convolution(&self.weight, Some(&self.bias), voxels)?.f_reshape([-1])
    }
}

/// Voxels of a batch with their occupancy. The fields have one element per voxel.
#[derive(Debug, Default)]
pub(crate) struct OccupancyTargets {
    /// Flat index into `[batch, N, N, N]`.
    voxels: Vec<i64>,
    /// 1 inside an object, else 0.
    labels: Vec<f32>,
}

impl OccupancyTargets {
    /// Adds random voxels of volume `index` of the batch. `n` is N.
    pub fn add(&mut self, index: usize, occupancy: &Occupancy, transform: Transform, n: usize, rng: &mut impl Rng) {
        let occupied: Vec<usize> = occupancy.occupied().collect();
        for place in 0..2 * VOXELS {
            let anywhere = rng.random_range(0..n.pow(3));
            let voxel = occupied.choose(rng).copied().filter(|_| place < VOXELS).unwrap_or(anywhere);
            let [x, y, z] = [voxel / (n * n), voxel / n % n, voxel % n];
            // Voxels that are shifted out of the volume are left out.
            if let Some([x, y, z]) = transform.voxel([x, y, z], n) {
                self.voxels.push((index * n.pow(3) + (x * n + y) * n + z) as i64);
                self.labels.push(if occupancy.contains(voxel) { 1.0 } else { 0.0 });
            }
        }
    }

    /// The voxels: flat indices into `[batch, N, N, N]`.
    pub fn voxels(&self) -> &[i64] {
        &self.voxels
    }

    /// The sum of the binary cross-entropies of logits at [these voxels](Self::voxels).
    pub fn loss(&self, logits: &Tensor) -> Result<Tensor, TchError> {
        let labels = Tensor::f_from_slice(&self.labels)?.f_to_device(logits.device())?;
        logits.f_binary_cross_entropy_with_logits(&labels, None::<&Tensor>, None::<&Tensor>, Reduction::Sum)
    }
}
