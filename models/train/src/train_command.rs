//! The command `train`: runs the training, writes its files, shows its progress and handles Ctrl-C.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use grasp::{RESOLUTION, VoxelOrigin};
use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use grasp_models::{Architecture, Metadata, Options};
use grasp_train::{
    Augmentation, BenchmarkRates, Checkpoint, EpochOutcome, EpochRecord, ExecutionOptions, Teacher, Trainer,
    TrainingSettings, learning_curves,
};
use indicatif::{ProgressBar, ProgressStyle};
use time::OffsetDateTime;

use crate::device;
use crate::external_evaluation::{PLACEHOLDER, evaluate};
use crate::{AugmentArg, KeptWeights, TrainArgs, VoxelOriginArg};

/// Trains until the last epoch, until the patience is used up, or until Ctrl-C.
pub(crate) fn train(training: &TrainArgs) -> Result<()> {
    if let Some(threads) = training.threads {
        tch::set_num_threads(threads.into());
    }
    ensure!((0.0..1.0).contains(&training.val), "--val is {}, must be at least 0 and less than 1", training.val);
    ensure!(training.save_every >= 0.0, "--save-every is {}, must be at least 0 seconds", training.save_every);
    ensure!(training.weight_decay >= 0.0, "--weight-decay is {}, must be at least 0", training.weight_decay);
    ensure!(training.rotation_weight >= 0.0, "--rotation-weight is {}, must be at least 0", training.rotation_weight);
    ensure!(training.occupancy >= 0.0, "--occupancy is {}, must be at least 0", training.occupancy);
    if let Some(lr) = training.lr {
        ensure!(lr > 0.0, "--lr is {lr}, must be greater than 0");
    }
    if let Some(minutes) = training.minutes {
        ensure!(minutes > 0.0, "--minutes is {minutes}, must be greater than 0");
    }
    if let Some(decay) = training.ema {
        ensure!((0.0..1.0).contains(&decay), "--ema is {decay}, must be at least 0 and less than 1");
    }
    ensure!(
        training.val > 0.0
            || training.evaluate.is_some()
            || training.patience.is_none() && training.keep == KeptWeights::Last,
        "--patience and --keep best need results; give --evaluate, or --val greater than 0"
    );
    ensure!(
        training.max_shift.is_none() || training.augment.contains(&AugmentArg::Shift),
        "--max-shift needs --augment shift"
    );
    ensure!(
        !training.follow || !training.cosine || training.minutes.is_some(),
        "--cosine with --follow needs --minutes, because the number of steps is not known"
    );
    if let Some(command) = &training.evaluate {
        ensure!(
            command.contains(PLACEHOLDER),
            "--evaluate is `{command}`, must contain {PLACEHOLDER} in place of the model's file"
        );
    }
    let files = RunFiles::beside(&training.out)?;
    let (model, mut metadata) = initial_network(training)?;
    let settings = settings(training, &metadata);
    let dataset = Dataset::open(&training.data)?;
    ensure!(
        dataset.resolution() == metadata.resolution,
        "--data has volumes of {0}³ voxels, but the network needs {1}³",
        dataset.resolution(),
        metadata.resolution
    );
    ensure!(!training.follow || dataset.is_packed(), "--follow needs packed data sets");
    let device = training.device.device()?;
    // Channels last is faster on CPUs; on a GPU only channels first was measured.
    let execution = ExecutionOptions { device, bf16: training.bf16, channels_last: !device.is_cuda() };
    let mut trainer = Trainer::new(model, dataset, settings.clone(), execution)?;
    if let Some(path) = &training.teacher {
        let (teacher, name) = load_teacher(training, path, &metadata)?;
        trainer = trainer.with_teacher(teacher);
        metadata.provenance.insert("teacher".to_owned(), name);
    }

    let save = |trainer: &Trainer, best: BestResult, unevaluated: bool| {
        let checkpoint = Checkpoint {
            best: best.cost,
            results_since_best: best.results_since,
            evaluated: training.evaluate.is_some(),
            keeps_best: training.keep == KeptWeights::Best,
            unevaluated,
            ..trainer.checkpoint()
        };
        checkpoint.write(&files.state)
    };
    let mut records = Vec::new();
    let mut best = BestResult::default();
    if training.resume {
        let checkpoint = Checkpoint::read(&files.state)?;
        trainer.resume(&checkpoint)?;
        ensure!(
            checkpoint.best.is_none() || checkpoint.evaluated == training.evaluate.is_some(),
            "the best result of the checkpoint is that of {}; give the same options, or start without --resume",
            if checkpoint.evaluated { "--evaluate" } else { "the validation loss, without --evaluate" }
        );
        ensure!(
            training.keep == KeptWeights::Last || checkpoint.keeps_best,
            "--keep best needs a run that was started with it: the file has the last weights, not the best"
        );
        best = BestResult { cost: checkpoint.best, results_since: checkpoint.results_since_best };
        records = files.read_log(trainer.epochs())?;
        if checkpoint.unevaluated
            && let (Some(command), Some(record)) = (&training.evaluate, records.last_mut())
        {
            add_provenance(training, &settings, trainer.dataset(), &mut metadata);
            write_model(&mut trainer, &metadata, Some(record), &files.evaluated)?;
            record.benchmark = Some(evaluate(command, &files.evaluated)?);
            // As below.
            let _ = writeln!(std::io::stdout(), "{}", serde_json::to_string(record)?);
            if best.update(training, record) {
                write_model(&mut trainer, &metadata, Some(record), &training.out)?;
            }
            files.write_log(&records)?;
            save(&trainer, best, false)?;
        }
    }
    ensure!(
        trainer.scenes().1 > 0
            || training.evaluate.is_some()
            || training.patience.is_none() && training.keep == KeptWeights::Last,
        "--val is {}, which leaves no scene for the validation that --patience and --keep best need; use a larger one",
        training.val
    );
    print_counts(&trainer);
    eprintln!("device: {}", device::name(device));

    let stop = Arc::new(AtomicBool::new(false));
    let signal = Arc::clone(&stop);
    ctrlc::set_handler(move || signal.store(true, Ordering::Relaxed))
        .context("cannot install the handler of Ctrl-C")?;

    let mut saved = Instant::now();
    let continues = |trainer: &Trainer, results_since: u64| {
        trainer.epochs() < settings.epochs
            && !trainer.is_over()
            && training.patience.is_none_or(|patience| results_since < patience)
    };
    while continues(&trainer, best.results_since) {
        if training.follow && trainer.follow()? > 0 {
            print_counts(&trainer);
        }
        let bar = progress_bar(trainer.steps_per_epoch(), trainer.epochs() + 1, &settings);
        let epoch = trainer.epoch(&stop, |batch, loss| {
            bar.set_position(batch);
            bar.set_message(format!("{loss:.4}"));
        })?;
        bar.finish_and_clear();
        let mut better = best.cost.is_none();
        let mut interrupted = matches!(epoch, EpochOutcome::Interrupted);
        // Returned after the checkpoint is written, so that the epoch is not lost.
        let mut failure = None;
        let mut unevaluated = false;
        if let EpochOutcome::Completed(mut record) = epoch {
            add_provenance(training, &settings, trainer.dataset(), &mut metadata);
            let last = trainer.epochs() == settings.epochs || trainer.is_over();
            let due = last || trainer.epochs().is_multiple_of(training.evaluate_every);
            if let Some(command) = training.evaluate.as_deref().filter(|_| due) {
                write_model(&mut trainer, &metadata, Some(&record), &files.evaluated)?;
                match evaluate(command, &files.evaluated) {
                    Ok(rates) => record.benchmark = Some(rates),
                    // Ctrl-C also ends the command.
                    Err(_) if stop.load(Ordering::Relaxed) => interrupted = true,
                    Err(error) => failure = Some(error),
                }
                unevaluated = record.benchmark.is_none();
            }
            // A reader that has closed the pipe does not end the run.
            let _ = writeln!(std::io::stdout(), "{}", serde_json::to_string(&record)?);
            better = best.update(training, &record);
            records.push(*record);
            let drawn = files.write_log(&records).and_then(|()| learning_curves::draw(&files.curves, &records));
            failure = failure.or(drawn.err());
        }
        let ends = interrupted || failure.is_some() || !continues(&trainer, best.results_since);
        let due = ends || saved.elapsed().as_secs_f64() >= training.save_every;
        if better || training.keep == KeptWeights::Last && due {
            add_provenance(training, &settings, trainer.dataset(), &mut metadata);
            write_model(&mut trainer, &metadata, records.last(), &training.out)?;
        }
        if due {
            save(&trainer, best, unevaluated)?;
            saved = Instant::now();
        }
        if let Some(error) = failure {
            return Err(error);
        }
        if interrupted {
            eprintln!("stopped after step {}; continue with --resume", trainer.steps());
            return Ok(());
        }
    }
    Ok(())
}

/// The best result so far.
#[derive(Clone, Copy, Default)]
struct BestResult {
    /// Smallest cost.
    cost: Option<f64>,
    /// Consecutive results without a smaller cost.
    results_since: u64,
}

impl BestResult {
    /// Adds an epoch and returns whether it is the best so far. An epoch without a cost is the best if no epoch had one.
    fn update(&mut self, training: &TrainArgs, record: &EpochRecord) -> bool {
        let cost = match (&training.evaluate, record.benchmark) {
            // Failed grasps and objects left on the table have the same weight.
            (Some(_), rates) => rates.map(|BenchmarkRates { gsr, dr }| 1.0 - (gsr + dr) / 2.0),
            (None, _) => record.validation.map(|validation| validation.loss),
        };
        let Some(cost) = cost else { return self.cost.is_none() };
        let better = self.cost.is_none_or(|best| cost < best);
        *self = if better {
            Self { cost: Some(cost), results_since: 0 }
        } else {
            Self { results_since: self.results_since + 1, ..*self }
        };
        better
    }
}

fn print_counts(trainer: &Trainer) {
    let (training, held_out) = trainer.scenes();
    let (grasps, successes) = count_grasps(trainer.dataset());
    eprintln!("{training} training scenes, {held_out} validation scenes, {grasps} grasps, {successes} successes");
}

fn count_grasps(dataset: &Dataset) -> (usize, usize) {
    dataset.grasps(&(0..dataset.len()).collect::<Vec<_>>())
}

/// The initial network and its metadata.
fn initial_network(training: &TrainArgs) -> Result<(ModelProto, Metadata)> {
    let model = match (&training.from, &training.network) {
        (Some(path), _) => ModelProto::read(path)?,
        (None, Some(network)) => {
            let architecture: Architecture = network.parse()?;
            architecture.build_with(RESOLUTION, training.orientation.into(), training.seed)?
        }
        (None, None) => anyhow::bail!("give --network or --from"),
    };
    let path = training.from.as_deref().unwrap_or(&training.out);
    let mut metadata = Metadata::from_model(&model, path).with_context(|| path.display().to_string())?;
    // The rest is about the weights before this run.
    metadata.provenance.retain(|key, _| ["architecture", "orientation"].contains(&key.as_str()));
    let file_name = Metadata::defaults(&training.out, None).name;
    metadata.name = training.name.clone().unwrap_or(file_name);
    metadata.version.clone_from(&training.model_version);
    if training.augment.contains(&AugmentArg::Rotate) {
        // The network sees cameras from all sides.
        metadata.camera_azimuth = None;
    }
    metadata.voxel_origin = match training.voxel_origin {
        Some(VoxelOriginArg::Corner) => VoxelOrigin::Corner,
        Some(VoxelOriginArg::Center) => VoxelOrigin::Center,
        None if training.from.is_some() => metadata.voxel_origin,
        None => VoxelOrigin::Center,
    };
    Ok((model, metadata))
}

/// Loads the teacher. Returns it with its name, version and weight as a text for the metadata.
fn load_teacher(training: &TrainArgs, path: &Path, student: &Metadata) -> Result<(Teacher, String)> {
    let weight = training.teacher_weight;
    ensure!(weight >= 0.0, "--teacher-weight is {weight}, must be at least 0");
    let teacher = Teacher::load(path, &Options::auto(1), weight)?;
    let Metadata { name, version, resolution, voxel_origin, .. } = teacher.metadata();
    ensure!(
        *resolution == student.resolution,
        "--teacher needs {resolution}³ voxels, the trained network {0}³; use a teacher of the same resolution",
        student.resolution
    );
    ensure!(
        *voxel_origin == student.voxel_origin,
        "the voxel origin of --teacher is {0}, that of the trained network is {1}; give --voxel-origin {0}",
        voxel_origin.name(),
        student.voxel_origin.name()
    );
    let name = format!("{name} {version} at {weight}");
    Ok((teacher, name))
}

/// Settings of the run. The defaults are those of VGN's released code (Adam with 3e-4, batches of 32, 30 epochs) and of
/// the paper (1e-4, 64, 21), by the architecture. With --from it is read from the metadata, by default VGN.
fn settings(training: &TrainArgs, metadata: &Metadata) -> TrainingSettings {
    let network = training.network.as_ref().or_else(|| metadata.provenance.get("architecture"));
    let is_transformer = network.is_some_and(|network| network.starts_with("transformer"));
    let (epochs, batch, learning_rate) = if is_transformer { (21, 64, 1e-4) } else { (30, 32, 3e-4) };
    /// Largest shift along z without --max-shift, voxels.
    const MAX_SHIFT: u32 = 2;
    let allows = |change| training.augment.contains(&change);
    TrainingSettings {
        epochs: training.epochs.unwrap_or(if training.minutes.is_some() { u64::MAX } else { epochs }),
        minutes: training.minutes,
        batch: training.batch.unwrap_or(batch),
        accumulate: training.accumulate,
        learning_rate: training.lr.unwrap_or(learning_rate),
        warmup: training.warmup,
        cosine: training.cosine,
        weight_decay: training.weight_decay,
        average: training.ema,
        seed: training.seed,
        validation: training.val,
        augmentation: Augmentation {
            rotate: allows(AugmentArg::Rotate),
            mirror: allows(AugmentArg::Mirror),
            shift: if allows(AugmentArg::Shift) { training.max_shift.unwrap_or(MAX_SHIFT) } else { 0 },
        },
        balance: training.balance,
        quality: training.quality.into(),
        rotation_weight: training.rotation_weight,
        occupancy: training.occupancy,
        voxel_origin: metadata.voxel_origin,
        bf16: training.bf16,
    }
}

/// Writes the provenance of the weights to the metadata.
fn add_provenance(training: &TrainArgs, settings: &TrainingSettings, dataset: &Dataset, metadata: &mut Metadata) {
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let scenes = dataset.distinct();
    let (grasps, successes) = dataset.grasps(&scenes);
    let mut note = |key: &str, value: String| metadata.provenance.insert(key.to_owned(), value);
    note("data", training.data.iter().map(name).collect::<Vec<_>>().join(" "));
    note("scenes", scenes.len().to_string());
    note("grasps", grasps.to_string());
    note("successes", successes.to_string());
    note("settings", serde_json::to_string(settings).unwrap_or_default());
    note("seed", settings.seed.to_string());
    note("date", OffsetDateTime::now_utc().date().to_string());
    note("trainer", format!("grasp-train {}", env!("CARGO_PKG_VERSION")));
    if let Some(from) = &training.from {
        note("from", name(from));
    }
}

fn write_model(trainer: &mut Trainer, metadata: &Metadata, last: Option<&EpochRecord>, path: &Path) -> Result<()> {
    let mut metadata = metadata.clone();
    let mut note = |key: &str, value: String| metadata.provenance.insert(key.to_owned(), value);
    note("epochs", trainer.epochs().to_string());
    note("steps", trainer.steps().to_string());
    if let Some(record) = last {
        note("loss", record.loss.to_string());
        if let Some(BenchmarkRates { gsr, dr }) = record.benchmark {
            note("evaluation", format!("GSR {gsr:.3}, DR {dr:.3}"));
        }
        if let Some(validation) = record.validation {
            if let Some(angle) = validation.angle {
                note("validation_angle_degrees", angle.to_string());
            }
            note("validation_loss", validation.loss.to_string());
            note("validation_accuracy", validation.accuracy.to_string());
        }
    }
    let mut model = trainer.model();
    metadata.write_to(&mut model);
    Ok(model.write(path)?)
}

fn progress_bar(steps: u64, epoch: u64, settings: &TrainingSettings) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {elapsed} (left {eta}) loss {msg}");
    let end =
        settings.minutes.map_or(format!("/{}", settings.epochs), |minutes| format!(", {minutes} minutes in all:"));
    let bar = ProgressBar::new(steps).with_prefix(format!("epoch {epoch}{end}"));
    bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// The files beside the model.
struct RunFiles {
    state: PathBuf,
    log: PathBuf,
    curves: PathBuf,
    /// The model that --evaluate reads.
    evaluated: PathBuf,
}

impl RunFiles {
    /// Creates their folder before the first epoch, so that an error does not lose the epoch.
    fn beside(model: &Path) -> Result<Self> {
        let folder = model.parent().unwrap_or(Path::new(""));
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        Ok(Self {
            state: model.with_extension("state"),
            log: model.with_extension("jsonl"),
            curves: model.with_extension("png"),
            evaluated: model.with_extension("tried"),
        })
    }

    /// The first `epochs` lines of the log.
    fn read_log(&self, epochs: u64) -> Result<Vec<EpochRecord>> {
        let text = match fs::read_to_string(&self.log) {
            Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
            text => text.with_context(|| self.log.display().to_string())?,
        };
        let records = text.lines().take(epochs as usize).map(serde_json::from_str);
        records.collect::<Result<_, _>>().with_context(|| self.log.display().to_string())
    }

    fn write_log(&self, records: &[EpochRecord]) -> Result<()> {
        let lines =
            records.iter().map(|record| Ok(serde_json::to_string(record)? + "\n")).collect::<Result<String>>()?;
        // Renamed, so that a run that is killed leaves no incomplete line.
        let partial = self.log.with_extension("jsonl.partial");
        let written = fs::write(&partial, lines).and_then(|()| fs::rename(&partial, &self.log));
        written.with_context(|| self.log.display().to_string())
    }
}
