//! Distillation of a trained network (Hinton et al., "Distilling the Knowledge in a Neural Network").
//!
//! Trials label a few dozen voxels of a scene; a trained network has an output at every voxel. With random rotations
//! and mirror images the student learns the mean of the teacher's outputs, which is better than a single output.

use grasp::{Volume, VolumeError, WORKSPACE_SIZE};
use grasp_models::{Metadata, Network, RuntimeError};
use nalgebra::Isometry3;
use rand::{Rng, RngExt};
use thiserror::Error;

use crate::loss::Targets;

/// Mean number of voxels of a volume that are used. They are drawn again in every step, because the heads at all voxels
/// would take most of the time.
const VOXELS: f64 = 400.0;

/// Relative probability to draw a voxel with quality 0, against 1 + this for quality 1.
const FLOOR: f64 = 0.05;

/// Why a teacher failed.
#[derive(Debug, Error)]
pub enum TeacherError {
    /// The volume is invalid.
    #[error(transparent)]
    Volume(#[from] VolumeError),
    /// The inference failed.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
}

/// A trained network whose outputs are targets at voxels without trials. It runs in ONNX Runtime.
pub struct Teacher {
    network: Network,
    weight: f64,
}

impl Teacher {
    /// `weight` is the weight of the mean loss to the teacher's outputs, relative to that of the trials.
    #[must_use]
    pub fn new(network: Network, weight: f64) -> Self {
        Self { network, weight }
    }

    /// Weight of the teacher's outputs in the loss.
    pub(crate) fn weight(&self) -> f64 {
        self.weight
    }

    /// A text that must be the same for a run to be resumed.
    pub(crate) fn fingerprint(&self) -> String {
        let Metadata { name, version, .. } = self.network.metadata();
        format!("taught by {name} {version} ({}) at {}", self.network.backend(), self.weight)
    }

    /// Adds the teacher's outputs at voxels drawn in front of the surfaces of a volume `[N, N, N]`. `index` is its
    /// index in the batch.
    pub(crate) fn answer(
        &mut self,
        index: usize,
        values: &[f32],
        rng: &mut impl Rng,
        answers: &mut Targets,
    ) -> Result<(), TeacherError> {
        // Voxels in front of surfaces, where grasps are tried. The teacher was not trained on the inside of objects,
        // and 0 means unobserved or not near a surface.
        let near = || (0..values.len()).filter(|&cell| values[cell] > 0.5);
        if near().next().is_none() {
            return Ok(());
        }
        let resolution = self.network.metadata().resolution;
        // Size and pose are arbitrary, because the network's output is in voxels.
        let voxel_size = WORKSPACE_SIZE / resolution as f64;
        let volume = Volume::new(resolution, voxel_size, Isometry3::identity(), values.to_vec())?;
        let output = self.network.infer(&[&volume])?;
        let maps = output.maps(0);
        let chance = |cell: usize| FLOOR + f64::from(maps.quality[cell]);
        let all: f64 = near().map(chance).sum();
        for cell in near().filter(|&cell| rng.random_bool((VOXELS * chance(cell) / all).clamp(0.0, 1.0))) {
            let rotation = std::array::from_fn(|axis| maps.rotation[axis * values.len() + cell]);
            answers.push_answer(index * values.len() + cell, maps.quality[cell], rotation, maps.width[cell]);
        }
        Ok(())
    }
}
