//! The command line, one file per command.

mod bench;
mod calibrate;
mod candidates;
mod convert;
mod data;
mod demo;
mod label;
mod merge;
mod objects;
mod observe;
mod progress;
mod proposals;
mod reliability;
mod replay;
mod stats;
mod tables;

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::{Args, Parser, ValueEnum};
use grasp_picture::{Picture, object_color};
use grasp_sim::camera::{self, DepthNoise, Views};
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::physics::World;
use grasp_sim::scene::SceneKind;

/// Simulation for grasp detection: scenes, labels and benchmarks.
#[derive(Parser)]
#[command(version)]
pub enum Command {
    /// Generate scenes, try grasps in them and write training data.
    Label(label::Label),
    /// Observe labelled scenes again with other views and noise; scenes and trials stay the same.
    Observe(observe::Observe),
    /// Convert a data set to another format.
    Convert(convert::Convert),
    /// Merge data sets that several machines have labelled.
    Merge(merge::Merge),
    /// Print and draw statistics of a data set.
    Stats(stats::Stats),
    /// Execute exported grasps again, also those of another simulator.
    Replay(replay::Replay),
    /// Draw objects, or write them as URDF and OBJ.
    Objects(objects::Objects),
    /// Generate scenes, try grasp candidates and write training data for a classifier of them.
    Candidates(candidates::Candidates),
    /// Generate scenes, try a network's grasps and write training data for an evaluator of them.
    Proposals(proposals::Proposals),
    /// Run the clutter-removal benchmark with planners.
    Bench(bench::Bench),
    /// Compare the predicted quality of executed grasps with their success rate.
    Reliability(reliability::ReliabilityArgs),
    /// Fit the qualities of an evaluator to the success rate of executed grasps.
    Calibrate(calibrate::Calibrate),
    /// Measure the paper's tables and write them with the published figures.
    Tables(tables::Tables),
    /// Run one scene end to end: camera, graspd, execution of the best grasp.
    Demo(demo::Demo),
}

impl Command {
    pub fn run(self) -> anyhow::Result<()> {
        match self {
            Self::Label(command) => command.run(),
            Self::Observe(command) => command.run(),
            Self::Convert(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Stats(command) => command.run(),
            Self::Replay(command) => command.run(),
            Self::Objects(command) => command.run(),
            Self::Candidates(command) => command.run(),
            Self::Proposals(command) => command.run(),
            Self::Bench(command) => command.run(),
            Self::Reliability(command) => command.run(),
            Self::Calibrate(command) => command.run(),
            Self::Tables(command) => command.run(),
            Self::Demo(command) => command.run(),
        }
    }
}

/// Scenes and their observation.
#[derive(Args, Clone)]
struct SceneArgs {
    /// Scenario: objects upright (packed) or dropped (pile).
    #[arg(long, value_enum, default_value = "packed")]
    scene: Scene,

    /// Objects: the procedural sets `train`, `test`, `containers` (cartons, cans, bottles and tubs) or `generated` (a new
    /// object at every draw), or a folder of URDF files [default: train for labels and candidates, otherwise test].
    #[arg(long)]
    objects: Option<String>,

    /// Part of the folder's files in the order of their names: `validation` is every fifth file, `train` the others.
    #[arg(long, value_enum, default_value = "all")]
    part: Part,

    /// Cameras: `side[:DEGREES]` (the paper's single view, rotated about the vertical), `side:random` (one view of the
    /// same azimuth ±5°, 30–75° from the vertical), `circle` (six views from above), or `random:MIN-MAX` (MIN to MAX
    /// views of any azimuth, 20–75° from the vertical). From a comma-separated list one entry is drawn for each
    /// observation.
    #[arg(long, default_value = "side")]
    views: String,

    /// Share of the observations with depth noise.
    #[arg(long, default_value_t = 1.0, value_parser = parse_share)]
    noise: f64,

    /// Sensor whose depth noise is simulated: that of the benchmark (dex, for Dex-Net), or a stereo camera with steps,
    /// holes and flying pixels (stereo).
    #[arg(long, value_enum, default_value = "dex")]
    sensor: Sensor,

    /// Multiply the depths of each image by one factor, so that the table is at its height, as graspd does with
    /// `Workspace.correct_depth_scale`.
    #[arg(long)]
    correct_depth_scale: bool,

    /// Random seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// A sensor of the simulator, by its name.
#[derive(Clone, Copy, ValueEnum)]
enum Sensor {
    Dex,
    Stereo,
}

impl Sensor {
    fn name(self) -> &'static str {
        match self {
            Self::Dex => "dex",
            Self::Stereo => "stereo",
        }
    }

    /// The sensor of this name in the provenance of a data set.
    fn from_name(name: &str) -> anyhow::Result<camera::Sensor> {
        Self::from_str(name, false).map(Into::into).map_err(anyhow::Error::msg)
    }
}

impl From<Sensor> for camera::Sensor {
    fn from(sensor: Sensor) -> Self {
        match sensor {
            Sensor::Dex => Self::Dex,
            Sensor::Stereo => Self::Stereo,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Part {
    All,
    Train,
    Validation,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Train => "train",
            Self::Validation => "validation",
        }
    }

    /// The objects of this part of a set that was read from the folder `name`.
    fn of(self, objects: ObjectSet, name: &str) -> anyhow::Result<ObjectSet> {
        let is_kept: fn(usize) -> bool = match self {
            Self::All => return Ok(objects),
            Self::Train => |index| index % 5 != 4,
            Self::Validation => |index| index % 5 == 4,
        };
        ensure!(PathBuf::from(name).is_dir(), "--part needs a folder of URDF files, but --objects is `{name}`");
        let part = objects.listed().iter().enumerate().filter(|(index, _)| is_kept(*index));
        ObjectSet::new(part.map(|(_, object)| Arc::clone(object)).collect())
            .with_context(|| format!("--objects {name}: too few URDF files for this --part; `validation` needs five"))
    }

    /// Suffix of the folder's name in reports.
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
            ("generated", _) => ObjectSet::generated(),
            ("train", _) => ObjectSet::procedural(Split::Train),
            ("test", Self::Pile) => ObjectSet::procedural(Split::PileTest),
            ("test", Self::Packed) => ObjectSet::procedural(Split::PackedTest),
            ("containers", _) => ObjectSet::containers(self.kind().mean_scale()),
            (folder, _) => ObjectSet::load(&PathBuf::from(folder))?,
        })
    }
}

impl SceneArgs {
    fn noise(&self) -> DepthNoise {
        DepthNoise { share: self.noise, sensor: self.sensor.into(), is_scale_corrected: self.correct_depth_scale }
    }

    fn kind(&self) -> SceneKind {
        self.scene.kind()
    }

    fn objects(&self, default: &str) -> anyhow::Result<ObjectSet> {
        let name = self.objects.as_deref().unwrap_or(default);
        self.part.of(self.scene.objects(name)?, name)
    }

    fn views(&self) -> anyhow::Result<Views> {
        parse_views(&self.views).with_context(|| format!("--views is `{}`: use {VIEWS}", self.views))
    }
}

/// Parses a quality of grasps, with the limits of the server.
fn parse_quality(text: &str) -> Result<f32, String> {
    let quality = text.parse().ok().filter(|&quality: &f32| quality > 0.0 && quality <= 1.0);
    quality.ok_or_else(|| "must be greater than 0 and at most 1".to_owned())
}

fn parse_share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "must be from 0 to 1".to_owned())
}

/// Valid values of `--views`, for error messages.
const VIEWS: &str = "side, side:90, side:random, circle, random:1-6, or a comma-separated list of these";

fn parse_views(text: &str) -> Option<Views> {
    if text.contains(',') {
        return text.split(',').map(parse_views).collect::<Option<_>>().map(Views::OneOf);
    }
    let (name, rest) = text.split_once(':').unwrap_or((text, ""));
    match name {
        "side" if rest.is_empty() => Some(Views::Side { azimuth: 0.0 }),
        "side" if rest == "random" => Some(Views::RandomSide),
        "side" => {
            let degrees: f64 = rest.parse().ok()?;
            degrees.is_finite().then(|| Views::Side { azimuth: degrees.to_radians() })
        }
        "circle" if rest.is_empty() => Some(Views::Circle),
        "random" => {
            let (min, max) = rest.split_once('-').unwrap_or((rest, rest));
            let (min, max) = (min.parse().ok()?, max.parse().ok()?);
            (1 <= min && min <= max).then_some(Views::Random(min..=max))
        }
        _ => None,
    }
}

/// Draws the objects of a scene, each in its own colour.
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
    fn views_are_parsed() {
        assert_eq!(parse_views("side"), Some(Views::Side { azimuth: 0.0 }));
        assert_eq!(parse_views("side:180"), Some(Views::Side { azimuth: std::f64::consts::PI }));
        assert_eq!(parse_views("side:random"), Some(Views::RandomSide));
        assert_eq!(parse_views("circle"), Some(Views::Circle));
        assert_eq!(parse_views("random:1-6"), Some(Views::Random(1..=6)));
        assert_eq!(parse_views("random:2"), Some(Views::Random(2..=2)));
        let one_of = Views::OneOf(vec![Views::Random(1..=1), Views::Circle]);
        assert_eq!(parse_views("random:1,circle"), Some(one_of));
        for wrong in ["", "top", "side:x", "side:nan", "side:inf", "anywhere:1", "random:0-2", "random:3-2", "circle:1"]
        {
            assert_eq!(parse_views(wrong), None, "{wrong}");
        }
        for wrong in ["side,", "side,top"] {
            assert_eq!(parse_views(wrong), None, "{wrong}");
        }
    }
}
