//! The command `export`: a network in another precision, checked against the first in ONNX Runtime.

use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use grasp::{Maps, Volume};
use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use grasp_models::{Network, Options, with_full_weights, with_half_weights, with_int8};
use nalgebra::Isometry3;
use serde::Serialize;

use crate::calibrate::ranges;

/// Prints one JSON object: the bytes of both files, and with --data how far each output moved.
#[derive(Args)]
pub(crate) struct Export {
    /// The network to start from.
    #[arg(long)]
    from: PathBuf,
    /// How its weights are stored. fp32 and fp16 compute in f32, fp16 is half the file; int8 also computes in 8 bits,
    /// calibrated on volumes of --data.
    #[arg(long, value_enum)]
    precision: Precision,
    /// The file to write.
    #[arg(long)]
    out: PathBuf,
    /// Folders of volumes to compare both on, and to calibrate on.
    #[arg(long, num_args = 1..)]
    data: Vec<PathBuf>,
    /// On so many volumes, from all over the data.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    volumes: u64,
    /// Calibrated on so many volumes, from all over the data.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    calibrate: u64,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Precision {
    Fp32,
    Fp16,
    Int8,
}

/// How far an output moved, over all voxels and volumes.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Moved {
    largest: f64,
    mean: f64,
}

/// What is printed.
#[derive(Serialize)]
struct Report {
    from_bytes: u64,
    out_bytes: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    compared: Option<Compared>,
}

#[derive(Default, Serialize)]
struct Compared {
    volumes: usize,
    quality: Moved,
    rotation: Moved,
    width_voxels: Moved,
}

impl Export {
    /// Writes the file, and compares.
    pub fn run(&self) -> Result<()> {
        ensure!(self.from != self.out, "--from and --out are the same file");
        let model = ModelProto::read(&self.from)?;
        let data = if self.data.is_empty() { None } else { Some(Dataset::open(&self.data)?) };
        let exported = || match (self.precision, &data) {
            (Precision::Fp32, _) => Ok(with_full_weights(&model)?),
            (Precision::Fp16, _) => Ok(with_half_weights(&model)?),
            (Precision::Int8, Some(data)) => self.quantized(&model, data),
            (Precision::Int8, None) => bail!("int8 is calibrated on volumes: name folders of them with --data"),
        };
        exported().with_context(|| self.from.display().to_string())?.write(&self.out)?;
        let bytes = |path: &PathBuf| std::fs::metadata(path).map(|file| file.len());
        let compared = data.map(|data| self.compare(&data)).transpose()?;
        let report = Report { from_bytes: bytes(&self.from)?, out_bytes: bytes(&self.out)?, compared };
        println!("{}", serde_json::to_string(&report)?);
        Ok(())
    }

    fn quantized(&self, model: &ModelProto, data: &Dataset) -> Result<ModelProto> {
        let model = with_full_weights(model)?;
        let count = data.len().min(self.calibrate as usize);
        let scenes = (0..count).map(|number| number * data.len() / count);
        let ranges = ranges(&model, data, scenes)?;
        Ok(with_int8(&model, &ranges)?)
    }

    fn compare(&self, dataset: &Dataset) -> Result<Compared> {
        let load = |path| Network::load(path, &Options::default());
        let (mut before, mut after) = (load(&self.from)?, load(&self.out)?);
        let voxel_size = before.metadata().voxel_size;
        let count = dataset.len().min(self.volumes as usize);
        let mut compared = Compared { volumes: count, ..Compared::default() };
        for number in 0..count {
            let scene = number * dataset.len() / count;
            let values = dataset.volume(scene, 0).iter().map(|&byte| grasp_data::value(byte)).collect();
            let volume = Volume::new(dataset.resolution(), voxel_size, Isometry3::identity(), values)?;
            let (before, after) = (before.infer(&[&volume])?, after.infer(&[&volume])?);
            compared.add(&before.maps(0), &after.maps(0));
        }
        Ok(compared)
    }
}

impl Compared {
    /// Adds one of the volumes.
    fn add(&mut self, before: &Maps, after: &Maps) {
        let share = 1.0 / self.volumes as f64;
        for (moved, before, after) in [
            (&mut self.quality, before.quality, after.quality),
            (&mut self.rotation, before.rotation, after.rotation),
            (&mut self.width_voxels, before.width, after.width),
        ] {
            let differences = || before.iter().zip(after).map(|(before, after)| f64::from((before - after).abs()));
            moved.largest = differences().fold(moved.largest, f64::max);
            moved.mean += share * differences().sum::<f64>() / before.len().max(1) as f64;
        }
    }
}
