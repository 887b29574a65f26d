use grasp::VoxelOrigin;
use grasp_data::{Dataset, Trial};
use serde::Serialize;

use crate::augment::Augmentation;

/// Target of the quality in the binary cross-entropy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum QualityTarget {
    /// The label of the trial: 1 for a success, 0 for a failure.
    #[default]
    Label,
    /// The success rate of its repetitions with small pose errors; the label if there are none.
    Share,
}

impl QualityTarget {
    /// The target of a trial, in [0, 1].
    #[must_use]
    pub fn of(self, trial: &Trial) -> f32 {
        match self {
            Self::Label => f32::from(u8::from(trial.success)),
            Self::Share => trial.share,
        }
    }
}

/// Settings of a run. Together with the initial network and the data they determine its result.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainingSettings {
    /// Number of epochs; `u64::MAX`: no limit.
    #[serde(skip_serializing_if = "is_unlimited")]
    pub epochs: u64,
    /// Time after which the run ends, minutes; its last epoch is cut short. `None`: no limit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// Scenes per forward pass.
    pub batch: usize,
    /// Forward passes per step.
    pub accumulate: usize,
    /// Adam's learning rate, after the warm-up.
    pub learning_rate: f64,
    /// Warm-up steps, in which the learning rate rises linearly from 0.
    pub warmup: u64,
    /// Whether the learning rate falls to 0 along half a cosine after the warm-up; otherwise it is constant.
    pub cosine: bool,
    /// Decoupled weight decay; multiplied by the learning rate.
    pub weight_decay: f64,
    /// Decay per step of the moving average of the weights, which is validated and written. `None`: no average.
    pub average: Option<f64>,
    /// Seed of the order of the scenes and the augmentation.
    pub seed: u64,
    /// Share of the scenes used for validation.
    pub validation: f64,
    /// Data augmentation.
    pub augmentation: Augmentation,
    /// Whether failures and successes have the same total weight in the loss. VGN balances the data instead.
    pub balance: bool,
    /// Target of the quality. Rotation and width do not depend on it.
    pub quality: QualityTarget,
    /// Weight of the rotation in the loss.
    pub rotation_weight: f64,
    /// Weight of the completion of shapes in the loss; 0: not trained.
    pub occupancy: f64,
    /// Point of a voxel that a grasp refers to, `corner` or `center`.
    #[serde(serialize_with = "origin_name")]
    pub voxel_origin: VoxelOrigin,
    /// Whether convolutions and matrix products are computed in bf16.
    pub bf16: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires a reference")]
fn is_unlimited(epochs: &u64) -> bool {
    *epochs == u64::MAX
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires a reference")]
fn origin_name<S: serde::Serializer>(origin: &VoxelOrigin, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match origin {
        VoxelOrigin::Corner => "corner",
        VoxelOrigin::Center => "center",
    })
}

impl TrainingSettings {
    /// The learning rate of step `step`, from 0, `minutes` after the start: linear warm-up, then constant, or half
    /// a cosine to 0 (Loshchilov and Hutter, "SGDR: Stochastic Gradient Descent with Warm Restarts", ICLR 2017, without
    /// restarts). The cosine follows the time if the run has a time limit, otherwise the steps.
    #[must_use]
    pub fn learning_rate_at(&self, step: u64, steps_per_epoch: u64, minutes: f64) -> f64 {
        let Self { epochs, learning_rate, warmup, cosine, .. } = *self;
        if step < warmup {
            return learning_rate * (step + 1) as f64 / warmup as f64;
        }
        if !cosine {
            return learning_rate;
        }
        let progress = match self.minutes {
            Some(limit) => minutes / limit,
            None => {
                let last = (epochs * steps_per_epoch).max(warmup + 1);
                (step - warmup) as f64 / (last - warmup) as f64
            }
        };
        learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos())
    }

    /// Settings, scenes and labels as a text. A run can only be resumed with the same text. The number of epochs is not
    /// part of it if the learning rate is constant.
    pub(crate) fn fingerprint(&self, dataset: &Dataset, training: usize, validation: usize) -> String {
        let mut settings = self.clone();
        if !settings.cosine {
            settings.epochs = 0;
        }
        let settings = serde_json::to_string(&settings).unwrap_or_default();
        format!("{settings} over {training} + {validation} scenes (labels {})", dataset.fingerprint())
    }
}
