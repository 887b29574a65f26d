//! `grasp-train`: trains and exports networks.

mod calibrate;
mod classify;
mod device;
mod evaluate;
mod export;
mod run;
mod time;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use grasp::RESOLUTION;
use grasp_models::{Architecture, Orientation, gpd};
use grasp_train::Quality;

/// Train the networks of graspd in libtorch. Training executes the same ONNX graph that is served.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Write a network with random weights.
    Init {
        /// Network: vgn, transformer, transformer-small, or gpd (the classifier of grasp candidates).
        #[arg(long)]
        network: String,
        /// Representation of the orientation that a grasp network regresses.
        #[arg(long, value_enum, default_value_t = Regressed::Quaternion)]
        orientation: Regressed,
        /// Seed of the weights.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Output file.
        #[arg(long)]
        out: PathBuf,
    },
    /// Train a grasp network on data sets.
    Train(Box<Training>),
    /// Train GPD's classifier on labelled candidates.
    Classify(classify::Classify),
    /// Convert a network to another precision.
    Export(export::Export),
    /// Measure the latency of a network in libtorch's eager mode, the usual way to run published networks.
    Time(time::Time),
}

/// Options of the training. Where VGN's training and the paper's differ, the default depends on the network.
#[derive(Args)]
struct Training {
    /// Network to train from random weights: vgn, transformer or transformer-small.
    #[arg(long, required_unless_present = "from")]
    network: Option<String>,
    /// Representation of the orientation that --network regresses: a quaternion, as published, or approach and closing
    /// axes, which are continuous.
    #[arg(long, value_enum, default_value_t = Regressed::Quaternion, conflicts_with = "from")]
    orientation: Regressed,
    /// Start from the weights of this model (fine-tuning).
    #[arg(long, conflicts_with = "network")]
    from: Option<PathBuf>,
    /// Data set folders of `grasp-sim label`, or in the processed format of VGN and GIGA (grasps.csv, scenes/ID.npz);
    /// several are mixed.
    #[arg(long, required = true, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Before every epoch, read scenes that were added to the folders.
    #[arg(long)]
    follow: bool,
    /// Output file of the model. Written beside it: .state (checkpoint), .jsonl (one record per epoch), .png (curves).
    #[arg(long)]
    out: PathBuf,
    /// Continue from the .state file beside the model.
    #[arg(long)]
    resume: bool,
    /// Shortest time between two checkpoints, seconds. The end of the run and Ctrl-C always write one. The default
    /// writes one after every epoch, which slows down short epochs of large networks.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    save_every: f64,
    /// Number of epochs [default: 30 for vgn, 21 for the transformers].
    #[arg(long)]
    epochs: Option<u64>,
    /// Scenes per batch [default: 32 for vgn, 64 for the transformers].
    #[arg(long)]
    batch: Option<usize>,
    /// Batches per step: their gradients are averaged.
    #[arg(long, default_value_t = 1)]
    accumulate: usize,
    /// Adam's learning rate [default: 3e-4 for vgn, 1e-4 for the transformers].
    #[arg(long)]
    lr: Option<f64>,
    /// Warm-up steps, in which the learning rate rises linearly from 0.
    #[arg(long, default_value_t = 0)]
    warmup: u64,
    /// Cosine schedule: the learning rate falls to 0.
    #[arg(long)]
    cosine: bool,
    /// Decoupled weight decay (AdamW); multiplied by the learning rate.
    #[arg(long, default_value_t = 0.0)]
    weight_decay: f64,
    /// Validate and write an exponential moving average of the weights with this decay per step, such as 0.999.
    #[arg(long)]
    ema: Option<f64>,
    /// Seed of the random weights, the order of the scenes and the augmentation.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Share of the scenes used for validation.
    #[arg(long, default_value_t = 0.1)]
    val: f64,
    /// Weights of the written model: the last, as in the paper, or the best by --evaluate, otherwise by the validation
    /// loss.
    #[arg(long, value_enum, default_value_t = Keep::Last)]
    keep: Keep,
    /// Evaluate the model with this command. {} is replaced by the model's file. The command must print JSON objects
    /// with `gsr` and `dr`, such as `grasp-sim bench --planner {} --rounds 40`.
    #[arg(long, value_name = "COMMAND")]
    evaluate: Option<String>,
    /// Interval of --evaluate, epochs. The last epoch is always evaluated.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    evaluate_every: u64,
    /// Stop after this many consecutive results that are not better than the best, by --evaluate, otherwise by the
    /// validation loss.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    patience: Option<u64>,
    /// Point of a voxel that a grasp refers to: corner, as in VGN, or center, with which rotated and mirrored scenes
    /// are exact [default: center, or that of the model of --from].
    #[arg(long, value_enum)]
    voxel_origin: Option<Origin>,
    /// Data augmentation, comma-separated: turns about z, mirror images, shifts along z.
    #[arg(long, value_enum, value_delimiter = ',')]
    augment: Vec<Change>,
    /// Largest shift along z, voxels.
    #[arg(long, default_value_t = 2)]
    max_shift: u32,
    /// Give failures and successes the same total weight in the loss.
    #[arg(long)]
    balance: bool,
    /// Target of the quality: label (success or failure), or share (the success rate of repetitions with small pose
    /// errors). Both are the same for data without repetitions. Rotation and width do not depend on it.
    #[arg(long, value_enum, default_value_t = Target::Label)]
    quality: Target,
    /// Weight of the rotation in the loss, relative to quality and width.
    #[arg(long, default_value_t = 1.0)]
    rotation_weight: f64,
    /// Distillation: also train on the outputs of this model in front of surfaces.
    #[arg(long, value_name = "MODEL")]
    teacher: Option<PathBuf>,
    /// Weight of the teacher's outputs in the loss, relative to the trials.
    #[arg(long, default_value_t = 1.0, requires = "teacher")]
    teacher_weight: f64,
    /// Compute convolutions and matrix products in bf16.
    #[arg(long)]
    bf16: bool,
    /// Device: cpu, cuda, cuda:N, or auto (the first GPU if there is one).
    #[arg(long, default_value = "auto")]
    device: device::Choice,
    /// Name of the model in its metadata [default: the file's name].
    #[arg(long)]
    name: Option<String>,
    /// Version of the model in its metadata.
    #[arg(long, default_value = "1")]
    model_version: String,
    /// Threads of libtorch [default: all cores].
    #[arg(long)]
    threads: Option<usize>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Keep {
    Last,
    Best,
}

#[derive(Clone, Copy, ValueEnum)]
enum Regressed {
    Quaternion,
    Axes,
}

impl From<Regressed> for Orientation {
    fn from(regressed: Regressed) -> Self {
        match regressed {
            Regressed::Quaternion => Self::Quaternion,
            Regressed::Axes => Self::Axes,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Target {
    Label,
    Share,
}

impl From<Target> for Quality {
    fn from(target: Target) -> Self {
        match target {
            Target::Label => Self::Label,
            Target::Share => Self::Share,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Origin {
    Corner,
    Center,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Change {
    Turns,
    Mirror,
    Shift,
}

fn main() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Init { network, seed, out, .. } if network == "gpd" => Ok(gpd::gpd(seed).write(&out)?),
        Command::Init { network, orientation, seed, out } => {
            let model = network.parse::<Architecture>()?.build_with(RESOLUTION, orientation.into(), seed)?;
            Ok(model.write(&out)?)
        }
        Command::Train(training) => run::train(&training),
        Command::Classify(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Time(command) => command.run(),
    }
}
