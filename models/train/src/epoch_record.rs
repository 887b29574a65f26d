use serde::{Deserialize, Serialize};

use crate::loss::LossSums;

/// Results of an epoch: a line of the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochRecord {
    /// Number of the epoch, from 1.
    pub epoch: u64,
    /// Steps since the start.
    pub steps: u64,
    /// Learning rate of the last step.
    pub learning_rate: f64,
    /// Mean loss over the labelled voxels.
    pub loss: f64,
    /// Part of the loss: cross-entropy of the quality.
    pub loss_quality: f64,
    /// Part of the loss: rotation.
    pub loss_rotation: f64,
    /// Part of the loss: width.
    pub loss_width: f64,
    /// Loss of the completion of shapes, if it is trained. It is not part of `loss`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss_occupancy: Option<f64>,
    /// Results on the validation scenes, if there are any.
    pub validation: Option<Validation>,
    /// Results of --evaluate, if it was run.
    #[serde(rename = "success", default, skip_serializing_if = "Option::is_none")]
    pub benchmark: Option<BenchmarkRates>,
    /// Duration of the epoch, without the part before an interruption, seconds.
    pub seconds: f64,
    /// Training speed, volumes per second.
    pub volumes_per_second: f64,
}

/// Results on the validation scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// Mean loss over the labelled voxels.
    pub loss: f64,
    /// Part of the loss: cross-entropy of the quality.
    pub loss_quality: f64,
    /// Part of the loss: rotation.
    pub loss_rotation: f64,
    /// Part of the loss: width.
    pub loss_width: f64,
    /// Loss of the completion of shapes, if it is trained. It is not part of `loss`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss_occupancy: Option<f64>,
    /// Mean angle of the successes to the nearest valid rotation, degrees.
    #[serde(default)]
    pub angle: Option<f64>,
    /// Share of correctly classified voxels, with a threshold of 0.5.
    pub accuracy: f64,
    /// Share of successes among the voxels above 0.5.
    pub precision: Option<f64>,
    /// Share of the successes above 0.5.
    pub recall: Option<f64>,
}

/// Results of a benchmark in simulation, averaged over its conditions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BenchmarkRates {
    /// Grasp success rate.
    pub gsr: f64,
    /// Declutter rate.
    pub dr: f64,
}

impl Validation {
    /// The results from the sums over the validation scenes; `None` without labelled voxels.
    pub(crate) fn from_sums(sums: &LossSums) -> Option<Self> {
        (sums.voxels > 0.0).then(|| Self {
            loss: sums.loss(),
            loss_quality: sums.quality / sums.voxels,
            loss_rotation: sums.rotation / sums.voxels,
            loss_width: sums.width / sums.voxels,
            loss_occupancy: sums.occupancy(),
            angle: Some(sums.angle()).filter(|angle| angle.is_finite()),
            accuracy: sums.accuracy(),
            precision: Some(sums.precision()).filter(|share| share.is_finite()),
            recall: Some(sums.recall()).filter(|share| share.is_finite()),
        })
    }
}
