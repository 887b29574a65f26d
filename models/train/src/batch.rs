use std::sync::mpsc;
use std::thread;

use grasp::VoxelOrigin;
use grasp_data::Dataset;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::augment::Transform;
use crate::loss::Targets;
use crate::settings::Quality;
use crate::teacher::{Teacher, TeacherError};

/// Batches that are read ahead of the one at work.
const AHEAD: usize = 2;

/// What a step sees of a scene.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Example {
    pub scene: usize,
    /// Which of its volumes.
    pub look: usize,
    pub transform: Transform,
    /// Decides of which voxels a teacher is asked.
    pub voxels: u64,
}

/// Scenes as a network takes them, with what it should answer.
pub(crate) struct Batch {
    /// How many scenes.
    pub len: usize,
    /// `[len, N, N, N]`.
    pub volumes: Vec<f32>,
    pub targets: Targets,
    /// What the teacher says, if there is one.
    pub answers: Targets,
}

impl Batch {
    fn read(
        dataset: &Dataset,
        examples: &[Example],
        origin: VoxelOrigin,
        quality: Quality,
        mut teacher: Option<&mut Teacher>,
    ) -> Result<Self, TeacherError> {
        let n = dataset.resolution();
        let mut volumes = vec![0.0; examples.len() * n.pow(3)];
        let (mut targets, mut answers) = (Targets::default(), Targets::default());
        for (index, (example, out)) in examples.iter().zip(volumes.chunks_exact_mut(n.pow(3))).enumerate() {
            let &Example { scene, look, transform, voxels } = example;
            transform.volume(dataset.volume(scene, look), n, out);
            for trial in dataset.trials(scene) {
                targets.push(index, &transform.trial(&trial, n), n, origin, quality);
            }
            if let Some(teacher) = teacher.as_deref_mut() {
                teacher.answer(index, out, &mut ChaCha8Rng::seed_from_u64(voxels), &mut answers)?;
            }
        }
        Ok(Self { len: examples.len(), volumes, targets, answers })
    }
}

/// Gives `take` the batches of a plan, which are read in the background: the processor computes meanwhile.
pub(crate) fn read_ahead<R>(
    dataset: &Dataset,
    plan: &[&[Example]],
    origin: VoxelOrigin,
    quality: Quality,
    mut teacher: Option<&mut Teacher>,
    take: impl FnOnce(mpsc::IntoIter<Result<Batch, TeacherError>>) -> R,
) -> R {
    thread::scope(|scope| {
        let (sender, batches) = mpsc::sync_channel(AHEAD);
        scope.spawn(move || {
            for examples in plan {
                // Nobody takes it when training was stopped.
                if sender.send(Batch::read(dataset, examples, origin, quality, teacher.as_deref_mut())).is_err() {
                    break;
                }
            }
        });
        take(batches.into_iter())
    })
}
