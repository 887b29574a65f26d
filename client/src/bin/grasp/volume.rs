use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use grasp::{Volume, WORKSPACE_SIZE};
use nalgebra::Isometry3;
use npyz::half::f16;
use npyz::npz::NpzArchive;
use npyz::{NpyFile, Order, TypeChar};

/// The name under which VGN's data has its volumes.
const ARRAY: &str = "grid";

/// Reads a volume from a .npy or .npz file, with its corner at `pose`.
pub(crate) fn read(path: &Path, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    try_read(path, voxel_size, pose).with_context(|| path.display().to_string())
}

fn try_read(path: &Path, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    let file = BufReader::new(File::open(path)?);
    if path.extension().is_some_and(|extension| extension == "npz") {
        let mut archive = NpzArchive::new(file)?;
        let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
        let name = match names.as_slice() {
            [only] => only,
            _ => names.iter().find(|name| *name == ARRAY).with_context(|| {
                format!("holds {}; one array, or one called `{ARRAY}`, is needed", names.join(", "))
            })?,
        };
        let array = archive.by_name(name)?.with_context(|| format!("holds no array `{name}`"))?;
        volume(array, voxel_size, pose)
    } else {
        volume(NpyFile::new(file)?, voxel_size, pose)
    }
}

fn volume(array: NpyFile<impl Read>, voxel_size: Option<f64>, pose: Isometry3<f64>) -> anyhow::Result<Volume> {
    let shape = array.shape().to_vec();
    let order = array.order();
    // Leading dimensions of 1 are the batch and the channel that networks want.
    let edges = &shape[shape.iter().take_while(|&&edge| edge == 1).count().min(shape.len().saturating_sub(3))..];
    let &[resolution, y, z] = edges else { bail!("its shape is {shape:?}, N×N×N is needed") };
    ensure!(resolution == y && y == z, "its shape is {shape:?}, N×N×N is needed");
    let resolution = usize::try_from(resolution)?;
    ensure!(
        resolution <= Volume::MAX_RESOLUTION,
        "its shape is {shape:?}, at most {}³ is taken",
        Volume::MAX_RESOLUTION
    );

    let mut values = values(array)?;
    if order == Order::Fortran {
        values = (0..values.len())
            .map(|index| {
                let (x, y, z) =
                    (index / (resolution * resolution), index / resolution % resolution, index % resolution);
                values[(z * resolution + y) * resolution + x]
            })
            .collect();
    }
    let voxel_size = voxel_size.unwrap_or(WORKSPACE_SIZE / resolution as f64);
    Ok(Volume::new(resolution, voxel_size, pose, values)?)
}

fn values(array: NpyFile<impl Read>) -> anyhow::Result<Vec<f32>> {
    let dtype = array.dtype();
    let npyz::DType::Plain(plain) = &dtype else { bail!("its dtype is {dtype:?}, f64, f32, f16 or u8 is needed") };
    Ok(match (plain.type_char(), plain.size_field()) {
        (TypeChar::Float, 8) => array.into_vec::<f64>()?.into_iter().map(|v| v as f32).collect(),
        (TypeChar::Float, 4) => array.into_vec()?,
        (TypeChar::Float, 2) => array.into_vec::<f16>()?.into_iter().map(f16::to_f32).collect(),
        (TypeChar::Uint, 1) => array.into_vec::<u8>()?.into_iter().map(|v| f32::from(v) / 255.0).collect(),
        _ => bail!("its dtype is {plain}, f64, f32, f16 or u8 is needed"),
    })
}
