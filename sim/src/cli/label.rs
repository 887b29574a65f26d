use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::{Args, ValueEnum};
use grasp::{RESOLUTION, WORKSPACE_SIZE};
use grasp_data::{DataFormat, Setup, Trial, packed, processed, raw, scene_id, scene_number};
use grasp_sim::export::{Export, Line};
use grasp_sim::label::{LabelledScene, SceneConfig};
use grasp_sim::ordered;

use super::data::DataArgs;
use super::progress;

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
    /// An interrupted run needs the same number again.
    #[arg(long, default_value_t = 0)]
    first: u64,

    /// Grasp points per scene, each tried at six yaws.
    #[arg(long, default_value_t = 120)]
    points: usize,

    /// Observations of each scene, with different views and noise; more than one needs the packed format.
    #[arg(long, default_value_t = 1)]
    observations: usize,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,

    /// Format: VGN's depth images (raw), VGN's volumes (processed), or volumes in few large files (packed).
    #[arg(long, value_enum, default_value = "packed")]
    format: Format,

    /// Also write every scene with its trials to this file, as JSON lines. A run that continues needs the file of the
    /// interrupted one.
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
        ensure!(self.scenes > 0, "--scenes is 0, must be greater than 0");
        let several = self.observations != 1 && self.format != Format::Packed;
        ensure!(
            !several && self.observations > 0,
            "--observations is {}, must be greater than 0; only --format packed stores more than 1",
            self.observations
        );
        ensure!(
            self.export.is_none() || (self.data.stretch.is_none() && self.data.clearance.is_none()),
            "--export names the objects of each scene, and does not describe stretched or resized ones; leave out \
             --stretch and --clearance"
        );
        let config = self.data.config(self.points, self.observations)?;
        let setup = Setup::benchmark(self.data.provenance(&config));
        // Before the folder is opened, because the writers remove an incomplete scene.
        self.check_continuation(&config)?;
        let mut writer = Writer::open(self.format, &self.out, &setup)?;
        let next = writer.next().unwrap_or(self.first);
        let mut export = self.export.as_deref().map(|path| Export::open(path, next)).transpose()?;

        let end =
            self.first.checked_add(self.scenes).context("--first + --scenes exceeds 2^64 - 1; use smaller numbers")?;
        // Of this run alone: the scenes of an earlier one would count as the work of a moment.
        let progress = progress::of_scenes(end.saturating_sub(next))?;
        eprintln!("writing to {}; after an interrupt the same command continues", self.out.display());
        ordered::for_each(
            next..end.max(next),
            |number| self.label(&config, number),
            |number, scene| {
                if let Some(scene) = scene {
                    if let Some(export) = &mut export {
                        export.append(&Line::new(number, &scene))?;
                    }
                    writer.append(number, scene)?;
                }
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        eprintln!("scenes {} to {} are in {}", self.first, end.saturating_sub(1), self.out.display());
        Ok(())
    }

    /// Labels a scene. It has depth images only if the format stores them, because they are larger than the volumes and
    /// many scenes wait to be written.
    fn label(&self, config: &SceneConfig, number: u64) -> Option<LabelledScene> {
        let mut scene = config.label(number)?;
        if self.format != Format::Raw {
            scene.observations.iter_mut().for_each(|observation| observation.views = Vec::new());
        }
        Some(scene)
    }

    /// Checks that this run continues that of the output folder, if there is one, without missing scenes.
    fn check_continuation(&self, config: &SceneConfig) -> anyhow::Result<()> {
        if self.out.is_dir()
            && let Ok(found) = DataFormat::from_folder(&self.out)
            && found != self.format.of_data()
        {
            bail!("{} has scenes in another format; use another --out, or the same --format", self.out.display());
        }
        let Some((first, last)) = self.format.stored(&self.out)? else {
            let is_new = |export: &PathBuf| fs::metadata(export).map_or(true, |file| file.len() == 0);
            if let Some(export) = self.export.as_ref().filter(|export| !is_new(export)) {
                bail!(
                    "--export {} already exists, but {} has no scenes; use another file",
                    export.display(),
                    self.out.display()
                );
            }
            return Ok(());
        };
        // Scenes whose cameras see no object are not stored, and do not count as missing.
        let mut unstored = (self.first..first).chain(last + 1..self.first);
        if let Some(missing) = unstored.find(|&number| config.label(number).is_some()) {
            bail!(
                "--first is {}, but {} has scenes from {first} to {last}, and scene {missing} would be missing; use a \
                 number from {first} to {}, or another --out",
                self.first,
                self.out.display(),
                last + 1
            );
        }
        if let Some(export) = &self.export {
            ensure!(
                Export::last(export)? >= Some(last),
                "--export {} lacks scenes that are already in {}; use another --out, or leave out --export",
                export.display(),
                self.out.display()
            );
        }
        Ok(())
    }
}

impl Format {
    fn of_data(self) -> DataFormat {
        match self {
            Self::Raw => DataFormat::Raw,
            Self::Processed => DataFormat::Processed,
            Self::Packed => DataFormat::Packed,
        }
    }

    /// The numbers of the first and the last scene in a folder, if it has any.
    fn stored(self, folder: &Path) -> anyhow::Result<Option<(u64, u64)>> {
        if !folder.exists() {
            return Ok(None);
        }
        let numbers: Vec<u64> = match self {
            Self::Packed => {
                let reader = packed::Reader::open(folder)?;
                (0..reader.len()).map(|index| reader.number(index)).collect()
            }
            Self::Raw | Self::Processed => scene_files(&folder.join("scenes"))?,
        };
        Ok(numbers.iter().min().copied().zip(numbers.iter().max().copied()))
    }
}

/// The numbers of the scenes' files in a folder, which may not exist.
fn scene_files(folder: &Path) -> anyhow::Result<Vec<u64>> {
    if !folder.exists() {
        return Ok(Vec::new());
    }
    let mut numbers = Vec::new();
    for file in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let name = file.with_context(|| folder.display().to_string())?.file_name();
        numbers.extend(name.to_str().and_then(|name| scene_number(name.strip_suffix(".npz")?)));
    }
    Ok(numbers)
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
        let id = scene_id(number);
        match self {
            Self::Raw(writer) => writer.append(&id, &scene.observations[0].views, &trials(1.0))?,
            Self::Processed(writer) => writer.append(&id, &scene.observations[0].volume, &trials(voxel_size))?,
            Self::Packed(writer) => {
                let trials = trials(voxel_size);
                let volumes: Vec<Vec<f32>> =
                    scene.observations.drain(..).map(|observation| observation.volume).collect();
                writer.append(number, &volumes, &trials, Some(&scene.occupancy))?;
            }
        }
        Ok(())
    }
}
