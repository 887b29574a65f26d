use grasp_models::gpd::OUTPUT;
use grasp_models::onnx::ModelProto;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tch::{Device, Kind, Tensor, no_grad};

use crate::{Adam, Examples, ExecuteError, Execution, Executor};

/// Trains the classifier of grasp candidates: cross-entropy in which failures and successes weigh the same, however
/// many there are of each, and Adam.
pub struct Learner<'a> {
    executor: Executor,
    adam: Adam,
    examples: &'a Examples,
    /// What it learns from; the order is drawn anew each epoch.
    learnt: Vec<i64>,
    held_out: Vec<i64>,
    /// By class.
    weight: Tensor,
    settings: ClassifierSettings,
    rng: ChaCha8Rng,
}

/// How a classifier is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassifierSettings {
    /// Candidates in a step.
    pub batch: usize,
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Share of the scenes that are held out.
    pub validation: f64,
    /// Decides the order in which candidates are seen.
    pub seed: u64,
    /// Convolutions and matrix products in bf16.
    pub bf16: bool,
}

/// How a classifier does on some candidates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tally {
    /// Mean loss, the classes weighing the same.
    pub loss: f64,
    /// Share of the candidates that are classified rightly.
    pub accuracy: f64,
    /// Share of successes among those taken for successes.
    pub precision: f64,
    /// Share of the successes that are taken for such.
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
        let (learnt, held_out) = examples.split(validation);
        let weight = examples.classes(&learnt).map(|count| learnt.len() as f32 / (2.0 * count.max(1) as f32));
        let weight = Tensor::from_slice(&weight).to_device(executor.device());
        let adam = Adam::new(executor.parameters(), 0.0);
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Ok(Self { executor, adam, examples, learnt, held_out, weight, settings, rng })
    }

    /// How many candidates it learns from, and how many are held out.
    #[must_use]
    pub fn candidates(&self) -> (usize, usize) {
        (self.learnt.len(), self.held_out.len())
    }

    /// Steps in an epoch.
    #[must_use]
    pub fn steps_per_epoch(&self) -> u64 {
        self.learnt.len().div_ceil(self.settings.batch) as u64
    }

    /// Learns from every candidate once; `progress` is called after each step. How it did while it learnt.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn epoch(&mut self, mut progress: impl FnMut()) -> Result<Tally, ExecuteError> {
        self.learnt.shuffle(&mut self.rng);
        let mut counts = Counts::default();
        for indices in self.learnt.chunks(self.settings.batch) {
            let loss = counts.add(&self.executor, self.examples, &self.weight, indices)?;
            loss.backward();
            self.adam.step(self.executor.parameters(), self.settings.learning_rate);
            progress();
        }
        Ok(counts.tally())
    }

    /// How it does on what is held out; `None` if nothing is.
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

    /// The model with the weights as they are now.
    #[must_use]
    pub fn model(&self) -> ModelProto {
        self.executor.to_model()
    }
}

/// Candidates by what they were taken for and what they are.
#[derive(Default)]
struct Counts {
    /// `[taken for a success][is one]`.
    candidates: [[f64; 2]; 2],
    loss: f64,
    weight: f64,
}

impl Counts {
    /// Classifies some candidates, counts them, and returns the mean loss, under autograd.
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
        let taken = scores.argmax(1, false);
        for [taken_for, is] in [[0, 0], [0, 1], [1, 0], [1, 1]] {
            let both = taken.eq(taken_for).logical_and(&classes.eq(is));
            self.candidates[taken_for as usize][is as usize] += both.sum(Kind::Double).double_value(&[]);
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
