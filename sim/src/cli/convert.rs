use std::fs;
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use grasp::{DepthImage, Fusion, RESOLUTION};
use grasp_data::{DataFormat, Dataset, Occupancy, Setup, Trial, packed, processed, raw, scene_id, scene_number};
use grasp_sim::ordered;
use indicatif::ProgressBar;
use nalgebra::Isometry3;

use super::label::Format;

/// From raw to processed or packed: fuses the depth images and drops grasps at the borders, as VGN's scripts do. Also
/// between processed and packed. The processed format has one observation per scene.
#[derive(Args)]
pub struct Convert {
    /// Input folder: a data set of VGN, GIGA or `label`.
    #[arg(long)]
    from: PathBuf,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,

    /// Output format.
    #[arg(long, value_enum, default_value = "packed")]
    format: Format,
}

/// Grasps closer to the faces of the workspace are dropped (as in VGN's clean-up), metres.
const BORDER: f64 = 0.02;

impl Convert {
    pub fn run(self) -> anyhow::Result<()> {
        if self.format == Format::Raw {
            bail!("--format raw is not possible: volumes have no depth images; use `grasp-sim label --format raw`");
        }
        let same = fs::canonicalize(&self.from).ok().is_some_and(|from| fs::canonicalize(&self.out).ok() == Some(from));
        ensure!(!same, "--from and --out are the same folder; use another --out");
        match DataFormat::from_folder(&self.from)? {
            DataFormat::Raw => self.fuse(&Setup::read(&self.from)?),
            DataFormat::Packed => self.copy(&Setup::read(&self.from)?),
            // VGN's and GIGA's own data sets have none.
            DataFormat::Processed if !self.from.join("setup.json").exists() => self.copy(&Setup::unknown()),
            DataFormat::Processed => self.copy(&Setup::read(&self.from)?),
        }
    }

    fn fuse(&self, setup: &Setup) -> anyhow::Result<()> {
        let reader = raw::Reader::open(&self.from)?;
        let mut writer = Writer::open(self, setup)?;
        let scenes: Vec<(&str, &[Trial])> = reader.trials().collect();
        let voxel_size = setup.size / RESOLUTION as f64;
        let (mut unseen, mut dropped) = (0, 0);
        let progress = ProgressBar::new(scenes.len() as u64);
        ordered::for_each(
            0..scenes.len() as u64,
            |index| fuse(&reader, scenes[index as usize].0),
            |index, volume| {
                let (id, trials) = scenes[index as usize];
                progress.inc(1);
                let Some(volume) = volume? else {
                    unseen += 1;
                    return anyhow::Ok(());
                };
                let inside =
                    |trial: &&Trial| trial.position.iter().all(|&c| (BORDER..=setup.size - BORDER).contains(&c));
                let kept: Vec<Trial> = trials
                    .iter()
                    .filter(inside)
                    .map(|trial| Trial {
                        position: trial.position / voxel_size,
                        width: trial.width / voxel_size,
                        ..*trial
                    })
                    .collect();
                dropped += trials.len() - kept.len();
                if kept.is_empty() { Ok(()) } else { writer.append(index, id, &[volume], &kept, None) }
            },
        )?;
        progress.finish_and_clear();
        println!("{} scenes, {unseen} of them empty; {dropped} grasps at the borders dropped", scenes.len());
        Ok(())
    }

    fn copy(&self, setup: &Setup) -> anyhow::Result<()> {
        let dataset = Dataset::open(std::slice::from_ref(&self.from))?;
        let several = (0..dataset.len()).find(|&index| dataset.volumes(index) != 1);
        if let Some(index) = several.filter(|_| self.format == Format::Processed) {
            bail!(
                "scene {} of {} has {} observations, and --format processed stores one; use --format packed",
                dataset.id(index),
                self.from.display(),
                dataset.volumes(index)
            );
        }
        let mut writer = Writer::open(self, setup)?;
        let values = |bytes: &[u8]| -> Vec<f32> { bytes.iter().map(|&byte| grasp_data::value(byte)).collect() };
        let progress = ProgressBar::new(dataset.len() as u64);
        for index in 0..dataset.len() {
            let volumes: Vec<Vec<f32>> =
                (0..dataset.volumes(index)).map(|observation| values(dataset.volume(index, observation))).collect();
            let occupancy = dataset.occupancy(index);
            writer.append(index as u64, &dataset.id(index), &volumes, &dataset.trials(index), occupancy.as_ref())?;
            progress.inc(1);
        }
        progress.finish_and_clear();
        println!("{} scenes", dataset.len());
        Ok(())
    }
}

/// The volume of a scene; `None` if nothing was observed.
fn fuse(reader: &raw::Reader, id: &str) -> anyhow::Result<Option<Vec<f32>>> {
    let mut fusion = Fusion::new(RESOLUTION, reader.setup().size);
    for view in reader.views(id)? {
        let image = DepthImage::new(reader.setup().intrinsics(), &view.depth).with_context(|| format!("scene {id}"))?;
        fusion.integrate(&image, &view.camera_from_task);
    }
    Ok(fusion.volume(Isometry3::identity()).ok().map(|volume| volume.values().to_vec()))
}

enum Writer {
    Processed(processed::Writer),
    Packed(packed::Writer),
}

impl Writer {
    fn open(convert: &Convert, setup: &Setup) -> anyhow::Result<Self> {
        let writer = match convert.format {
            Format::Packed => Self::Packed(packed::Writer::open(&convert.out, setup)?),
            Format::Processed | Format::Raw => Self::Processed(processed::Writer::open(&convert.out, setup)?),
        };
        let begun = match &writer {
            Self::Processed(writer) => writer.next().is_some(),
            Self::Packed(writer) => writer.next().is_some(),
        };
        ensure!(!begun, "--out {} already contains scenes; use another folder", convert.out.display());
        Ok(writer)
    }

    /// Appends a scene; the processed format takes its first volume and no occupancy. The packed format needs a number:
    /// that of `id`, else `index`.
    fn append(
        &mut self,
        index: u64,
        id: &str,
        volumes: &[Vec<f32>],
        trials: &[Trial],
        occupancy: Option<&Occupancy>,
    ) -> anyhow::Result<()> {
        match self {
            Self::Processed(writer) => {
                let id = scene_number(id).map_or_else(|| id.to_owned(), scene_id);
                writer.append(&id, &volumes[0], trials)?;
            }
            Self::Packed(writer) => writer.append(scene_number(id).unwrap_or(index), volumes, trials, occupancy)?,
        }
        Ok(())
    }
}
