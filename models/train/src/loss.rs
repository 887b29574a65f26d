//! The training loss: the paper, section "Training". The weight of the width and the symmetry of the gripper are those
//! of VGN's code, on which the paper builds.

use grasp::VoxelOrigin;
use grasp_data::{DISTINCT_YAWS, Trial};
use nalgebra::UnitQuaternion;
use tch::{Device, Kind, Reduction, TchError, Tensor};
use thiserror::Error;

use crate::executor::NetworkOutputs;
use crate::training_settings::QualityTarget;

/// Weight of the width's squared error, voxels², relative to the other two parts. The paper's equation omits it.
const WIDTH_WEIGHT: f64 = 0.01;

/// The labelled voxels of a batch with their targets. The fields have one element per voxel.
#[derive(Debug, Default)]
pub struct Targets {
    /// Flat index into `[batch, N, N, N]`.
    voxels: Vec<i64>,
    /// 1 for a success, 0 for a failure; for a teacher's output its quality.
    labels: Vec<f32>,
    /// Target of the quality: the label, or the success rate of the repetitions.
    qualities: Vec<f32>,
    /// The valid rotations, quaternions x y z w, each also rotated by 180° about its z; padded with the first.
    rotations: Vec<[[[f32; 4]; 2]; DISTINCT_YAWS]>,
    /// Widths, voxels.
    widths: Vec<f32>,
}

/// Weights of the classes and of the rotation in the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Weights of failures and of successes.
    pub classes: [f64; 2],
    /// Weight of the rotation.
    pub rotation: f64,
}

impl Default for LossWeights {
    /// All weights are 1, as in the paper.
    fn default() -> Self {
        Self { classes: [1.0; 2], rotation: 1.0 }
    }
}

/// The loss over a batch.
pub struct Loss {
    /// The mean over the labelled voxels, to be minimised.
    pub mean: Tensor,
    /// Sums of its parts.
    pub sums: LossSums,
}

/// Sums over the labelled voxels of one or several batches.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossSums {
    /// Labelled voxels.
    pub voxels: f64,
    /// Binary cross-entropy of the quality.
    pub quality: f64,
    /// Weighted 1 − |r·r*| to the nearest valid rotation, successes only.
    pub rotation: f64,
    /// Weighted squared error of the width, successes only.
    pub width: f64,
    /// Angle to the nearest valid rotation, degrees, successes only.
    pub angle: f64,
    /// Successes with a quality above 0.5.
    pub true_positives: f64,
    /// Failures with a quality above 0.5.
    pub false_positives: f64,
    /// Successes with a quality of 0.5 or less.
    pub false_negatives: f64,
    /// Voxels at which shapes are completed.
    pub occupancy_voxels: f64,
    /// Binary cross-entropy of their occupancy.
    pub occupancy: f64,
}

/// Why the loss cannot be computed.
#[derive(Debug, Error)]
pub enum LossError {
    /// The network's quality is NaN: the training has diverged.
    #[error("the network's quality is not a number")]
    NotANumber,
    /// libtorch failed, because the outputs are of other voxels.
    #[error(transparent)]
    Torch(#[from] TchError),
}

impl Targets {
    /// Adds a trial in volume `index` of the batch. `n` is N. A trial outside the volume is ignored.
    pub fn push(&mut self, index: usize, trial: &Trial, n: usize, origin: VoxelOrigin, quality: QualityTarget) {
        let Some(voxel) = voxel_of(trial, n, origin) else { return };
        self.voxels.push((index * n.pow(3) + voxel) as i64);
        self.labels.push(f32::from(u8::from(trial.success)));
        self.qualities.push(quality.of(trial));
        let symmetric = |rotation: &UnitQuaternion<f64>| symmetric_rotations(rotation.coords.map(|c| c as f32).into());
        let mut rotations = [symmetric(&trial.rotation); DISTINCT_YAWS];
        trial.rotations().zip(&mut rotations).for_each(|(rotation, place)| *place = symmetric(&rotation));
        self.rotations.push(rotations);
        self.widths.push(trial.width as f32);
    }

    /// Adds a teacher's output at a voxel: a quality in [0, 1], a quaternion x y z w, a width in voxels.
    pub(crate) fn push_teacher_output(&mut self, voxel: usize, quality: f32, rotation: [f32; 4], width: f32) {
        self.voxels.push(voxel as i64);
        self.labels.push(quality);
        self.qualities.push(quality);
        self.rotations.push([symmetric_rotations(rotation); DISTINCT_YAWS]);
        self.widths.push(width);
    }

    /// Number of labelled voxels.
    #[must_use]
    pub fn len(&self) -> usize {
        self.voxels.len()
    }

    /// The labelled voxels: flat indices into `[batch, N, N, N]`.
    #[must_use]
    pub fn voxels(&self) -> &[i64] {
        &self.voxels
    }

    /// Whether there is no labelled voxel.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.voxels.is_empty()
    }

    /// The loss of a network's outputs at [these voxels](Self::voxels): L = c·(BCE(q, q*) + s·(ρ·(1 − max |r·r*|) +
    /// 0.01·(w − w*)²)), averaged over them. s is 1 for a success and 0 for a failure, c the weight of the class and ρ
    /// that of the rotation. In the paper q* is s; see [`QualityTarget`] for the alternative.
    ///
    /// # Errors
    /// [`LossError`] when outputs are NaN or of other voxels.
    pub fn loss(&self, outputs: &NetworkOutputs, weights: &LossWeights) -> Result<Loss, LossError> {
        let device = outputs.quality.device();
        let labels = Tensor::f_from_slice(&self.labels)?.to_device(device);

        let quality = outputs.quality.f_reshape_as(&labels)?;
        if quality.isnan().any().int64_value(&[]) != 0 {
            return Err(LossError::NotANumber);
        }
        let [failure, success] = weights.classes;
        let voxel_weights = &labels * (success - failure) + failure;
        let expected = Tensor::f_from_slice(&self.qualities)?.to_device(device);
        let quality_loss = quality.f_binary_cross_entropy(&expected, Some(&voxel_weights), Reduction::Sum)?;

        let valid = self.rotations.as_flattened().as_flattened().as_flattened();
        let valid = Tensor::f_from_slice(valid)?.to_device(device).f_reshape([-1, 2 * DISTINCT_YAWS as i64, 4])?;
        let rotation = outputs.rotation.f_reshape([-1, 1, 4])?;
        let cosines = rotation.f_mul(&valid)?.sum_dim_intlist(-1, false, None).abs();
        let nearest = cosines.amax([1], false);
        let rotation_loss: Tensor = &labels * (1.0 - &nearest);
        let rotation_loss = rotation_loss.sum(None) * (success * weights.rotation);

        let width = outputs.width.f_reshape_as(&labels)?;
        let expected = Tensor::f_from_slice(&self.widths)?.to_device(device);
        let width_loss: Tensor = &labels * (width - expected).square();
        let width_loss = width_loss.sum(None) * (success * WIDTH_WEIGHT);

        let positive = quality.gt(0.5).to_kind(Kind::Float);
        let angles = &labels * nearest.detach().clamp_max(1.0).acos() * 2.0;
        let counts = [angles, &positive * &labels, positive].map(|values| values.sum(None));
        let losses = [&quality_loss, &rotation_loss, &width_loss].map(Tensor::detach);
        // One copy: on a GPU each copy waits for all kernels.
        let sums: Vec<Tensor> = losses.into_iter().chain(counts).collect();
        let sums = Tensor::f_stack(&sums, 0)?.to_device(Device::Cpu);
        let sum = |index| sums.double_value(&[index]);
        let true_positives = sum(4);
        let sums = LossSums {
            voxels: self.len() as f64,
            quality: sum(0),
            rotation: sum(1),
            width: sum(2),
            angle: sum(3).to_degrees(),
            true_positives,
            false_positives: sum(5) - true_positives,
            false_negatives: f64::from(self.labels.iter().sum::<f32>()) - true_positives,
            ..LossSums::default()
        };
        Ok(Loss { mean: (quality_loss + rotation_loss + width_loss) / self.len() as f64, sums })
    }
}

/// A quaternion x y z w, and the same rotated by 180° about its own z, q · (0, 0, 1, 0): the hand is symmetric.
fn symmetric_rotations([x, y, z, w]: [f32; 4]) -> [[f32; 4]; 2] {
    [[x, y, z, w], [y, -x, w, -z]]
}

/// The flat index of the voxel of a trial: the nearest index (VGN), or the voxel that contains the position. `None`
/// outside the volume.
fn voxel_of(trial: &Trial, n: usize, origin: VoxelOrigin) -> Option<usize> {
    let index = match origin {
        VoxelOrigin::Corner => trial.position.coords.map(f64::round),
        VoxelOrigin::Center => trial.position.coords.map(f64::floor),
    };
    let inside = index.iter().all(|&c| c >= 0.0 && c < n as f64);
    inside.then(|| (index.x as usize * n + index.y as usize) * n + index.z as usize)
}

impl LossSums {
    /// Adds the sums of another batch.
    pub fn add(&mut self, other: &Self) {
        let mut other = *other;
        self.fields().into_iter().zip(other.fields()).for_each(|(sum, more)| *sum += *more);
    }

    /// All sums, in the order of checkpoints.
    pub(crate) fn fields(&mut self) -> [&mut f64; 10] {
        [
            &mut self.voxels,
            &mut self.quality,
            &mut self.rotation,
            &mut self.width,
            &mut self.angle,
            &mut self.true_positives,
            &mut self.false_positives,
            &mut self.false_negatives,
            &mut self.occupancy_voxels,
            &mut self.occupancy,
        ]
    }

    /// The mean loss of a labelled voxel.
    #[must_use]
    pub fn loss(&self) -> f64 {
        (self.quality + self.rotation + self.width) / self.voxels
    }

    /// The mean loss of the completion of shapes; `None` without it.
    #[must_use]
    pub fn occupancy(&self) -> Option<f64> {
        (self.occupancy_voxels > 0.0).then(|| self.occupancy / self.occupancy_voxels)
    }

    /// Mean angle of the successes to the nearest valid rotation, degrees.
    #[must_use]
    pub fn angle(&self) -> f64 {
        self.angle / (self.true_positives + self.false_negatives)
    }

    /// Share of correctly classified voxels, with a threshold of 0.5.
    #[must_use]
    pub fn accuracy(&self) -> f64 {
        1.0 - (self.false_positives + self.false_negatives) / self.voxels
    }

    /// Share of successes among the voxels above 0.5.
    #[must_use]
    pub fn precision(&self) -> f64 {
        self.true_positives / (self.true_positives + self.false_positives)
    }

    /// Share of the successes that are above 0.5.
    #[must_use]
    pub fn recall(&self) -> f64 {
        self.true_positives / (self.true_positives + self.false_negatives)
    }
}
