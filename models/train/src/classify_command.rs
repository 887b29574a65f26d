//! The command `classify`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use grasp::gpd::Image;
use grasp_models::gpd::{describe, gpd};
use grasp_models::onnx::ModelProto;
use grasp_models::{
    Classifier, ClassifierKind, Options, coarse_evaluator, evaluator, with_coarse_evaluator, without_coarse_evaluator,
};
use grasp_train::{
    CandidateDataset, ClassifierMetrics, ClassifierSettings, ClassifierTrainer, Examples, ProposalDataset, ScoredPoses,
};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use time::OffsetDateTime;

use crate::device::{self, DeviceChoice};

/// Prints one JSON object per epoch. Keeps the model with the smallest validation loss, or the last without validation.
#[derive(Args)]
pub(crate) struct Classify {
    /// Classifier.
    #[arg(long, value_enum, default_value = "gpd")]
    network: Kind,
    /// Name of the network whose grasps the evaluator scores.
    #[arg(long, required_if_eq("network", "evaluator"))]
    proposals_of: Option<String>,
    /// The evaluator whose predictions a coarse evaluator is trained on. The output has both.
    #[arg(long, required_if_eq("network", "coarse-evaluator"))]
    teacher: Option<PathBuf>,
    /// Start from the weights of this classifier instead of random ones.
    #[arg(long)]
    from: Option<PathBuf>,
    /// Files of `grasp-sim candidates`, or for evaluators folders of `grasp-sim proposals`; several are mixed.
    #[arg(long, required = true, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Output file of the classifier.
    #[arg(long)]
    out: PathBuf,
    /// Number of epochs.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..))]
    epochs: u64,
    /// Candidates per step.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u16).range(1..))]
    batch: u16,
    /// Adam's initial learning rate; it falls to 0 along half a cosine.
    #[arg(long, default_value_t = 1e-3)]
    lr: f64,
    /// Decoupled weight decay.
    #[arg(long, default_value_t = 0.0)]
    weight_decay: f64,
    /// Share of the scenes used for validation.
    #[arg(long, default_value_t = 0.1)]
    val: f64,
    /// Seed of the random weights and the order of the candidates.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Compute convolutions and matrix products in bf16.
    #[arg(long)]
    bf16: bool,
    /// Version of the classifier in its metadata. A coarse evaluator keeps that of its evaluator.
    #[arg(long, default_value = "1")]
    model_version: String,
    /// Device: cpu, cuda, cuda:N, or auto: the first GPU, or the CPU if there is none.
    #[arg(long, default_value = "auto")]
    device: DeviceChoice,
    /// Threads of libtorch [default: all cores].
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

/// The classifiers.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// GPD's classifier, of candidates on the point cloud.
    Gpd,
    /// The evaluator of the poses of a network's grasps.
    Evaluator,
    /// A faster one, which chooses the poses that the evaluator scores.
    CoarseEvaluator,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Gpd => "gpd",
            Self::Evaluator => "evaluator",
            Self::CoarseEvaluator => "coarse-evaluator",
        }
    }

    fn build(self, seed: u64) -> ModelProto {
        match self {
            Self::Gpd => gpd(seed),
            Self::Evaluator => evaluator(seed),
            Self::CoarseEvaluator => coarse_evaluator(seed),
        }
    }
}

/// A line of the output: the metrics of an epoch.
#[derive(Serialize)]
struct ClassifierEpochRecord {
    epoch: u64,
    training: ClassifierMetrics,
    validation: Option<ClassifierMetrics>,
}

impl Classify {
    pub fn run(&self) -> Result<()> {
        if let Some(threads) = self.threads {
            tch::set_num_threads(threads.into());
        }
        ensure!((0.0..1.0).contains(&self.val), "--val is {}, must be at least 0 and less than 1", self.val);
        ensure!(self.weight_decay >= 0.0, "--weight-decay is {}, must be at least 0", self.weight_decay);
        ensure!(self.lr > 0.0, "--lr is {}, must be greater than 0", self.lr);
        ensure!(
            self.network == Kind::Evaluator || self.proposals_of.is_none(),
            "--proposals-of is of evaluators, and {} is not one",
            self.network.name()
        );
        ensure!(
            self.network == Kind::CoarseEvaluator || self.teacher.is_none(),
            "--teacher is of coarse evaluators, and {} is not one",
            self.network.name()
        );
        if let Some(folder) = self.out.parent() {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let examples = self.examples()?;
        let examples = examples.as_ref();
        let settings = ClassifierSettings {
            epochs: self.epochs,
            batch: usize::from(self.batch),
            learning_rate: self.lr,
            weight_decay: self.weight_decay,
            validation: self.val,
            seed: self.seed,
            // GPD's classifier ranks candidates. The evaluator predicts a probability, so its classes keep their
            // frequencies.
            balance: self.network == Kind::Gpd,
            bf16: self.bf16,
        };
        let device = self.device.device()?;
        let mut trainer = ClassifierTrainer::new(self.initial_classifier()?, examples, settings, device)?;
        let (training, held_out) = trainer.candidates();
        ensure!(training > 0, "--val is {}, which leaves no scene for training; use a smaller share", self.val);
        eprintln!(
            "{training} training candidates, {held_out} validation candidates, {} successes",
            examples.successes()
        );
        eprintln!("device: {}", device::name(device));

        let mut best = f64::INFINITY;
        for epoch in 1..=self.epochs {
            let bar = self.progress_bar(trainer.steps_per_epoch(), epoch)?;
            let training = trainer.epoch(|| bar.inc(1))?;
            bar.finish_and_clear();
            let record = ClassifierEpochRecord { epoch, training, validation: trainer.validate()? };
            println!("{}", serde_json::to_string(&record)?);
            let losses =
                [Some(record.training), record.validation].map(|metrics| metrics.map_or(0.0, |metrics| metrics.loss));
            ensure!(
                losses.into_iter().all(f64::is_finite),
                "the loss is not finite after epoch {epoch}; use a smaller --lr than {}",
                self.lr
            );
            let loss = record.validation.map_or(f64::NEG_INFINITY, |validation| validation.loss);
            if loss <= best {
                best = loss;
                self.write(&trainer, examples, &record)?;
            }
        }
        Ok(())
    }

    fn examples(&self) -> Result<Box<dyn Examples>> {
        Ok(match (self.network, &self.teacher) {
            (Kind::Gpd, _) => Box::new(CandidateDataset::read(&self.data, &Image::SHAPE)?),
            (Kind::CoarseEvaluator, Some(teacher)) => {
                let tried = ProposalDataset::read(&self.data)?;
                eprintln!("{} scores poses at and around {} grasps", name(teacher), tried.len());
                // The fastest backend computes what the reference computes.
                let options = Options { threads: self.threads.map(Into::into), provider: None, ..Options::default() };
                let mut evaluator = Classifier::load(teacher, ClassifierKind::Evaluator, &options)?;
                Box::new(ScoredPoses::new(tried, &mut evaluator, self.seed)?)
            }
            _ => Box::new(ProposalDataset::read(&self.data)?),
        })
    }

    /// The classifier before the first step.
    fn initial_classifier(&self) -> Result<ModelProto> {
        let random = self.network.build(self.seed);
        let Some(path) = &self.from else { return Ok(random) };
        let model = without_coarse_evaluator(&ModelProto::read(path)?);
        let nodes = |model: &ModelProto| model.graph.as_ref().map(|graph| graph.node.clone());
        ensure!(
            nodes(&model) == nodes(&random),
            "--from {}: the graph is not that of {}; give a classifier that `grasp-train classify --network {}` wrote",
            path.display(),
            self.network.name(),
            self.network.name()
        );
        Ok(model)
    }

    fn progress_bar(&self, steps: u64, epoch: u64) -> Result<ProgressBar> {
        let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {elapsed} (left {eta})")?;
        let prefix = format!("epoch {epoch}/{}", self.epochs);
        Ok(ProgressBar::new(steps).with_style(style).with_prefix(prefix))
    }

    /// Writes the classifier with the provenance of its weights.
    fn write(
        &self,
        trainer: &ClassifierTrainer,
        examples: &dyn Examples,
        record: &ClassifierEpochRecord,
    ) -> Result<()> {
        let mut provenance = BTreeMap::new();
        let mut note = |key: &str, value: String| provenance.insert(key.to_owned(), value);
        note("architecture", self.network.name().to_owned());
        note("data", self.data.iter().map(|path| name(path)).collect::<Vec<_>>().join(" "));
        note("candidates", examples.len().to_string());
        note("successes", examples.successes().to_string());
        note("epochs", record.epoch.to_string());
        note("batch", self.batch.to_string());
        note("learning_rate", self.lr.to_string());
        note("weight_decay", self.weight_decay.to_string());
        note("bf16", self.bf16.to_string());
        note("seed", self.seed.to_string());
        for (key, path) in [("from", &self.from), ("teacher", &self.teacher)] {
            if let Some(path) = path {
                note(key, name(path));
            }
        }
        note("date", OffsetDateTime::now_utc().date().to_string());
        note("trainer", format!("grasp-train {}", env!("CARGO_PKG_VERSION")));
        if let Some(validation) = record.validation {
            note("validation", serde_json::to_string(&validation)?);
        }
        let mut model = trainer.model();
        describe(&mut model, &name(&self.out), &self.model_version, self.proposals_of.as_deref(), &provenance);
        if let Some(teacher) = &self.teacher {
            model = with_coarse_evaluator(&ModelProto::read(teacher)?, &model);
        }
        Ok(model.write(&self.out)?)
    }
}

/// The name of a model or data file.
fn name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
