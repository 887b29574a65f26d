use std::sync::mpsc;
use std::thread;

use grasp::VoxelOrigin;
use grasp_data::Dataset;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::augment::Transform;
use crate::loss::Targets;
use crate::teacher::{Teacher, TeacherError};
use crate::training_settings::QualityTarget;

/// Number of batches that the background thread reads in advance.
const READ_AHEAD: usize = 2;

/// A scene as an input of a training step, with its augmentation.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Example {
    pub scene: usize,
    /// Index of the scene's volume.
    pub volume: usize,
    pub transform: Transform,
    /// Seed of the voxels for which the teacher's output is used.
    pub voxel_seed: u64,
}

/// Inputs and targets of a forward pass.
pub(crate) struct Batch {
    /// Number of scenes.
    pub len: usize,
    /// `[len, N, N, N]`.
    pub volumes: Vec<f32>,
    pub targets: Targets,
    /// The teacher's outputs as targets; empty without a teacher.
    pub teacher_targets: Targets,
}

impl Batch {
    fn read(
        dataset: &Dataset,
        examples: &[Example],
        origin: VoxelOrigin,
        quality: QualityTarget,
        mut teacher: Option<&mut Teacher>,
    ) -> Result<Self, TeacherError> {
        let n = dataset.resolution();
        let mut volumes = vec![0.0; examples.len() * n.pow(3)];
        let (mut targets, mut teacher_targets) = (Targets::default(), Targets::default());
        for (index, (example, out)) in examples.iter().zip(volumes.chunks_exact_mut(n.pow(3))).enumerate() {
            let &Example { scene, volume, transform, voxel_seed } = example;
            transform.volume(dataset.volume(scene, volume), n, out);
            for trial in dataset.trials(scene) {
                targets.push(index, &transform.trial(&trial, n), n, origin, quality);
            }
            if let Some(teacher) = teacher.as_deref_mut() {
                teacher.add_targets(index, out, &mut ChaCha8Rng::seed_from_u64(voxel_seed), &mut teacher_targets)?;
            }
        }
        Ok(Self { len: examples.len(), volumes, targets, teacher_targets })
    }
}

/// Calls `consume` with the batches of a plan, which a background thread reads.
pub(crate) fn read_ahead<R>(
    dataset: &Dataset,
    plan: &[&[Example]],
    origin: VoxelOrigin,
    quality: QualityTarget,
    mut teacher: Option<&mut Teacher>,
    consume: impl FnOnce(mpsc::IntoIter<Result<Batch, TeacherError>>) -> R,
) -> R {
    thread::scope(|scope| {
        let (sender, batches) = mpsc::sync_channel(READ_AHEAD);
        scope.spawn(move || {
            for examples in plan {
                // Sending fails when `consume` has returned early.
                if sender.send(Batch::read(dataset, examples, origin, quality, teacher.as_deref_mut())).is_err() {
                    break;
                }
            }
        });
        consume(batches.into_iter())
    })
}
