use std::fs::File;
use std::path::Path;

use anyhow::Context;
use grasp::Volume;
use nalgebra::Isometry3;
use npyz::npz::NpzArchive;

/// The volume of a file of `grasp-sim label --format processed` (.npz).
pub(crate) fn read(path: &Path) -> anyhow::Result<Volume> {
    let file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
    let mut archive = NpzArchive::new(file)?;
    let grid = archive.by_name("grid")?.context("no array `grid`")?;
    let values: Vec<f32> = match grid.dtype().num_bytes() {
        Some(1) => grid.into_vec::<u8>()?.into_iter().map(|value| f32::from(value) / 255.0).collect(),
        _ => grid.into_vec::<f32>()?,
    };
    let voxel_size = grasp::WORKSPACE_SIZE / grasp::RESOLUTION as f64;
    Ok(Volume::new(grasp::RESOLUTION, voxel_size, Isometry3::identity(), values)?)
}
