//! Trains grasp networks, or writes one with random weights.

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

/// Trains the networks of graspd in libtorch by executing the very ONNX graph that is served.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Writes a network with random weights.
    Init {
        /// vgn, transformer, transformer-small, or gpd, the classifier of grasp candidates.
        #[arg(long)]
        network: String,
        /// What a grasp network regresses of a grasp's orientation.
        #[arg(long, value_enum, default_value_t = Regressed::Quaternion)]
        orientation: Regressed,
        /// Decides the weights.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// The file to write.
        #[arg(long)]
        out: PathBuf,
    },
    /// Trains a network on folders of scenes and grasps.
    Train(Box<Training>),
    /// Trains GPD's classifier on tried candidates.
    Classify(classify::Classify),
    /// Writes a network with its weights in another precision.
    Export(export::Export),
    /// Times a network in libtorch's eager mode, in which published networks are usually run.
    Time(time::Time),
}

/// How a network is trained. Where VGN's training and the paper's differ, the default follows the network.
#[derive(Args)]
struct Training {
    /// vgn, transformer or transformer-small, from random weights.
    #[arg(long, required_unless_present = "from")]
    network: Option<String>,
    /// What --network regresses of a grasp's orientation: a quaternion, as published, or approach and closing axes,
    /// which do not jump.
    #[arg(long, value_enum, default_value_t = Regressed::Quaternion, conflicts_with = "from")]
    orientation: Regressed,
    /// Start from this model's weights instead (fine-tuning).
    #[arg(long, conflicts_with = "network")]
    from: Option<PathBuf>,
    /// Folders of `grasp-sim label`, or in the processed format of VGN and GIGA (grasps.csv, scenes/ID.npz); several are
    /// mixed.
    #[arg(long, required = true, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Before every epoch, take in the scenes that were added to the folders meanwhile.
    #[arg(long)]
    follow: bool,
    /// The model to write. Beside it: .state to resume from, .jsonl with one object an epoch, .png with the curves.
    #[arg(long)]
    out: PathBuf,
    /// Go on from the .state beside the model.
    #[arg(long)]
    resume: bool,
    /// Write what is needed to resume no more often than this, seconds, but at the end and at Ctrl-C. By default after every
    /// epoch: a large network takes seconds to write, a fast card no more for an epoch.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    save_every: f64,
    /// Times every scene is seen [default: 30 for vgn, 21 for the transformers].
    #[arg(long)]
    epochs: Option<u64>,
    /// Scenes in a step [default: 32 for vgn, 64 for the transformers].
    #[arg(long)]
    batch: Option<usize>,
    /// Batches whose gradients make a step together.
    #[arg(long, default_value_t = 1)]
    accumulate: usize,
    /// Adam's learning rate [default: 3e-4 for vgn, 1e-4 for the transformers].
    #[arg(long)]
    lr: Option<f64>,
    /// Steps over which the learning rate rises from 0.
    #[arg(long, default_value_t = 0)]
    warmup: u64,
    /// Let the learning rate fall to 0 along half a cosine.
    #[arg(long)]
    cosine: bool,
    /// What is taken off the weights in every step, times the learning rate (AdamW).
    #[arg(long, default_value_t = 0.0)]
    weight_decay: f64,
    /// Validate and write a moving average of the weights that keeps this share of itself in every step, such as 0.999.
    #[arg(long)]
    ema: Option<f64>,
    /// Decides the random weights, the order of the scenes and how they are changed.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Share of the scenes that are held out to validate on.
    #[arg(long, default_value_t = 0.1)]
    val: f64,
    /// Which weights the model holds in the end: the last, as in the paper, or the best: by --evaluate, else by the
    /// validation loss.
    #[arg(long, value_enum, default_value_t = Keep::Last)]
    keep: Keep,
    /// Try the model with this command, in which {} stands for its file, and which prints objects with `gsr` and `dr`:
    /// `grasp-sim bench --planner {} --rounds 40`.
    #[arg(long, value_name = "COMMAND")]
    evaluate: Option<String>,
    /// Do so after every so many epochs, and after the last.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    evaluate_every: u64,
    /// Stop when the model was not better than the best so often in a row, by --evaluate, else by the validation loss.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    patience: Option<u64>,
    /// Where in its voxel a grasp stands: corner as in VGN, or center, which keeps turned and mirrored scenes exact
    /// [default: center, or what the model given by --from says].
    #[arg(long, value_enum)]
    voxel_origin: Option<Origin>,
    /// How scenes are changed at random, separated by commas: turns about z, mirror images, shifts along z.
    #[arg(long, value_enum, value_delimiter = ',')]
    augment: Vec<Change>,
    /// Largest shift along z, voxels.
    #[arg(long, default_value_t = 2)]
    max_shift: u32,
    /// Weigh failures and successes the same, however many there are of each, instead of leaving it to the data.
    #[arg(long)]
    balance: bool,
    /// What the quality is learnt from: label, whether a grasp held, or share, the share of its tries with small pose
    /// errors that held, a probability. In data of one try a grasp both are the same.
    /// Rotation and width do not depend on it.
    #[arg(long, value_enum, default_value_t = Target::Label)]
    quality: Target,
    /// What the rotation counts for in the loss, against quality and width.
    #[arg(long, default_value_t = 1.0)]
    rotation_weight: f64,
    /// Learn from this trained model, too: from its answers in front of surfaces, beside the trials.
    #[arg(long, value_name = "MODEL")]
    teacher: Option<PathBuf>,
    /// What the teacher's answers count for in the loss, against the trials.
    #[arg(long, default_value_t = 1.0, requires = "teacher")]
    teacher_weight: f64,
    /// Compute convolutions and matrix products in bf16.
    #[arg(long)]
    bf16: bool,
    /// Where to compute: cpu, cuda, cuda:N, or auto, the first card if there is one.
    #[arg(long, default_value = "auto")]
    device: device::Choice,
    /// The model's name in its metadata [default: the file's].
    #[arg(long)]
    name: Option<String>,
    /// The model's version in its metadata.
    #[arg(long, default_value = "1")]
    model_version: String,
    /// Threads libtorch computes with [default: all].
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
