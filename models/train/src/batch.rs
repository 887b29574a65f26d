use std::sync::mpsc;
use std::thread;

use grasp_data::Dataset;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tch::{Device, Tensor};

use crate::augment::Transform;
use crate::loss::Targets;
use crate::occupancy::OccupancyTargets;
use crate::teacher::Teacher;
use crate::train_error::TrainError;
use crate::training_settings::TrainingSettings;

/// Number of batches that a background thread reads in advance.
const READ_AHEAD: usize = 2;

/// Background threads for a GPU.
const GPU_READERS: usize = 4;

/// A scene as an input of a training step, with its augmentation.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Example {
    pub scene: usize,
    /// Index of the scene's volume.
    pub volume: usize,
    pub transform: Transform,
    /// Seed of the voxels for which the teacher's output or the occupancy is used.
    pub voxel_seed: u64,
}

/// Inputs and targets of a forward pass.
pub(crate) struct Batch {
    /// Number of scenes.
    pub len: usize,
    /// `[len, 1, N, N, N]`, on the device of the training.
    pub volumes: Tensor,
    pub targets: Targets,
    /// The teacher's outputs as targets; empty without a teacher.
    pub teacher_targets: Targets,
    /// Voxels with their occupancy; empty without the completion of shapes.
    pub occupancy: OccupancyTargets,
}

impl Batch {
    fn read(
        dataset: &Dataset,
        examples: &[Example],
        settings: &TrainingSettings,
        device: Device,
        mut teacher: Option<&mut Teacher>,
    ) -> Result<Self, TrainError> {
        let n = dataset.resolution();
        let mut volumes = vec![0.0; examples.len() * n.pow(3)];
        let (mut targets, mut teacher_targets) = (Targets::default(), Targets::default());
        let mut occupancy = OccupancyTargets::default();
        for (index, (example, out)) in examples.iter().zip(volumes.chunks_exact_mut(n.pow(3))).enumerate() {
            let &Example { scene, volume, transform, voxel_seed } = example;
            transform.volume(dataset.volume(scene, volume), n, out);
            for trial in dataset.trials(scene) {
                targets.push(index, &transform.trial(&trial, n), n, settings.voxel_origin, settings.quality);
            }
            if let Some(teacher) = teacher.as_deref_mut() {
                teacher.add_targets(index, out, &mut ChaCha8Rng::seed_from_u64(voxel_seed), &mut teacher_targets)?;
            }
            if settings.occupancy > 0.0
                && let Some(inside) = dataset.occupancy(scene)
            {
                occupancy.add(index, &inside, transform, n, &mut ChaCha8Rng::seed_from_u64(voxel_seed));
            }
        }
        let (len, edge) = (examples.len(), n as i64);
        // Copied to the device here and not in the training step, so that a GPU does not wait for it.
        let volumes =
            Tensor::f_from_slice(&volumes)?.f_reshape([len as i64, 1, edge, edge, edge])?.f_to_device(device)?;
        Ok(Self { len, volumes, targets, teacher_targets, occupancy })
    }
}

/// Calls `consume` with the batches of a plan, which background threads read: several for a GPU, which one thread could
/// not keep busy. A teacher is one network, so that its outputs are computed by one thread.
pub(crate) fn read_ahead<R>(
    dataset: &Dataset,
    plan: &[&[Example]],
    settings: &TrainingSettings,
    device: Device,
    mut teacher: Option<&mut Teacher>,
    consume: impl FnOnce(&mut dyn Iterator<Item = Result<Batch, TrainError>>) -> R,
) -> R {
    let readers = if device.is_cuda() && teacher.is_none() { GPU_READERS } else { 1 };
    thread::scope(|scope| {
        let receivers: Vec<_> = (0..readers)
            .map(|first| {
                let (sender, batches) = mpsc::sync_channel(READ_AHEAD);
                let mut teacher = teacher.take();
                scope.spawn(move || {
                    for examples in plan.iter().skip(first).step_by(readers) {
                        let batch = Batch::read(dataset, examples, settings, device, teacher.as_deref_mut());
                        // Sending fails when `consume` has returned early.
                        if sender.send(batch).is_err() {
                            break;
                        }
                    }
                });
                batches
            })
            .collect();
        consume(&mut receivers.iter().cycle().take(plan.len()).map_while(|batches| batches.recv().ok()))
    })
}
