//! Learning from a trained network (Hinton et al., "Distilling the Knowledge in a Neural Network").
//!
//! Trials label a few dozen voxels of a scene; a trained network has an answer for every one. Where scenes come turned and
//! mirrored at random, what is learnt is the mean of its answers, which is better than any single one.

use grasp::{Volume, VolumeError, WORKSPACE_SIZE};
use grasp_models::{Metadata, Network, RuntimeError};
use nalgebra::Isometry3;
use rand::{Rng, RngExt};
use thiserror::Error;

use crate::loss::Targets;

/// Voxels of a volume that are learnt from, in the mean: others in every step, for the heads cost most of it.
const VOXELS: f64 = 400.0;

/// How likely a voxel is drawn that is no grasp, against a certain one.
const FLOOR: f64 = 0.05;

/// Why a teacher has no answer.
#[derive(Debug, Error)]
pub enum TeacherError {
    /// It cannot be asked.
    #[error(transparent)]
    Volume(#[from] VolumeError),
    /// It could not compute.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
}

/// A trained network that answers where nothing was tried. It is run as it is served.
pub struct Teacher {
    network: Network,
    weight: f64,
}

impl Teacher {
    /// What the mean loss to a network's answers counts for, against that to the trials.
    #[must_use]
    pub fn new(network: Network, weight: f64) -> Self {
        Self { network, weight }
    }

    /// What its answers count for.
    pub(crate) fn weight(&self) -> f64 {
        self.weight
    }

    /// What must be the same for a run to go on.
    pub(crate) fn fingerprint(&self) -> String {
        let Metadata { name, version, .. } = self.network.metadata();
        format!("taught by {name} {version} ({}) at {}", self.network.backend(), self.weight)
    }

    /// Adds its answers at voxels drawn in front of the surfaces of a volume `[N, N, N]`, the batch's number `index`.
    pub(crate) fn answer(
        &mut self,
        index: usize,
        values: &[f32],
        rng: &mut impl Rng,
        answers: &mut Targets,
    ) -> Result<(), TeacherError> {
        // In front of surfaces, where grasps are tried and taken: of the inside of things nobody taught the teacher, and 0
        // is where nothing was seen, or no surface is near.
        let near = || (0..values.len()).filter(|&cell| values[cell] > 0.5);
        if near().next().is_none() {
            return Ok(());
        }
        let resolution = self.network.metadata().resolution;
        // How large and where does not matter: a network sees voxels.
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
