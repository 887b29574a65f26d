use grasp::VoxelOrigin;
use grasp_data::{Dataset, Trial};
use serde::Serialize;

use crate::augment::Augmentation;

/// What the quality is learnt from, by binary cross-entropy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Quality {
    /// Whether a grasp held: 1 or 0.
    #[default]
    Label,
    /// The share of its tries that held. Where none was tried again, the same as the label.
    Share,
}

impl Quality {
    /// What the quality of a grasp should be.
    #[must_use]
    pub fn of(self, trial: &Trial) -> f32 {
        match self {
            Self::Label => f32::from(u8::from(trial.success)),
            Self::Share => trial.share,
        }
    }
}

/// Everything that decides the outcome of a run, besides the network it starts from and the data.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// Times every scene is seen.
    pub epochs: u64,
    /// Scenes in a forward pass.
    pub batch: usize,
    /// Forward passes in a step.
    pub accumulate: usize,
    /// Adam's learning rate, after the warm-up.
    pub learning_rate: f64,
    /// Steps over which the learning rate rises from 0.
    pub warmup: u64,
    /// Whether it then falls to 0 along half a cosine, instead of staying.
    pub cosine: bool,
    /// What is taken off the weights in every step, times the learning rate.
    pub weight_decay: f64,
    /// Share of itself that the moving average of the weights keeps in every step; the average is what is validated and
    /// written. None: the weights themselves are.
    pub average: Option<f64>,
    /// Decides the order of the scenes and how they are changed.
    pub seed: u64,
    /// Share of the scenes that are held out.
    pub validation: f64,
    /// How scenes are changed.
    pub augmentation: Augmentation,
    /// Whether failures and successes weigh the same, however many there are of each: in the mean as if there were as
    /// many of both. Otherwise the data decide, which VGN balances beforehand.
    pub balance: bool,
    /// What the quality is learnt from. Rotation and width are learnt from every success the same.
    pub quality: Quality,
    /// What the rotation's part of the loss counts for.
    pub rotation_weight: f64,
    /// Where in its voxel a grasp stands, `corner` or `center`.
    #[serde(serialize_with = "origin_name")]
    pub voxel_origin: VoxelOrigin,
    /// Whether convolutions and matrix products are computed in bf16.
    pub bf16: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks for a reference")]
fn origin_name<S: serde::Serializer>(origin: &VoxelOrigin, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match origin {
        VoxelOrigin::Corner => "corner",
        VoxelOrigin::Center => "center",
    })
}

impl Settings {
    /// The learning rate of a step, of which there are so many in an epoch.
    #[must_use]
    pub fn learning_rate_at(&self, step: u64, steps_per_epoch: u64) -> f64 {
        let Self { epochs, learning_rate, warmup, cosine, .. } = *self;
        if step < warmup {
            return learning_rate * (step + 1) as f64 / warmup as f64;
        }
        if !cosine {
            return learning_rate;
        }
        let last = (epochs * steps_per_epoch).max(warmup + 1);
        let progress = (step - warmup) as f64 / (last - warmup) as f64;
        learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos())
    }

    /// What must be the same for a run to go on: the settings, the scenes and their grasps. A run at a constant learning
    /// rate may be made longer.
    pub(crate) fn fingerprint(&self, dataset: &Dataset, training: usize, validation: usize) -> String {
        let mut settings = self.clone();
        if !settings.cosine {
            settings.epochs = 0;
        }
        let settings = serde_json::to_string(&settings).unwrap_or_default();
        format!("{settings} over {training} + {validation} scenes (labels {})", dataset.fingerprint())
    }
}
