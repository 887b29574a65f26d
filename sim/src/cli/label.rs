use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use grasp::{RESOLUTION, WORKSPACE_SIZE};
use grasp_data::{Setup, Trial, packed, processed, raw};
use grasp_sim::export::{Export, Line};
use grasp_sim::label::LabelledScene;
use grasp_sim::ordered;
use indicatif::{ProgressBar, ProgressStyle};

use super::data::DataArgs;
use super::refuse_looks;

/// The same seed gives the same data on any number of threads. An interrupted run continues where it stopped, also with
/// a larger number of scenes.
#[derive(Args)]
pub struct Label {
    #[command(flatten)]
    data: DataArgs,

    /// Number of scenes.
    #[arg(long)]
    scenes: u64,

    /// Number of the first scene. To share the work, give each machine its own range and join the results with `merge`.
    #[arg(long, default_value_t = 0)]
    first: u64,

    /// Grasp points per scene, each tried at six yaws.
    #[arg(long, default_value_t = 120)]
    points: usize,

    /// Observations of each scene, with different views and noise; more than one needs the packed format.
    #[arg(long, default_value_t = 1)]
    observations: usize,

    #[arg(long, hide = true, value_parser = refuse_looks)]
    looks: Option<String>,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,

    /// Format: VGN's depth images (raw), VGN's volumes (processed), or volumes in few large files (packed).
    #[arg(long, value_enum, default_value = "packed")]
    format: Format,

    /// Also write every scene with its trials to this file, as JSON lines.
    #[arg(long)]
    export: Option<PathBuf>,
}

/// The formats of a data set.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    Raw,
    Processed,
    Packed,
}

impl Label {
    pub fn run(self) -> anyhow::Result<()> {
        let several = self.observations != 1 && self.format != Format::Packed;
        anyhow::ensure!(
            !several && self.observations > 0,
            "--observations is {}, must be greater than 0; only --format packed stores more than 1",
            self.observations
        );
        anyhow::ensure!(
            self.export.is_none() || self.data.stretch.is_none(),
            "--export names the objects of each scene, and does not describe stretched ones; leave out --stretch"
        );
        let config = self.data.config(self.points, self.observations)?;
        let setup = Setup::benchmark(self.data.provenance(&config));
        let mut writer = Writer::open(self.format, &self.out, &setup)?;
        let next = writer.next().unwrap_or(0).max(self.first);
        let mut export = self.export.as_deref().map(|path| Export::open(path, next)).transpose()?;

        let end =
            self.first.checked_add(self.scenes).context("--first + --scenes exceeds 2^64 - 1; use smaller numbers")?;
        let style = "{wide_bar} {pos}/{len} scenes, {per_sec}, {eta} left";
        let progress = ProgressBar::new(self.scenes).with_style(ProgressStyle::with_template(style)?);
        progress.set_position(next - self.first);
        progress.reset_eta();
        ordered::for_each(
            next..end.max(next),
            |number| config.label(number),
            |number, scene| {
                if let Some(scene) = scene {
                    if let Some(export) = &mut export {
                        export.append(&Line::of(number, &scene))?;
                    }
                    writer.append(number, scene)?;
                }
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        Ok(())
    }
}

enum Writer {
    Raw(raw::Writer),
    Processed(processed::Writer),
    Packed(packed::Writer),
}

impl Writer {
    fn open(format: Format, folder: &Path, setup: &Setup) -> anyhow::Result<Self> {
        Ok(match format {
            Format::Raw => Self::Raw(raw::Writer::open(folder, setup)?),
            Format::Processed => Self::Processed(processed::Writer::open(folder, setup)?),
            Format::Packed => Self::Packed(packed::Writer::open(folder, setup)?),
        })
    }

    fn next(&self) -> Option<u64> {
        match self {
            Self::Raw(writer) => writer.next(),
            Self::Processed(writer) => writer.next(),
            Self::Packed(writer) => writer.next(),
        }
    }

    fn append(&mut self, number: u64, mut scene: LabelledScene) -> anyhow::Result<()> {
        let trials = |unit: f64| -> Vec<Trial> { scene.points.iter().map(|point| point.trial(unit)).collect() };
        let voxel_size = WORKSPACE_SIZE / RESOLUTION as f64;
        let id = format!("{number:08}");
        match self {
            Self::Raw(writer) => writer.append(&id, &scene.observations[0].views, &trials(1.0))?,
            Self::Processed(writer) => writer.append(&id, &scene.observations[0].volume, &trials(voxel_size))?,
            Self::Packed(writer) => {
                let trials = trials(voxel_size);
                let volumes: Vec<Vec<f32>> =
                    scene.observations.drain(..).map(|observation| observation.volume).collect();
                writer.append(number, &volumes, &trials)?;
            }
        }
        Ok(())
    }
}
