//! The command `export`: converts a network to another precision and compares both in ONNX Runtime.

use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use grasp::{Maps, Volume};
use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use grasp_models::{
    Calibration, Metadata, Network, Options, averaged_over_rotations, with_full_weights, with_half_weights, with_int8,
};
use nalgebra::Isometry3;
use serde::Serialize;

use crate::activation_ranges::activation_ranges;

/// Prints one JSON object: the sizes of both files, and with --data the differences of the outputs.
#[derive(Args)]
pub(crate) struct Export {
    /// Input network.
    #[arg(long)]
    from: PathBuf,
    /// Format of the weights. fp32 and fp16 compute in f32; fp16 halves the file. int8 also computes in 8 bits; its
    /// scales are calibrated on volumes of --data.
    #[arg(long, value_enum)]
    precision: Precision,
    /// Rotation averaging: average the network over the four quarter rotations of its volume, for four times the
    /// computation. The network must regress axes.
    #[arg(long)]
    average_rotations: bool,
    /// Output file. Its stem is the model's name.
    #[arg(long)]
    out: PathBuf,
    /// Data set folders for comparison and calibration.
    #[arg(long, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Number of volumes for the comparison, evenly spaced over the data sets.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    volumes: u64,
    /// Number of volumes for the calibration, evenly spaced over the data sets.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    calibrate: u64,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Precision {
    Fp32,
    Fp16,
    Int8,
}

impl Precision {
    fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Int8 => "int8",
        }
    }
}

/// Absolute difference of an output, over all voxels and volumes.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct OutputDifference {
    largest: f64,
    mean: f64,
}

/// The printed report.
#[derive(Serialize)]
struct ExportReport {
    from_bytes: u64,
    out_bytes: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    compared: Option<OutputComparison>,
}

#[derive(Default, Serialize)]
struct OutputComparison {
    volumes: usize,
    quality: OutputDifference,
    rotation: OutputDifference,
    width_voxels: OutputDifference,
}

impl Export {
    pub fn run(&self) -> Result<()> {
        let same = std::fs::canonicalize(&self.from).ok();
        let same = same.is_some_and(|from| std::fs::canonicalize(&self.out).ok() == Some(from));
        ensure!(!same, "--from and --out are the same file; use another --out");
        let model = ModelProto::read(&self.from)?;
        let data = if self.data.is_empty() { None } else { Some(Dataset::open(&self.data)?) };
        if let Some(data) = &data {
            let (resolution, needed) = (data.resolution(), Metadata::from_model(&model, &self.from)?.resolution);
            ensure!(
                resolution == needed,
                "--data has volumes of {resolution}³ voxels, but the network needs {needed}³"
            );
        }
        let exported = self.exported(&model, data.as_ref()).with_context(|| self.from.display().to_string())?;
        exported.write(&self.out)?;
        let bytes = |path: &PathBuf| std::fs::metadata(path).map(|file| file.len());
        let compared = data.map(|data| self.compare(&data)).transpose()?;
        let report = ExportReport { from_bytes: bytes(&self.from)?, out_bytes: bytes(&self.out)?, compared };
        println!("{}", serde_json::to_string(&report)?);
        Ok(())
    }

    fn exported(&self, model: &ModelProto, data: Option<&Dataset>) -> Result<ModelProto> {
        let model = with_full_weights(model)?;
        // Rotation averaging comes after the calibration of int8, because `Executor` does not support the nodes that it
        // adds.
        let model = match (self.precision, data) {
            (Precision::Fp32 | Precision::Fp16, _) => model,
            (Precision::Int8, Some(data)) => self.quantized(&model, data)?,
            (Precision::Int8, None) => bail!("--precision int8 needs volumes for calibration; add --data"),
        };
        let model = if self.average_rotations { averaged_over_rotations(&model)? } else { model };
        let mut model = if self.precision == Precision::Fp16 { with_half_weights(&model)? } else { model };
        let mut metadata = Metadata::from_model(&model, &self.from)?;
        metadata.name = self.out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut note = |key: &str, value: &str| metadata.provenance.insert(key.to_owned(), value.to_owned());
        note("precision", self.precision.name());
        if self.average_rotations {
            note("averaged_over_rotations", "4");
        }
        let calibration = Calibration::from_model(&model)?;
        metadata.write_to(&mut model);
        if calibration != Calibration::default() {
            calibration.write_to(&mut model);
        }
        Ok(model)
    }

    fn quantized(&self, model: &ModelProto, data: &Dataset) -> Result<ModelProto> {
        let count = data.len().min(self.calibrate as usize);
        let scenes = (0..count).map(|number| number * data.len() / count);
        let ranges = activation_ranges(model, data, scenes)?;
        Ok(with_int8(model, &ranges)?)
    }

    fn compare(&self, dataset: &Dataset) -> Result<OutputComparison> {
        let load = |path| Network::load(path, &Options::default());
        let (mut before, mut after) = (load(&self.from)?, load(&self.out)?);
        let voxel_size = before.metadata().voxel_size;
        let count = dataset.len().min(self.volumes as usize);
        let mut compared = OutputComparison { volumes: count, ..OutputComparison::default() };
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

impl OutputComparison {
    /// Adds the differences of one volume.
    fn add(&mut self, before: &Maps, after: &Maps) {
        let share = 1.0 / self.volumes as f64;
        for (difference, before, after) in [
            (&mut self.quality, before.quality, after.quality),
            (&mut self.rotation, before.rotation, after.rotation),
            (&mut self.width_voxels, before.width, after.width),
        ] {
            let differences = || before.iter().zip(after).map(|(before, after)| f64::from((before - after).abs()));
            difference.largest = differences().fold(difference.largest, f64::max);
            difference.mean += share * differences().sum::<f64>() / before.len().max(1) as f64;
        }
    }
}
