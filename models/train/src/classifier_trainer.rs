use grasp_models::gpd::OUTPUT;
use grasp_models::onnx::ModelProto;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tch::{Device, Kind, Tensor, no_grad};

use crate::{Adam, ExecuteError, ExecutionOptions, Executor};

/// The training data of a classifier.
pub trait Examples {
    /// Number of examples.
    fn len(&self) -> usize;

    /// Whether there are no examples.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The class of an example. Class 0 is failure, all others are successes.
    fn class(&self, index: usize) -> usize;

    /// Number of classes.
    fn classes(&self) -> usize;

    /// The probabilities of the classes of an example that a classifier is trained to predict.
    fn target(&self, index: usize) -> Vec<f32> {
        let class = self.class(index);
        (0..self.classes()).map(|other| if other == class { 1.0 } else { 0.0 }).collect()
    }

    /// The scene of an example. Its examples are either all for training or all for validation. Scenes of several files
    /// with one name are not distinguished: with the same seed they are the same scene.
    fn scene(&self, index: usize) -> String;

    /// The images of examples, f32 `[n, shape…]` in [0, 1]: mirrored along x and the closing axis as `mirrored` says, if
    /// a mirrored grasp has the same class.
    fn images(&self, indices: &[i64], mirrored: [bool; 2]) -> Tensor;

    /// Number of successes.
    fn successes(&self) -> usize {
        (0..self.len()).filter(|&index| self.class(index) > 0).count()
    }

    /// Indices of the training and the validation examples. Validation has all examples of about `fraction` of the
    /// scenes, chosen by a hash of the scene.
    fn split(&self, fraction: f64) -> (Vec<i64>, Vec<i64>) {
        (0..self.len() as i64).partition(|&index| {
            let hash = Sha256::digest(self.scene(index as usize));
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
    }
}

/// Trains a classifier of grasp candidates with Adam and cross-entropy.
pub struct ClassifierTrainer<'a> {
    executor: Executor,
    adam: Adam,
    dataset: &'a dyn Examples,
    /// Indices of the training candidates, shuffled in each epoch.
    training: Vec<i64>,
    /// Indices of the validation candidates.
    validation: Vec<i64>,
    /// Weight of each class in the loss: n / (classes · n_class) with `balance`, else 1.
    class_weights: Tensor,
    settings: ClassifierSettings,
    rng: ChaCha8Rng,
}

/// How a classifier is trained.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassifierSettings {
    /// Number of epochs, over which the learning rate falls to 0 along half a cosine.
    pub epochs: u64,
    /// Candidates per step.
    pub batch: usize,
    /// Adam's initial learning rate.
    pub learning_rate: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Share of the scenes used for validation.
    pub validation: f64,
    /// Seed of the order of the candidates.
    pub seed: u64,
    /// Whether failures and successes have the same total weight. Without it the predicted probability is that of the
    /// data.
    pub balance: bool,
    /// Computes convolutions and matrix products in bf16.
    pub bf16: bool,
}

/// Metrics of a classifier over the training or the validation candidates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClassifierMetrics {
    /// Mean loss.
    pub loss: f64,
    /// Share of correctly classified candidates.
    pub accuracy: f64,
    /// Share of successes among the predicted successes.
    pub precision: f64,
    /// Share of the successes that are predicted.
    pub recall: f64,
}

impl<'a> ClassifierTrainer<'a> {
    /// Prepares to train `model` on `dataset`.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node that cannot be executed.
    pub fn new(
        model: ModelProto,
        dataset: &'a dyn Examples,
        settings: ClassifierSettings,
        device: Device,
    ) -> Result<Self, ExecuteError> {
        let ClassifierSettings { validation, seed, balance, bf16, .. } = settings;
        let execution = ExecutionOptions { device, bf16, channels_last: false };
        let executor = Executor::new(model, execution)?;
        let (training, validation) = dataset.split(validation);
        let class_weight = |class| {
            let count = training.iter().filter(|&&index| dataset.class(index as usize) == class).count();
            let balanced = training.len() as f32 / (dataset.classes() * count.max(1)) as f32;
            if balance { balanced } else { 1.0 }
        };
        let class_weights: Vec<f32> = (0..dataset.classes()).map(class_weight).collect();
        let class_weights = Tensor::from_slice(&class_weights).to_device(executor.device());
        let adam = Adam::new(executor.parameters(), settings.weight_decay);
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Ok(Self { executor, adam, dataset, training, validation, class_weights, settings, rng })
    }

    /// Number of training and validation candidates.
    #[must_use]
    pub fn candidates(&self) -> (usize, usize) {
        (self.training.len(), self.validation.len())
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
    pub fn epoch(&mut self, mut progress: impl FnMut()) -> Result<ClassifierMetrics, ExecuteError> {
        self.training.shuffle(&mut self.rng);
        let mut sums = MetricSums::default();
        for indices in self.training.chunks(self.settings.batch) {
            let mirrored = [self.rng.random(), self.rng.random()];
            let (images, targets) = self.batch(indices, mirrored);
            let loss = sums.add(&self.executor, &self.class_weights, &images, &targets)?;
            loss.backward();
            let learning_rate = self.learning_rate();
            self.adam.step(self.executor.parameters(), learning_rate);
            progress();
        }
        Ok(sums.metrics())
    }

    /// The images and targets, f32 `[n, classes]`, of examples.
    fn batch(&self, indices: &[i64], mirrored: [bool; 2]) -> (Tensor, Tensor) {
        let targets: Vec<f32> = indices.iter().flat_map(|&index| self.dataset.target(index as usize)).collect();
        let targets = Tensor::from_slice(&targets).reshape([indices.len() as i64, -1]);
        (self.dataset.images(indices, mirrored), targets)
    }

    /// The learning rate of the next step.
    fn learning_rate(&self) -> f64 {
        let steps = (self.settings.epochs * self.steps_per_epoch()).max(1);
        let progress = (self.adam.steps() as f64 / steps as f64).min(1.0);
        self.settings.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
    }

    /// The metrics on the validation candidates; `None` if there are none.
    ///
    /// # Errors
    /// [`ExecuteError`] names the node at which it failed.
    pub fn validate(&self) -> Result<Option<ClassifierMetrics>, ExecuteError> {
        let mut sums = MetricSums::default();
        for indices in self.validation.chunks(self.settings.batch) {
            let (images, targets) = self.batch(indices, [false; 2]);
            let _ = no_grad(|| sums.add(&self.executor, &self.class_weights, &images, &targets))?;
        }
        Ok((!self.validation.is_empty()).then(|| sums.metrics()))
    }

    /// The model with the current weights.
    #[must_use]
    pub fn model(&self) -> ModelProto {
        self.executor.to_model()
    }
}

/// Confusion matrix and weighted sum of the loss, from which the metrics are computed.
#[derive(Default)]
struct MetricSums {
    /// Number of candidates, `[predicted success][success]`.
    confusion: [[f64; 2]; 2],
    loss: f64,
    weight: f64,
}

impl MetricSums {
    /// Classifies candidates and adds their results. Returns the mean loss, from which gradients can be computed.
    fn add(
        &mut self,
        executor: &Executor,
        class_weights: &Tensor,
        images: &Tensor,
        targets: &Tensor,
    ) -> Result<Tensor, ExecuteError> {
        let (images, targets) = (images.to_device(executor.device()), targets.to_device(executor.device()));
        let scores = executor.output(&images, OUTPUT)?;
        let weights = &targets * class_weights;
        let total = weights.sum(Kind::Float);
        let loss = -(scores.log_softmax(1, Kind::Float) * &weights).sum(Kind::Float) / &total;
        let batch_weight = total.double_value(&[]);
        self.loss += loss.double_value(&[]) * batch_weight;
        self.weight += batch_weight;
        let predicts_success = scores.softmax(1, Kind::Float).select(1, 0).lt(0.5);
        let is_success = targets.select(1, 0).lt(0.5);
        for [predicted, actual] in [[0, 0], [0, 1], [1, 0], [1, 1]] {
            let both = predicts_success.eq(predicted).logical_and(&is_success.eq(actual));
            self.confusion[predicted as usize][actual as usize] += both.sum(Kind::Double).double_value(&[]);
        }
        Ok(loss)
    }

    fn metrics(&self) -> ClassifierMetrics {
        let [[true_negatives, false_negatives], [false_positives, true_positives]] = self.confusion;
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        ClassifierMetrics {
            loss: share(self.loss, self.weight),
            accuracy: share(true_negatives + true_positives, self.confusion.iter().flatten().sum()),
            precision: share(true_positives, true_positives + false_positives),
            recall: share(true_positives, true_positives + false_negatives),
        }
    }
}
