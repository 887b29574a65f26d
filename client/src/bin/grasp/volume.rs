use std::path::Path;

use anyhow::{bail, ensure};
use grasp::{Volume, WORKSPACE_SIZE};
use nalgebra::Isometry3;
use npyz::TypeChar;
use npyz::half::f16;

use crate::files::{self, Array};

/// The name under which VGN's data has its volumes.
const ARRAY: &str = "grid";

/// Reads a volume from a .npy or .npz file, with its corner at `pose`.
pub(crate) fn read(path: &Path, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    files::in_file(path, |path| volume(files::array(path, ARRAY)?, voxel_size, pose))
}

fn volume(array: Array, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    let shape = array.shape().to_vec();
    // Leading dimensions of 1 are the batch and the channel that networks want.
    let edges = &shape[shape.iter().take_while(|&&edge| edge == 1).count().min(shape.len().saturating_sub(3))..];
    ensure!(
        !matches!(edges, [_, 3]),
        "its shape is {shape:?}, N×N×N is needed; points need --camera-position, as a point cloud"
    );
    let &[resolution, y, z] = edges else { bail!("its shape is {shape:?}, N×N×N is needed") };
    ensure!(resolution == y && y == z, "its shape is {shape:?}, N×N×N is needed");
    let resolution = usize::try_from(resolution)?;
    ensure!(
        resolution <= Volume::MAX_RESOLUTION,
        "its shape is {shape:?}, at most {}³ is taken",
        Volume::MAX_RESOLUTION
    );
    let voxel_size = voxel_size.unwrap_or(WORKSPACE_SIZE / resolution as f64);
    Ok(Volume::new(resolution, voxel_size, pose, values(array)?)?)
}

fn values(array: Array) -> anyhow::Result<Vec<f32>> {
    let taken = [(TypeChar::Float, 8), (TypeChar::Float, 4), (TypeChar::Float, 2), (TypeChar::Uint, 1)];
    Ok(match files::kind(&array, "f64, f32, f16 or u8", &taken)? {
        (_, 8) => files::values::<f64>(array)?.into_iter().map(|v| v as f32).collect(),
        (_, 4) => files::values(array)?,
        (_, 2) => files::values::<f16>(array)?.into_iter().map(f16::to_f32).collect(),
        _ => files::values::<u8>(array)?.into_iter().map(|v| f32::from(v) / 255.0).collect(),
    })
}
