use serde::{Deserialize, Serialize};

use crate::loss::Sums;

/// One epoch, as it is logged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Counted from 1.
    pub epoch: u64,
    /// Steps since the start.
    pub steps: u64,
    /// Learning rate of the last step.
    pub learning_rate: f64,
    /// Mean loss over the labelled voxels.
    pub loss: f64,
    /// Its parts: cross-entropy of the quality,
    pub loss_quality: f64,
    /// rotation,
    pub loss_rotation: f64,
    /// and width.
    pub loss_width: f64,
    /// The same over the scenes held out, if any.
    pub validation: Option<Validation>,
    /// What clearing tables with it came to, if it was tried.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success: Option<Success>,
    /// Time this epoch took, without the part before an interruption.
    pub seconds: f64,
    /// Training speed.
    pub volumes_per_second: f64,
}

/// How the network does on scenes it does not learn from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// Mean loss over the labelled voxels.
    pub loss: f64,
    /// Its parts: cross-entropy of the quality,
    pub loss_quality: f64,
    /// rotation,
    pub loss_rotation: f64,
    /// and width.
    pub loss_width: f64,
    /// Mean angle of a success to the nearest rotation that holds, degrees.
    #[serde(default)]
    pub angle: Option<f64>,
    /// Share of voxels on the right side of a quality of 0.5.
    pub accuracy: f64,
    /// Share of successes among the voxels above it.
    pub precision: Option<f64>,
    /// Share of the successes above it.
    pub recall: Option<f64>,
}

/// How the network does in a simulator: means over all that was played.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Success {
    /// Grasp success rate.
    pub gsr: f64,
    /// Declutter rate.
    pub dr: f64,
}

impl Validation {
    /// Of the scenes held out; none if there are none.
    pub(crate) fn of(sums: &Sums) -> Option<Self> {
        (sums.voxels > 0.0).then(|| Self {
            loss: sums.loss(),
            loss_quality: sums.quality / sums.voxels,
            loss_rotation: sums.rotation / sums.voxels,
            loss_width: sums.width / sums.voxels,
            angle: Some(sums.angle()).filter(|angle| angle.is_finite()),
            accuracy: sums.accuracy(),
            precision: Some(sums.precision()).filter(|share| share.is_finite()),
            recall: Some(sums.recall()).filter(|share| share.is_finite()),
        })
    }
}
