use grasp_models::gpd::OUTPUT;
use grasp_models::onnx::ModelProto;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tch::{Device, Kind, Tensor, no_grad};

use crate::{Adam, Examples, ExecuteError, Execution, Executor};

/// Trains the classifier of grasp candidates with Adam and class-balanced cross-entropy.
pub struct Learner<'a> {
    executor: Executor,
    adam: Adam,
    examples: &'a Examples,
    /// Indices of the training candidates, shuffled in each epoch.
    training: Vec<i64>,
    held_out: Vec<i64>,
    /// Weights of the classes.
    weight: Tensor,
    settings: ClassifierSettings,
    rng: ChaCha8Rng,
}

/// How a classifier is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassifierSettings {
    /// Candidates per step.
    pub batch: usize,
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Share of the scenes used for validation.
    pub validation: f64,
    /// Seed of the order of the candidates.
    pub seed: u64,
    /// Computes convolutions and matrix products in bf16.
    pub bf16: bool,
}

/// Metrics of a classifier.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tally {
    /// Mean class-balanced loss.
    pub loss: f64,
    /// Share of correctly classified candidates.
    pub accuracy: f64,
    /// Share of successes among the predicted successes.
    pub precision: f64,
    /// Share of the successes that are predicted.
    pub recall: f64,
}

impl<'a> Learner<'a> {
    /// Prepares to train `model` on `examples`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that cannot be executed.
    pub fn new(model: ModelProto, examples: &'a Examples, settings: ClassifierSettings) -> Result<Self, ExecuteError> {
        let ClassifierSettings { validation, seed, bf16, .. } = settings;
        let execution = Execution { device: Device::cuda_if_available(), bf16, channels_last: false };
        let executor = Executor::new(model, execution)?;
        let (training, held_out) = examples.split(validation);
        let weight = examples.classes(&training).map(|count| training.len() as f32 / (2.0 * count.max(1) as f32));
        let weight = Tensor::from_slice(&weight).to_device(executor.device());
        let adam = Adam::new(executor.parameters(), 0.0);
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Ok(Self { executor, adam, examples, training, held_out, weight, settings, rng })
    }

    /// Number of training and validation candidates.
    #[must_use]
    pub fn candidates(&self) -> (usize, usize) {
        (self.training.len(), self.held_out.len())
    }

    /// Steps in an epoch.
    #[must_use]
    pub fn steps_per_epoch(&self) -> u64 {
        self.training.len().div_ceil(self.settings.batch) as u64
    }

    /// Trains on every candidate once and returns the metrics during training. `progress` is called after each step.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn epoch(&mut self, mut progress: impl FnMut()) -> Result<Tally, ExecuteError> {
        self.training.shuffle(&mut self.rng);
        let mut counts = Counts::default();
        for indices in self.training.chunks(self.settings.batch) {
            let loss = counts.add(&self.executor, self.examples, &self.weight, indices)?;
            loss.backward();
            self.adam.step(self.executor.parameters(), self.settings.learning_rate);
            progress();
        }
        Ok(counts.tally())
    }

    /// The metrics on the validation candidates; `None` if there are none.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn validate(&self) -> Result<Option<Tally>, ExecuteError> {
        let mut counts = Counts::default();
        for indices in self.held_out.chunks(self.settings.batch) {
            let _ = no_grad(|| counts.add(&self.executor, self.examples, &self.weight, indices))?;
        }
        Ok((!self.held_out.is_empty()).then(|| counts.tally()))
    }

    /// The model with the current weights.
    #[must_use]
    pub fn model(&self) -> ModelProto {
        self.executor.to_model()
    }
}

/// Confusion matrix and loss.
#[derive(Default)]
struct Counts {
    /// `[predicted success][success]`.
    candidates: [[f64; 2]; 2],
    loss: f64,
    weight: f64,
}

impl Counts {
    /// Classifies candidates, counts them and returns the mean loss with its gradient graph.
    fn add(
        &mut self,
        executor: &Executor,
        examples: &Examples,
        weight: &Tensor,
        indices: &[i64],
    ) -> Result<Tensor, ExecuteError> {
        let (images, classes) = examples.batch(indices);
        let (images, classes) = (images.to_device(executor.device()), classes.to_device(executor.device()));
        let scores = executor.output(&images, OUTPUT)?;
        let loss = scores.cross_entropy_loss(&classes, Some(weight), tch::Reduction::Mean, -100, 0.0);
        let batch_weight = weight.index_select(0, &classes).sum(Kind::Double).double_value(&[]);
        self.loss += loss.double_value(&[]) * batch_weight;
        self.weight += batch_weight;
        let predictions = scores.argmax(1, false);
        for [predicted, actual] in [[0, 0], [0, 1], [1, 0], [1, 1]] {
            let both = predictions.eq(predicted).logical_and(&classes.eq(actual));
            self.candidates[predicted as usize][actual as usize] += both.sum(Kind::Double).double_value(&[]);
        }
        Ok(loss)
    }

    fn tally(&self) -> Tally {
        let [[right_failures, missed], [false_alarms, right_successes]] = self.candidates;
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        Tally {
            loss: share(self.loss, self.weight),
            accuracy: share(right_failures + right_successes, self.candidates.iter().flatten().sum()),
            precision: share(right_successes, right_successes + false_alarms),
            recall: share(right_successes, right_successes + missed),
        }
    }
}
