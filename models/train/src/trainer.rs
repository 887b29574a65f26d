use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use grasp::VoxelOrigin;
use grasp_data::{DataError, Dataset};
use grasp_models::onnx::ModelProto;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tch::{TchError, Tensor, no_grad};
use thiserror::Error;

use crate::adam::Adam;
use crate::augment::{Augmentation, Transform};
use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::execute::{ExecuteError, Execution, Executor};
use crate::loss::{Loss, LossError, Sums, Targets};

/// Everything that decides the outcome of a run, besides the network it starts from and the data.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// Times every scene is seen.
    pub epochs: u64,
    /// Scenes in a step.
    pub batch: usize,
    /// Adam's learning rate, after the warm-up.
    pub learning_rate: f64,
    /// Steps over which the learning rate rises from 0.
    pub warmup: u64,
    /// Whether it then falls to 0 along half a cosine, instead of staying.
    pub cosine: bool,
    /// Decides the order of the scenes and how they are changed.
    pub seed: u64,
    /// Share of the scenes that are held out.
    pub validation: f64,
    /// How scenes are changed.
    pub augmentation: Augmentation,
    /// Whether failures and successes weigh the same in the quality's loss, however many there are of each. Otherwise
    /// the data decide, which VGN balances beforehand.
    pub balance: bool,
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
    /// Share of voxels on the right side of a quality of 0.5.
    pub accuracy: f64,
    /// Share of successes among the voxels above it.
    pub precision: Option<f64>,
    /// Share of the successes above it.
    pub recall: Option<f64>,
}

/// Why training stopped.
#[derive(Debug, Error)]
pub enum TrainError {
    /// A setting makes no sense with these data.
    #[error("{0}")]
    Settings(String),
    /// The data have been damaged meanwhile.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The graph cannot be executed.
    #[error(transparent)]
    Execute(#[from] ExecuteError),
    /// libtorch refused.
    #[error(transparent)]
    Torch(#[from] TchError),
    /// The checkpoint cannot be continued.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The loss cannot be computed.
    #[error(transparent)]
    Loss(#[from] LossError),
    /// The loss is no number any more.
    #[error("the loss is no number any more at step {step}; use a smaller learning rate or a warm-up")]
    Diverged {
        /// When.
        step: u64,
    },
}

/// How [`Trainer::epoch`] ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Epoch {
    /// Complete.
    Done(Record),
    /// Stopped after a step; the next call goes on from there.
    Interrupted,
}

/// What a step sees of a scene.
#[derive(Clone, Copy, Debug, Default)]
struct Example {
    scene: usize,
    /// Which of its volumes.
    look: usize,
    transform: Transform,
}

/// A run: a network, its optimiser, the data, and how far it has come.
pub struct Trainer {
    settings: Settings,
    dataset: Dataset,
    training: Vec<usize>,
    validation: Vec<usize>,
    class_weights: [f64; 2],
    /// What must be the same for a run to go on.
    fingerprint: String,
    executor: Executor,
    adam: Adam,
    /// Epochs completed, batches done of the next, and their losses.
    epoch: u64,
    batch: u64,
    sums: Sums,
}

impl Trainer {
    /// A run from the beginning.
    ///
    /// # Errors
    /// [`TrainError`] when the graph cannot be executed, or no scene is left to learn from.
    pub fn new(
        model: ModelProto,
        dataset: Dataset,
        settings: Settings,
        execution: Execution,
    ) -> Result<Self, TrainError> {
        let executor = Executor::new(model, execution)?;
        let adam = Adam::new(executor.parameters());
        let mut trainer = Self {
            settings,
            dataset,
            training: Vec::new(),
            validation: Vec::new(),
            class_weights: [1.0; 2],
            fingerprint: String::new(),
            executor,
            adam,
            epoch: 0,
            batch: 0,
            sums: Sums::default(),
        };
        trainer.look_over()?;
        Ok(trainer)
    }

    /// Takes in what has been added to the data since; says how many scenes. Between two epochs only.
    ///
    /// # Errors
    /// [`TrainError::Data`] when a file is damaged.
    pub fn follow(&mut self) -> Result<usize, TrainError> {
        if self.batch != 0 {
            return Ok(0);
        }
        let added = self.dataset.refresh()?;
        if added > 0 {
            self.look_over()?;
        }
        Ok(added)
    }

    /// Everything that depends on the scenes at hand.
    fn look_over(&mut self) -> Result<(), TrainError> {
        let (training, validation) = self.dataset.split(self.settings.validation);
        if training.is_empty() || self.settings.batch == 0 {
            let (scenes, held_out) = (self.dataset.len(), validation.len());
            let batch = self.settings.batch;
            let reason = format!("nothing to learn from: {scenes} scenes, {held_out} held out, batches of {batch}");
            return Err(TrainError::Settings(reason));
        }
        self.class_weights = if self.settings.balance { class_weights(&self.dataset, &training)? } else { [1.0; 2] };
        self.fingerprint = fingerprint(&self.settings, &self.dataset, training.len(), validation.len());
        (self.training, self.validation) = (training, validation);
        Ok(())
    }

    /// The data.
    #[must_use]
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Scenes learnt from and held out.
    #[must_use]
    pub fn scenes(&self) -> (usize, usize) {
        (self.training.len(), self.validation.len())
    }

    /// Epochs completed.
    #[must_use]
    pub fn epochs(&self) -> u64 {
        self.epoch
    }

    /// Steps taken.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.adam.steps()
    }

    /// Steps in an epoch.
    #[must_use]
    pub fn steps_per_epoch(&self) -> u64 {
        self.training.len().div_ceil(self.settings.batch) as u64
    }

    /// The network as it is now.
    #[must_use]
    pub fn model(&self) -> ModelProto {
        self.executor.to_model()
    }

    /// Where the run stands.
    #[must_use]
    pub fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = Checkpoint {
            settings: self.fingerprint.clone(),
            epoch: self.epoch,
            batch: self.batch,
            sums: self.sums.to_list(),
            scenes: self.dataset.sizes().into_iter().map(|size| size as u64).collect(),
            ..Checkpoint::default()
        };
        checkpoint.keep(&self.executor, &self.adam);
        checkpoint
    }

    /// Goes on from there.
    ///
    /// # Errors
    /// [`TrainError::Checkpoint`] when it belongs to another run, or lacks something.
    pub fn resume(&mut self, checkpoint: &Checkpoint) -> Result<(), TrainError> {
        let known: Vec<usize> = checkpoint.scenes.iter().map(|&size| size as usize).collect();
        if known.len() == self.dataset.sizes().len() && known != self.dataset.sizes() {
            self.dataset.limit(&known);
            self.look_over()?;
        }
        if checkpoint.settings != self.fingerprint {
            let (theirs, ours) = (checkpoint.settings.clone(), self.fingerprint.clone());
            return Err(CheckpointError::Settings { theirs, ours }.into());
        }
        let sums = Sums::from_list(&checkpoint.sums).ok_or(CheckpointError::Sums(checkpoint.sums.len()))?;
        checkpoint.restore(&self.executor, &mut self.adam)?;
        self.epoch = checkpoint.epoch;
        self.batch = checkpoint.batch;
        self.sums = sums;
        Ok(())
    }

    /// Trains for the rest of an epoch, unless `stop` is set meanwhile; `report` hears of every step: batches done and
    /// the mean loss of the epoch so far.
    ///
    /// # Errors
    /// [`TrainError`] when the network or the loss fails.
    pub fn epoch(&mut self, stop: &AtomicBool, mut report: impl FnMut(u64, f64)) -> Result<Epoch, TrainError> {
        let start = Instant::now();
        let plan = self.plan();
        let mut volumes = 0;
        let mut learning_rate = 0.0;
        for batch in plan.chunks(self.settings.batch).skip(self.batch as usize) {
            if stop.load(Ordering::Relaxed) {
                return Ok(Epoch::Interrupted);
            }
            learning_rate = self.learning_rate();
            if let Some(Loss { mean, sums }) = self.loss(batch)? {
                if !sums.loss().is_finite() {
                    return Err(self.diverged());
                }
                mean.f_backward()?;
                self.adam.step(self.executor.parameters(), learning_rate);
                self.sums.add(&sums);
            }
            volumes += batch.len();
            self.batch += 1;
            report(self.batch, self.sums.loss());
        }
        let seconds = start.elapsed().as_secs_f64();
        let (sums, batches) = (self.sums, self.batch);
        self.epoch += 1;
        self.batch = 0;
        self.sums = Sums::default();
        debug_assert_eq!(batches, self.steps_per_epoch());
        Ok(Epoch::Done(Record {
            epoch: self.epoch,
            steps: self.steps(),
            learning_rate,
            loss: sums.loss(),
            loss_quality: sums.quality / sums.voxels,
            loss_rotation: sums.rotation / sums.voxels,
            loss_width: sums.width / sums.voxels,
            validation: self.validate()?,
            seconds,
            volumes_per_second: volumes as f64 / seconds,
        }))
    }

    /// The loss over the scenes held out, as they are; none if there are none.
    fn validate(&self) -> Result<Option<Validation>, TrainError> {
        let mut sums = Sums::default();
        let scenes: Vec<_> = self.validation.iter().map(|&scene| Example { scene, ..Example::default() }).collect();
        for batch in scenes.chunks(self.settings.batch) {
            if let Some(loss) = no_grad(|| self.loss(batch))? {
                sums.add(&loss.sums);
            }
        }
        Ok((sums.voxels > 0.0).then(|| Validation {
            loss: sums.loss(),
            loss_quality: sums.quality / sums.voxels,
            loss_rotation: sums.rotation / sums.voxels,
            loss_width: sums.width / sums.voxels,
            accuracy: sums.accuracy(),
            precision: Some(sums.precision()).filter(|share| share.is_finite()),
            recall: Some(sums.recall()).filter(|share| share.is_finite()),
        }))
    }

    /// The order of an epoch's scenes and how each is changed: a function of the seed and the epoch.
    fn plan(&self) -> Vec<Example> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed);
        rng.set_stream(self.epoch);
        let mut scenes = self.training.clone();
        scenes.shuffle(&mut rng);
        let mut example = |scene| Example {
            scene,
            look: rng.random_range(0..self.dataset.volumes(scene)),
            transform: self.settings.augmentation.draw(&mut rng),
        };
        scenes.into_iter().map(&mut example).collect()
    }

    fn learning_rate(&self) -> f64 {
        let Settings { epochs, learning_rate, warmup, cosine, .. } = self.settings;
        let step = self.steps();
        if step < warmup {
            return learning_rate * (step + 1) as f64 / warmup as f64;
        }
        if !cosine {
            return learning_rate;
        }
        let last = (epochs * self.steps_per_epoch()).max(warmup + 1);
        let progress = (step - warmup) as f64 / (last - warmup) as f64;
        learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos())
    }

    /// One forward pass over some scenes; none when no grasp of theirs lies inside its volume.
    fn loss(&self, batch: &[Example]) -> Result<Option<Loss>, TrainError> {
        let n = self.dataset.resolution();
        let mut values = vec![0.0; batch.len() * n.pow(3)];
        let mut targets = Targets::default();
        for (index, (example, out)) in batch.iter().zip(values.chunks_exact_mut(n.pow(3))).enumerate() {
            let &Example { scene, look, transform } = example;
            transform.volume(self.dataset.volume(scene, look), n, out);
            for trial in self.dataset.trials(scene) {
                targets.push(index, &transform.trial(&trial, n), n, self.settings.voxel_origin);
            }
        }
        if targets.is_empty() {
            return Ok(None);
        }
        let edge = n as i64;
        let volumes = Tensor::f_from_slice(&values)?.f_reshape([batch.len() as i64, 1, edge, edge, edge])?;
        let outputs = self.executor.forward_at(&volumes.to_device(self.executor.device()), targets.cells())?;
        match targets.loss(&outputs, self.class_weights) {
            Err(LossError::NotANumber) => Err(self.diverged()),
            loss => Ok(Some(loss?)),
        }
    }

    fn diverged(&self) -> TrainError {
        TrainError::Diverged { step: self.steps() }
    }
}

/// What must be the same for a run to go on: the settings, the scenes and their grasps. A run at a constant learning rate
/// may be made longer.
fn fingerprint(settings: &Settings, dataset: &Dataset, training: usize, validation: usize) -> String {
    let mut settings = settings.clone();
    if !settings.cosine {
        settings.epochs = 0;
    }
    let settings = serde_json::to_string(&settings).unwrap_or_default();
    format!("{settings} over {training} + {validation} scenes (labels {})", dataset.fingerprint())
}

/// Weights that make both classes count the same: n / (2 n_class).
fn class_weights(dataset: &Dataset, scenes: &[usize]) -> Result<[f64; 2], TrainError> {
    let (all, successes) = dataset.grasps(scenes);
    if successes == 0 || successes == all {
        let reason = format!("the classes cannot be balanced: {successes} of {all} grasps succeeded");
        return Err(TrainError::Settings(reason));
    }
    Ok([all - successes, successes].map(|count| all as f64 / (2 * count) as f64))
}
