//! Distillation of a trained network (Hinton et al., "Distilling the Knowledge in a Neural Network").
//!
//! Trials label a few dozen voxels of a scene; a trained network has an output at every voxel. With random rotations
//! and mirror images of the scenes, the student is trained on the mean of the teacher's outputs, which is more accurate
//! than a single output.

use std::fs;
use std::path::Path;

use grasp::{Volume, VolumeError, WORKSPACE_SIZE};
use grasp_models::{LoadError, Metadata, Network, Options, RuntimeError};
use nalgebra::Isometry3;
use rand::{Rng, RngExt};
use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::loss::Targets;

/// Mean number of voxels of a volume whose outputs are used. They are drawn again in every step. Computing the student's
/// heads at all voxels would take most of the time of a step.
const VOXELS: f64 = 400.0;

/// A voxel of quality q is drawn with a probability proportional to q + this.
const QUALITY_OFFSET: f64 = 0.05;

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

/// A trained network whose outputs are targets at voxels without trials. It runs in ONNX Runtime, on the thread that
/// reads the batches.
pub struct Teacher {
    network: Network,
    /// SHA-256 of its file.
    digest: [u8; 32],
    weight: f64,
}

impl Teacher {
    /// Loads a network. `weight` is the weight of the mean loss to its outputs, relative to that of the trials.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem.
    pub fn load(path: &Path, options: &Options, weight: f64) -> Result<Self, LoadError> {
        let bytes = fs::read(path).map_err(|error| LoadError { path: path.to_owned(), reason: error.into() })?;
        let network = Network::load(path, options)?;
        Ok(Self { network, digest: Sha256::digest(bytes).into(), weight })
    }

    /// The metadata of its file.
    #[must_use]
    pub fn metadata(&self) -> &Metadata {
        self.network.metadata()
    }

    /// Weight of the teacher's outputs in the loss.
    pub(crate) fn weight(&self) -> f64 {
        self.weight
    }

    /// A text that must be the same for a run to be resumed.
    pub(crate) fn fingerprint(&self) -> String {
        let Metadata { name, version, .. } = self.network.metadata();
        let digest: String = self.digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect();
        format!("taught by {name} {version} (SHA-256 {digest}…, {}) at {}", self.network.backend(), self.weight)
    }

    /// Adds the teacher's outputs at random voxels in front of the surfaces of a volume `[N, N, N]`. `index` is the index
    /// of the volume in the batch.
    pub(crate) fn add_targets(
        &mut self,
        index: usize,
        values: &[f32],
        rng: &mut impl Rng,
        targets: &mut Targets,
    ) -> Result<(), TeacherError> {
        // Grasps are tried in front of surfaces, where values are above 0.5. The teacher was not trained on the inside
        // of objects. 0 is unobserved or further than the truncation distance from a surface.
        let candidates = || (0..values.len()).filter(|&voxel| values[voxel] > 0.5);
        if candidates().next().is_none() {
            return Ok(());
        }
        let resolution = self.network.metadata().resolution;
        // Voxel size and pose have no effect, because the network's output is in voxels.
        let voxel_size = WORKSPACE_SIZE / resolution as f64;
        let volume = Volume::new(resolution, voxel_size, Isometry3::identity(), values.to_vec())?;
        let output = self.network.infer(&[&volume])?;
        let maps = output.maps(0);
        let probability = |voxel: usize| QUALITY_OFFSET + f64::from(maps.quality[voxel]);
        let sum: f64 = candidates().map(probability).sum();
        for voxel in candidates().filter(|&voxel| rng.random_bool((VOXELS * probability(voxel) / sum).clamp(0.0, 1.0)))
        {
            let rotation = std::array::from_fn(|axis| maps.rotation[axis * values.len() + voxel]);
            targets.push_teacher_output(index * values.len() + voxel, maps.quality[voxel], rotation, maps.width[voxel]);
        }
        Ok(())
    }
}
