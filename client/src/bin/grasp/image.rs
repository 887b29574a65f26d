use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use grasp_client::Depth;
use npyz::TypeChar;

use crate::files;

/// Reads a depth image from a .png or .npy file. Returns the depth, the width and the height.
pub(crate) fn read(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    files::in_file(path, if files::has_extension(path, "png") { png } else { npy })
}

fn npy(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let array = files::array(path, "depth")?;
    let &[height, width] = array.shape() else {
        bail!("shape {:?}: a depth image must be height × width", array.shape())
    };
    let supported = [(TypeChar::Float, 4), (TypeChar::Float, 8), (TypeChar::Uint, 2)];
    let depth = match files::kind(&array, "f32 (metres) or u16 (millimetres)", &supported)? {
        (_, 4) => Depth::Metres(files::values(array)?),
        (_, 8) => Depth::Metres(files::values::<f64>(array)?.into_iter().map(|depth| depth as f32).collect()),
        _ => Depth::Millimetres(files::values(array)?),
    };
    Ok((depth, u32::try_from(width)?, u32::try_from(height)?))
}

fn png(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info()?;
    let png::Info { width, height, bit_depth, color_type, .. } = *reader.info();
    ensure!(
        (color_type, bit_depth) == (png::ColorType::Grayscale, png::BitDepth::Sixteen),
        "PNG is {color_type:?} with {bit_depth:?} bits; a depth image must be Grayscale with Sixteen bits (millimetres)"
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    reader.next_frame(&mut bytes)?;
    let millimetres = bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect();
    Ok((Depth::Millimetres(millimetres), width, height))
}
