//! `grasp-train`: trains and exports networks.

mod activation_ranges;
mod classify_command;
mod device;
mod eager_latency;
mod external_evaluation;
mod onnx_export;
mod train_command;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use grasp::RESOLUTION;
use grasp_models::{Architecture, Orientation, gpd};
use grasp_train::QualityTarget;

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
        /// Representation of the orientation that a grasp network regresses [default: quaternion].
        #[arg(long, value_enum)]
        orientation: Option<OrientationArg>,
        /// Seed of the weights.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Output file.
        #[arg(long)]
        out: PathBuf,
    },
    /// Train a grasp network on data sets.
    Train(Box<TrainArgs>),
    /// Train GPD's classifier on labelled candidates, or an evaluator on tried grasps.
    Classify(classify_command::Classify),
    /// Convert a network to another precision.
    Export(onnx_export::Export),
    /// Measure the latency of a network in libtorch's eager mode.
    Time(eager_latency::EagerLatency),
}

/// Options of the training. Some defaults depend on the network: those of VGN's code, or those of the paper.
#[derive(Args)]
struct TrainArgs {
    /// Network to train from random weights: vgn, transformer or transformer-small.
    #[arg(long, required_unless_present = "from")]
    network: Option<String>,
    /// Representation of the orientation that --network regresses: a quaternion, as published, or the approach and
    /// closing axes, which are continuous.
    #[arg(long, value_enum, default_value_t = OrientationArg::Quaternion, conflicts_with = "from")]
    orientation: OrientationArg,
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
    /// Output file of the model. Written beside it: .state (checkpoint), .jsonl (one record per epoch), .png (curves), and
    /// with --evaluate .tried (the evaluated model).
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
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    epochs: Option<u64>,
    /// Time after which the run ends, minutes; its last epoch is cut short. With it the default of --epochs is no limit,
    /// and the cosine schedule follows the time instead of the steps.
    #[arg(long)]
    minutes: Option<f64>,
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
    /// Weights of the written model: the last, as in the paper, or the best. The best are selected by --evaluate if it
    /// is given, otherwise by the validation loss.
    #[arg(long, value_enum, default_value_t = KeptWeights::Last)]
    keep: KeptWeights,
    /// Evaluate the model with this command. {} is replaced by the model's file. The command must print JSON objects
    /// with `gsr` and `dr`, such as `grasp-sim bench --json --planner {} --rounds 40`.
    #[arg(long, value_name = "COMMAND")]
    evaluate: Option<String>,
    /// Interval of --evaluate, epochs. The last epoch is always evaluated.
    #[arg(long, default_value_t = 1, requires = "evaluate", value_parser = clap::value_parser!(u64).range(1..))]
    evaluate_every: u64,
    /// Stop after this many consecutive results that are not better than the best. Results are those of --evaluate if it
    /// is given, otherwise the validation loss.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    patience: Option<u64>,
    /// Position of a grasp in its voxel: corner, as in VGN, or center, with which rotated and mirrored scenes are exact
    /// [default: center, or that of the model of --from].
    #[arg(long, value_enum)]
    voxel_origin: Option<VoxelOriginArg>,
    /// Data augmentation, comma-separated: rotations about z by multiples of 90°, mirror images, shifts along z.
    #[arg(long, value_enum, value_delimiter = ',')]
    augment: Vec<AugmentArg>,
    /// Largest shift along z, voxels [default: 2].
    #[arg(long)]
    max_shift: Option<u32>,
    /// Give failures and successes the same total weight in the loss.
    #[arg(long)]
    balance: bool,
    /// Target of the quality: label (1 for a success, 0 for a failure), or share (the success rate of repetitions with
    /// small pose errors; in data of `grasp-sim proposals`, whose grasps are not repeated, 1 also for a grasp that lifted
    /// an object after a contact on the approach). Rotation and width do not depend on it.
    #[arg(long, value_enum, default_value_t = QualityTargetArg::Label)]
    quality: QualityTargetArg,
    /// Weight of the rotation in the loss, relative to quality and width.
    #[arg(long, default_value_t = 1.0)]
    rotation_weight: f64,
    /// Completion of shapes: also train a head that predicts which voxels are inside an object, with this weight in the
    /// loss, such as 1. The model does not contain the head. Scenes without their occupancy, such as those of VGN and
    /// GIGA, are used without.
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0)]
    occupancy: f64,
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
    device: device::DeviceChoice,
    /// Name of the model in its metadata [default: the file's name].
    #[arg(long)]
    name: Option<String>,
    /// Version of the model in its metadata.
    #[arg(long, default_value = "1")]
    model_version: String,
    /// Threads of libtorch [default: all cores].
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum KeptWeights {
    Last,
    Best,
}

#[derive(Clone, Copy, ValueEnum)]
enum OrientationArg {
    Quaternion,
    Axes,
}

impl From<OrientationArg> for Orientation {
    fn from(regressed: OrientationArg) -> Self {
        match regressed {
            OrientationArg::Quaternion => Self::Quaternion,
            OrientationArg::Axes => Self::Axes,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum QualityTargetArg {
    Label,
    Share,
}

impl From<QualityTargetArg> for QualityTarget {
    fn from(target: QualityTargetArg) -> Self {
        match target {
            QualityTargetArg::Label => Self::Label,
            QualityTargetArg::Share => Self::Share,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum VoxelOriginArg {
    Corner,
    Center,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum AugmentArg {
    Rotate,
    Mirror,
    Shift,
}

fn main() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Init { network, orientation, seed, out } if network == "gpd" => {
            anyhow::ensure!(orientation.is_none(), "--orientation is of grasp networks, and gpd is not one");
            Ok(gpd::gpd(seed).write(&out)?)
        }
        Command::Init { network, orientation, seed, out } => {
            let orientation = orientation.unwrap_or(OrientationArg::Quaternion).into();
            let model = network.parse::<Architecture>()?.build_with(RESOLUTION, orientation, seed)?;
            Ok(model.write(&out)?)
        }
        Command::Train(training) => train_command::train(&training),
        Command::Classify(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Time(command) => command.run(),
    }
}
