//! The command line, one file a command.

mod bench;
mod candidates;
mod convert;
mod demo;
mod label;
mod merge;
mod objects;
mod observe;
mod reliability;
mod replay;
mod stats;
mod tables;

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use clap::{Args, Parser, ValueEnum};
use grasp_picture::{Picture, object_color};
use grasp_sim::camera::Views;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::physics::World;
use grasp_sim::scene::SceneKind;

/// Simulated clutter for grasp detection: scenes, labels, benchmarks.
#[derive(Parser)]
#[command(version)]
pub enum Command {
    /// Make scenes, try grasps in them, and write what came of it as training data.
    Label(label::Label),
    /// Observe labelled scenes again: the same scenes and trials, other views and other noise.
    Observe(observe::Observe),
    /// Is now `observe`.
    #[command(hide = true, disable_help_flag = true)]
    Look {
        #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true)]
        _rest: Vec<String>,
    },
    /// Turn a data set into another form.
    Convert(convert::Convert),
    /// Join what several machines have labelled.
    Merge(merge::Merge),
    /// Count what is in a data set.
    Stats(stats::Stats),
    /// Try exported grasps again, also those of another simulator.
    Replay(replay::Replay),
    /// Draw objects, or write them as URDF and OBJ.
    Objects(objects::Objects),
    /// Make scenes, fit the hand to what is seen of them, try it, and write images and labels for GPD's classifier.
    Candidates(candidates::Candidates),
    /// Clear tables with a planner and say how well it did.
    Bench(bench::Bench),
    /// Compare the quality of executed grasps with what became of them.
    Reliability(reliability::ReliabilityArgs),
    /// Regenerate the tables of the paper.
    Tables(tables::Tables),
    /// One scene, from the depth camera through a server of its own to the lifted object.
    Demo(demo::Demo),
}

impl Command {
    /// Does what was asked.
    pub fn run(self) -> anyhow::Result<()> {
        match self {
            Self::Label(command) => command.run(),
            Self::Observe(command) => command.run(),
            Self::Look { .. } => bail!(renamed("look", "observe")),
            Self::Convert(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Stats(command) => command.run(),
            Self::Replay(command) => command.run(),
            Self::Objects(command) => command.run(),
            Self::Candidates(command) => command.run(),
            Self::Bench(command) => command.run(),
            Self::Reliability(command) => command.run(),
            Self::Tables(command) => command.run(),
            Self::Demo(command) => command.run(),
        }
    }
}

/// What scenes are made of and seen with.
#[derive(Args, Clone)]
struct SceneArgs {
    /// How objects are put on the table.
    #[arg(long, value_enum, default_value = "packed")]
    scene: Scene,

    /// The objects: our own, `train`, `test` or `generated` (a new one at every draw), or a folder of URDF files [default:
    /// train to label, else test].
    #[arg(long, value_parser = parse_objects)]
    objects: Option<String>,

    /// Of the folder's files by name, `validation` is every fifth, and `train` the others.
    #[arg(long, value_enum, default_value = "all")]
    part: Part,

    /// The cameras: `side[:DEGREES]` (the paper's one view, turned about the vertical), `circle` (six from above), or
    /// `random:MIN-MAX` (so many from any azimuth, 20–75° off the vertical). Of several, separated by commas, one is
    /// drawn for each observation.
    #[arg(long, default_value = "side", value_parser = parse_camera_words)]
    views: String,

    /// Share of the observations that carry the benchmark's depth noise.
    #[arg(long, default_value_t = 1.0, value_parser = parse_share)]
    noise: f64,

    /// Seed of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Part {
    All,
    Train,
    Validation,
}

impl Part {
    /// What a report says after the folder.
    fn suffix(self) -> &'static str {
        match self {
            Self::All => "",
            Self::Train => " (train)",
            Self::Validation => " (validation)",
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Scene {
    Pile,
    Packed,
}

impl Scene {
    fn kind(self) -> SceneKind {
        match self {
            Self::Pile => SceneKind::Pile,
            Self::Packed => SceneKind::Packed,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Pile => "pile",
            Self::Packed => "packed",
        }
    }

    fn objects(self, name: &str) -> anyhow::Result<ObjectSet> {
        Ok(match (name, self) {
            // What data sets say that were made before the word was changed.
            ("generated" | "endless", _) => ObjectSet::generated(),
            ("train", _) => ObjectSet::procedural(Split::Train),
            ("test", Self::Pile) => ObjectSet::procedural(Split::PileTest),
            ("test", Self::Packed) => ObjectSet::procedural(Split::PackedTest),
            (folder, _) => ObjectSet::load(&PathBuf::from(folder))?,
        })
    }
}

impl SceneArgs {
    fn kind(&self) -> SceneKind {
        self.scene.kind()
    }

    fn objects(&self, default: &str) -> anyhow::Result<ObjectSet> {
        let name = self.objects.as_deref().unwrap_or(default);
        let objects = self.scene.objects(name)?;
        let is_kept: fn(usize) -> bool = match self.part {
            Part::All => return Ok(objects),
            Part::Train => |index| index % 5 != 4,
            Part::Validation => |index| index % 5 == 4,
        };
        ensure!(
            PathBuf::from(name).is_dir(),
            "--part takes a part of a folder of URDF files, not of --objects `{name}`"
        );
        let part = objects.listed().iter().enumerate().filter(|(index, _)| is_kept(*index));
        ObjectSet::of(part.map(|(_, object)| Arc::clone(object)).collect())
            .with_context(|| format!("--objects is {name}: it has too few files for this --part"))
    }

    fn views(&self) -> anyhow::Result<Views> {
        parse_views(&self.views).with_context(|| format!("--views is `{}`: use {VIEWS}", self.views))
    }
}

/// A word of the command line that has another name now.
fn renamed(old: &str, new: &str) -> String {
    format!("`{old}` is now `{new}`")
}

fn parse_objects(text: &str) -> Result<String, String> {
    if text == "endless" { Err(renamed("endless", "generated")) } else { Ok(text.to_owned()) }
}

fn parse_camera_words(text: &str) -> Result<String, String> {
    if text.contains("anywhere") { Err(renamed("anywhere", "random")) } else { Ok(text.to_owned()) }
}

/// Refuses `--looks`.
fn refuse_looks(_: &str) -> Result<String, String> {
    Err(renamed("--looks", "--observations"))
}

fn parse_share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "must be from 0 to 1".to_owned())
}

/// How cameras are written.
const VIEWS: &str = "side, side:90, circle, random:1-6, or several with commas between";

fn parse_views(text: &str) -> Option<Views> {
    if text.contains(',') {
        return text.split(',').map(parse_views).collect::<Option<_>>().map(Views::OneOf);
    }
    let (name, rest) = text.split_once(':').unwrap_or((text, ""));
    match name {
        "side" if rest.is_empty() => Some(Views::Side { azimuth: 0.0 }),
        "side" => Some(Views::Side { azimuth: rest.parse::<f64>().ok()?.to_radians() }),
        "circle" if rest.is_empty() => Some(Views::Circle),
        // What data sets say that were made before the word was changed.
        "random" | "anywhere" => {
            let (min, max) = rest.split_once('-').unwrap_or((rest, rest));
            let (min, max) = (min.parse().ok()?, max.parse().ok()?);
            (1 <= min && min <= max).then_some(Views::Random(min..=max))
        }
        _ => None,
    }
}

/// Adds the objects of a scene to a picture, each in its colour.
fn show<'a>(picture: &'a mut Picture, world: &World) -> &'a mut Picture {
    for (index, body) in world.objects().iter().enumerate() {
        picture.mesh(&body.object.visual, &world.pose(body.id), body.scale, object_color(index));
    }
    picture
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_read_as_written() {
        assert_eq!(parse_views("side"), Some(Views::Side { azimuth: 0.0 }));
        assert_eq!(parse_views("side:180"), Some(Views::Side { azimuth: std::f64::consts::PI }));
        assert_eq!(parse_views("circle"), Some(Views::Circle));
        assert_eq!(parse_views("random:1-6"), Some(Views::Random(1..=6)));
        assert_eq!(parse_views("random:2"), Some(Views::Random(2..=2)));
        let one_of = Views::OneOf(vec![Views::Random(1..=1), Views::Circle]);
        assert_eq!(parse_views("random:1,circle"), Some(one_of));
        for wrong in ["", "top", "side:x", "anywhere", "random:0-2", "random:3-2", "circle:1", "side,", "side,top"] {
            assert_eq!(parse_views(wrong), None, "{wrong}");
        }
    }
}
