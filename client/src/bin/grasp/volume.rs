use std::path::Path;

use anyhow::{bail, ensure};
use grasp::{Volume, WORKSPACE_SIZE};
use nalgebra::Isometry3;
use npyz::TypeChar;
use npyz::half::f16;

use crate::files::{self, Array, Format, Purpose};

/// Name of the volumes' array in VGN's data.
const ARRAY: &str = "grid";

/// Reads a volume from a .npy or .npz file, with its corner at `pose`.
pub(crate) fn read(path: &Path, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    files::in_file(path, |path| match Format::from_path(path, Purpose::Volume)? {
        Format::Png | Format::Tiff | Format::Exr => bail!("this is an image; for a depth image give --intrinsics"),
        Format::Pcd | Format::Ply => bail!("this is a point cloud; give --camera-position"),
        Format::Other => volume(files::array(path, &[ARRAY], Purpose::Volume)?, voxel_size, pose),
    })
}

fn volume(array: Array, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    let shape = array.shape().to_vec();
    // Leading dimensions of 1 are the batch and the channel of a network's input.
    let edges = &shape[shape.iter().take_while(|&&edge| edge == 1).count().min(shape.len().saturating_sub(3))..];
    ensure!(
        !matches!(edges, [_, 3]),
        "shape {shape:?}: a volume must be N×N×N; for a point cloud add --camera-position"
    );
    ensure!(edges.len() != 2, "shape {shape:?}: a volume must be N×N×N; for a depth image give --intrinsics");
    let &[resolution, y, z] = edges else { bail!("shape {shape:?}: a volume must be N×N×N") };
    ensure!(resolution == y && y == z, "shape {shape:?}: a volume must be N×N×N");
    let resolution = usize::try_from(resolution)?;
    ensure!(
        resolution <= Volume::MAX_RESOLUTION,
        "shape {shape:?}: a volume may have at most {}³ voxels",
        Volume::MAX_RESOLUTION
    );
    let voxel_size = voxel_size.unwrap_or(WORKSPACE_SIZE / resolution as f64);
    Ok(Volume::new(resolution, voxel_size, pose, values(array)?)?)
}

fn values(array: Array) -> anyhow::Result<Vec<f32>> {
    let supported = [(TypeChar::Float, 8), (TypeChar::Float, 4), (TypeChar::Float, 2), (TypeChar::Uint, 1)];
    Ok(match files::kind(&array, "f64, f32, f16 or u8", &supported)? {
        (_, 8) => files::values::<f64>(array)?.into_iter().map(|v| v as f32).collect(),
        (_, 4) => files::values(array)?,
        (_, 2) => files::values::<f16>(array)?.into_iter().map(f16::to_f32).collect(),
        _ => files::values::<u8>(array)?.into_iter().map(|v| f32::from(v) / 255.0).collect(),
    })
}
