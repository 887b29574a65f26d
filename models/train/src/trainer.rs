use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::no_grad;

use crate::adam::Adam;
use crate::batch::{Batch, Example, read_ahead};
use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::epoch_record::{EpochRecord, Validation};
use crate::execution_options::ExecutionOptions;
use crate::executor::Executor;
use crate::loss::{Loss, LossError, LossSums, LossWeights};
use crate::teacher::Teacher;
use crate::train_error::TrainError;
use crate::training_settings::TrainingSettings;
use crate::weight_average::WeightAverage;

/// How [`Trainer::epoch`] ended.
#[derive(Clone, Debug, PartialEq)]
pub enum EpochOutcome {
    /// All scenes were used.
    Completed(Box<EpochRecord>),
    /// Stopped after a step; the next call continues.
    Interrupted,
}

/// A training run: network, optimizer, data and progress.
pub struct Trainer {
    settings: TrainingSettings,
    dataset: Dataset,
    training: Vec<usize>,
    validation: Vec<usize>,
    weights: LossWeights,
    /// A run can only be resumed with the same text.
    fingerprint: String,
    executor: Executor,
    teacher: Option<Teacher>,
    /// Weight of the teacher's outputs in the loss.
    teacher_weight: f64,
    adam: Adam,
    average: Option<WeightAverage>,
    /// Completed epochs, completed batches of the current epoch, and their losses.
    epoch: u64,
    batch: u64,
    sums: LossSums,
    /// Start of this part of the run, and the duration of the parts before it.
    started: Instant,
    seconds_before: f64,
}

impl Trainer {
    /// A new run.
    ///
    /// # Errors
    /// [`TrainError`] when the graph cannot be executed, or there is no training scene.
    pub fn new(
        model: ModelProto,
        dataset: Dataset,
        settings: TrainingSettings,
        execution: ExecutionOptions,
    ) -> Result<Self, TrainError> {
        let mut executor = Executor::new(model, execution)?;
        if settings.occupancy > 0.0 {
            executor = executor.with_occupancy_head(settings.seed)?;
        }
        let adam = Adam::new(executor.parameters(), settings.weight_decay);
        let average = settings.average.map(|decay| WeightAverage::new(decay, executor.parameters()));
        let mut trainer = Self {
            settings,
            dataset,
            training: Vec::new(),
            validation: Vec::new(),
            weights: LossWeights::default(),
            fingerprint: String::new(),
            executor,
            teacher: None,
            teacher_weight: 0.0,
            adam,
            average,
            epoch: 0,
            batch: 0,
            sums: LossSums::default(),
            started: Instant::now(),
            seconds_before: 0.0,
        };
        trainer.update_scenes()?;
        Ok(trainer)
    }

    /// Adds a teacher to the run.
    #[must_use]
    pub fn with_teacher(self, teacher: Teacher) -> Self {
        let fingerprint = format!("{}, {}", self.fingerprint, teacher.fingerprint());
        Self { teacher_weight: teacher.weight(), teacher: Some(teacher), fingerprint, ..self }
    }

    /// Reads scenes that were added to the data since and returns their number. Within an epoch it does nothing.
    ///
    /// # Errors
    /// [`TrainError::Data`] when a file is damaged.
    pub fn follow(&mut self) -> Result<usize, TrainError> {
        if self.batch != 0 {
            return Ok(0);
        }
        let added = self.dataset.refresh()?;
        if added > 0 {
            self.update_scenes()?;
        }
        Ok(added)
    }

    /// Updates everything that depends on the scenes.
    fn update_scenes(&mut self) -> Result<(), TrainError> {
        let (training, validation) = self.dataset.split(self.settings.validation);
        let TrainingSettings { batch, accumulate, .. } = self.settings;
        if training.is_empty() || batch == 0 || accumulate == 0 {
            let (scenes, held_out) = (self.dataset.len(), validation.len());
            let reason = format!(
                "no training scenes: {scenes} scenes, {held_out} for validation, steps of {accumulate} × {batch}; \
                 all but validation must be greater than 0"
            );
            return Err(TrainError::Settings(reason));
        }
        if self.settings.occupancy > 0.0 && !training.iter().any(|&scene| self.dataset.occupancy(scene).is_some()) {
            let reason = "--occupancy needs scenes with their occupancy, which `grasp-sim` writes in its packed format since \
                          version 4; label or observe the scenes again";
            return Err(TrainError::Settings(reason.to_owned()));
        }
        let classes = if self.settings.balance { class_weights(&self.dataset, &training)? } else { [1.0; 2] };
        self.weights = LossWeights { classes, rotation: self.settings.rotation_weight };
        self.fingerprint = self.settings.fingerprint(&self.dataset, training.len(), validation.len());
        if let Some(teacher) = &self.teacher {
            self.fingerprint += &format!(", {}", teacher.fingerprint());
        }
        (self.training, self.validation) = (training, validation);
        Ok(())
    }

    /// The data.
    #[must_use]
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Number of training and validation scenes.
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

    /// Whether the time of the run is over.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.settings.minutes.is_some_and(|limit| self.seconds() >= 60.0 * limit)
    }

    /// Duration of the run, with the parts before an interruption.
    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Steps in an epoch.
    #[must_use]
    pub fn steps_per_epoch(&self) -> u64 {
        let TrainingSettings { batch, accumulate, .. } = self.settings;
        self.training.len().div_ceil(batch).div_ceil(accumulate) as u64
    }

    /// The current network, with the average of the weights if there is one.
    #[must_use]
    pub fn model(&mut self) -> ModelProto {
        self.with_average(|trainer| trainer.executor.to_model())
    }

    /// Calls `work` while the network has the average of the weights, if there is one.
    fn with_average<R>(&mut self, work: impl FnOnce(&Self) -> R) -> R {
        if let Some(average) = &mut self.average {
            average.swap(self.executor.parameters());
        }
        let result = work(self);
        if let Some(average) = &mut self.average {
            average.swap(self.executor.parameters());
        }
        result
    }

    /// The state of the run.
    #[must_use]
    pub fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = Checkpoint {
            settings: self.fingerprint.clone(),
            epoch: self.epoch,
            batch: self.batch,
            sums: self.sums.to_list(),
            scenes: self.dataset.sizes().into_iter().map(|size| size as u64).collect(),
            seconds: self.seconds(),
            ..Checkpoint::default()
        };
        checkpoint.store(&self.executor, &self.adam, self.average.as_ref());
        checkpoint
    }

    /// Restores the state of a run.
    ///
    /// # Errors
    /// [`TrainError::Checkpoint`] when the checkpoint belongs to another run or is incomplete.
    pub fn resume(&mut self, checkpoint: &Checkpoint) -> Result<(), TrainError> {
        let sizes: Vec<usize> = checkpoint.scenes.iter().map(|&size| size as usize).collect();
        if sizes.len() == self.dataset.sizes().len() && sizes != self.dataset.sizes() {
            self.dataset.limit(&sizes);
            self.update_scenes()?;
        }
        if checkpoint.settings != self.fingerprint {
            let (theirs, ours) = (checkpoint.settings.clone(), self.fingerprint.clone());
            return Err(CheckpointError::Settings { theirs, ours }.into());
        }
        let sums = LossSums::from_list(&checkpoint.sums).ok_or(CheckpointError::Sums(checkpoint.sums.len()))?;
        checkpoint.restore(&self.executor, &mut self.adam, self.average.as_ref())?;
        self.epoch = checkpoint.epoch;
        self.batch = checkpoint.batch;
        self.sums = sums;
        (self.started, self.seconds_before) = (Instant::now(), checkpoint.seconds);
        Ok(())
    }

    /// Trains until the end of the epoch, until the time of the run is over, or until `stop` is set. After every step it
    /// calls `report` with the number of completed steps of the epoch and their mean loss.
    ///
    /// # Errors
    /// [`TrainError`] when the network or the loss fails.
    pub fn epoch(&mut self, stop: &AtomicBool, mut report: impl FnMut(u64, f64)) -> Result<EpochOutcome, TrainError> {
        let start = Instant::now();
        let plan = self.plan();
        let settings = self.settings.clone();
        let TrainingSettings { batch, accumulate, .. } = settings;
        let plan: Vec<&[Example]> = plan.chunks(batch).skip(self.batch as usize).collect();
        let mut volumes = 0;
        let mut learning_rate = 0.0;
        // Moved out of `self`, because the steps borrow `self` mutably, and moved back below.
        let dataset = std::mem::replace(&mut self.dataset, Dataset::empty());
        let mut teacher = self.teacher.take();
        let device = self.executor.device();
        let batch_teacher = teacher.as_mut();
        let done: Result<bool, TrainError> = read_ahead(&dataset, &plan, &settings, device, batch_teacher, |batches| {
            let mut remaining = plan.len();
            while remaining > 0 && !(self.batch > 0 && self.is_over()) {
                if stop.load(Ordering::Relaxed) {
                    return Ok(false);
                }
                let passes = accumulate.min(remaining);
                let minutes = self.seconds() / 60.0;
                learning_rate = self.settings.learning_rate_at(self.steps(), self.steps_per_epoch(), minutes);
                volumes += self.step((&mut *batches).take(passes), passes, learning_rate)?;
                remaining -= passes;
                self.batch += passes as u64;
                report(self.batch.div_ceil(accumulate as u64), self.sums.loss());
            }
            Ok(true)
        });
        (self.dataset, self.teacher) = (dataset, teacher);
        if !done? {
            return Ok(EpochOutcome::Interrupted);
        }
        let seconds = start.elapsed().as_secs_f64();
        let sums = std::mem::take(&mut self.sums);
        self.epoch += 1;
        self.batch = 0;
        Ok(EpochOutcome::Completed(Box::new(EpochRecord {
            epoch: self.epoch,
            steps: self.steps(),
            learning_rate,
            loss: sums.loss(),
            loss_quality: sums.quality / sums.voxels,
            loss_rotation: sums.rotation / sums.voxels,
            loss_width: sums.width / sums.voxels,
            loss_occupancy: sums.occupancy(),
            validation: self.with_average(Self::validate)?,
            benchmark: None,
            seconds,
            volumes_per_second: volumes as f64 / seconds,
        })))
    }

    /// One step over `passes` batches, whose gradients are averaged. Returns the number of volumes.
    fn step(
        &mut self,
        batches: impl Iterator<Item = Result<Batch, TrainError>>,
        passes: usize,
        learning_rate: f64,
    ) -> Result<usize, TrainError> {
        let (mut volumes, mut has_gradient) = (0, false);
        for batch in batches {
            let batch = batch?;
            volumes += batch.len;
            let Some(Loss { mean, sums }) = self.loss(&batch)? else { continue };
            if !sums.loss().is_finite() {
                return Err(self.diverged());
            }
            (mean / passes as f64).f_backward()?;
            self.sums.add(&sums);
            has_gradient = true;
        }
        if has_gradient {
            self.adam.step(self.executor.parameters(), learning_rate);
            if let Some(average) = &mut self.average {
                average.update(self.executor.parameters(), self.adam.steps());
            }
        }
        Ok(volumes)
    }

    /// The results on the validation scenes, without augmentation; `None` if there are none.
    fn validate(&self) -> Result<Option<Validation>, TrainError> {
        let scenes: Vec<_> = self.validation.iter().map(|&scene| Example { scene, ..Example::default() }).collect();
        let plan: Vec<&[Example]> = scenes.chunks(self.settings.batch).collect();
        let device = self.executor.device();
        read_ahead(&self.dataset, &plan, &self.settings, device, None, |batches| {
            let mut sums = LossSums::default();
            for batch in batches {
                if let Some(loss) = no_grad(|| self.loss(&batch?))? {
                    sums.add(&loss.sums);
                }
            }
            Ok(Validation::from_sums(&sums))
        })
    }

    /// The scenes of an epoch in their order, with their augmentation: a function of the seed and the epoch.
    fn plan(&self) -> Vec<Example> {
        let stream = |number| {
            let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed);
            rng.set_stream(number);
            rng
        };
        // The teacher's voxels use a separate stream, so that order and augmentation are the same with a teacher.
        let (mut rng, mut voxel_rng) = (stream(self.epoch), stream(!self.epoch));
        let mut scenes = self.training.clone();
        scenes.shuffle(&mut rng);
        let mut example = |scene| Example {
            scene,
            volume: rng.random_range(0..self.dataset.volumes(scene)),
            transform: self.settings.augmentation.draw(&mut rng),
            voxel_seed: voxel_rng.random(),
        };
        scenes.into_iter().map(&mut example).collect()
    }

    /// The loss of one forward pass; `None` if no trial of the scenes is inside its volume. The mean includes the
    /// teacher's outputs and the occupancy; the sums of grasps contain only trials.
    fn loss(&self, batch: &Batch) -> Result<Option<Loss>, TrainError> {
        if batch.targets.is_empty() {
            return Ok(None);
        }
        let (trials, teacher_outputs) = (batch.targets.len(), batch.teacher_targets.len());
        let voxels = [batch.targets.voxels(), batch.teacher_targets.voxels()].concat();
        let inside = batch.occupancy.voxels();
        let (outputs, logits) = if inside.is_empty() {
            (self.executor.forward_at(&batch.volumes, &voxels)?, None)
        } else {
            let (outputs, logits) = self.executor.forward_with_occupancy(&batch.volumes, &voxels, inside)?;
            (outputs, Some(logits))
        };
        let Loss { mut mean, mut sums } =
            self.checked(batch.targets.loss(&outputs.narrow(0, trials), &self.weights))?;
        if teacher_outputs > 0 {
            // Without class weights: the teacher was trained with its own.
            let weights = LossWeights { rotation: self.settings.rotation_weight, ..LossWeights::default() };
            let teacher_loss =
                self.checked(batch.teacher_targets.loss(&outputs.narrow(trials, teacher_outputs), &weights))?;
            mean += teacher_loss.mean * self.teacher_weight;
        }
        if let Some(logits) = logits {
            let loss = batch.occupancy.loss(&logits)?;
            sums.occupancy_voxels = inside.len() as f64;
            sums.occupancy = loss.double_value(&[]);
            mean += loss * (self.settings.occupancy / inside.len() as f64);
        }
        Ok(Some(Loss { mean, sums }))
    }

    fn checked(&self, loss: Result<Loss, LossError>) -> Result<Loss, TrainError> {
        match loss {
            Err(LossError::NotANumber) => Err(self.diverged()),
            loss => Ok(loss?),
        }
    }

    fn diverged(&self) -> TrainError {
        TrainError::Diverged { step: self.steps() }
    }
}

/// Class weights that give both classes the same total weight: n / (2 n_class).
fn class_weights(dataset: &Dataset, scenes: &[usize]) -> Result<[f64; 2], TrainError> {
    let (all, successes) = dataset.grasps(scenes);
    if successes == 0 || successes == all {
        let reason = format!("--balance needs successes and failures, but {successes} of {all} grasps succeeded");
        return Err(TrainError::Settings(reason));
    }
    Ok([all - successes, successes].map(|count| all as f64 / (2 * count) as f64))
}
