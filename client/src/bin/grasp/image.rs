use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use exr::prelude::{ReadChannels, ReadLayers};
use grasp_client::Depth;
use npyz::TypeChar;
use tiff::decoder::{Decoder, DecodingResult};

use crate::files::{self, Format};

/// The unit of integer depths of most cameras, metres.
pub(crate) const MILLIMETRE: f32 = 1e-3;

/// Reads a depth image from a .png, .tiff, .exr or .npy file, with integer depths in units of `scale` metres. Returns the
/// depth, the width and the height.
pub(crate) fn read(path: &Path, scale: f32) -> anyhow::Result<(Depth, u32, u32)> {
    files::in_file(path, |path| {
        let (depth, width, height) = match Format::of(path)? {
            Format::Png => png(path)?,
            Format::Tiff => tiff(path)?,
            Format::Exr => exr(path)?,
            Format::Pcd | Format::Ply => {
                bail!("this is a point cloud; give --camera-position instead of --intrinsics")
            }
            Format::Other => npy(path)?,
        };
        let depth = match depth {
            Depth::Millimetres(depth) if scale != MILLIMETRE => {
                Depth::Metres(depth.into_iter().map(|depth| f32::from(depth) * scale).collect())
            }
            depth => depth,
        };
        Ok((depth, width, height))
    })
}

fn npy(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let array = files::array(path, "depth")?;
    let &[height, width] = array.shape() else {
        bail!(
            "shape {:?}: a depth image must be height × width; for a volume or a point cloud leave out --intrinsics",
            array.shape()
        )
    };
    let supported = [(TypeChar::Float, 4), (TypeChar::Float, 8), (TypeChar::Uint, 2)];
    let depth = match files::kind(&array, "f32 (metres) or u16 (millimetres)", &supported)? {
        (_, 4) => Depth::Metres(files::values(array)?),
        (_, 8) => Depth::Metres(files::values::<f64>(array)?.into_iter().map(|depth| depth as f32).collect()),
        _ => Depth::Millimetres(files::values(array)?),
    };
    Ok((depth, u32::try_from(width)?, u32::try_from(height)?))
}

fn tiff(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let mut decoder = Decoder::new(BufReader::new(File::open(path)?)).context("not a TIFF file")?;
    let (width, height) = decoder.dimensions()?;
    let depth = match decoder.read_image()? {
        DecodingResult::U16(depth) => Depth::Millimetres(depth),
        DecodingResult::F32(depth) => Depth::Metres(depth),
        _ => bail!("TIFF is {:?}; a depth image must have one channel of u16 or f32", decoder.colortype()?),
    };
    let pixels = u64::from(width) * u64::from(height);
    let values = match &depth {
        Depth::Metres(depth) => depth.len(),
        Depth::Millimetres(depth) | Depth::Png(depth) => depth.len(),
    };
    ensure!(
        values as u64 == pixels,
        "TIFF has {values} values for {pixels} pixels; a depth image must have one channel"
    );
    Ok((depth, width, height))
}

/// Names of the channel with the depth in files of renderers that have several channels. Not R: a colour image has it.
const CHANNELS: [&str; 4] = ["Z", "depth.Z", "Depth.Z", "depth"];

fn exr(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().all_layers();
    let image = reader.all_attributes().non_parallel().from_file(path).context("not a valid EXR file")?;
    let channels = || image.layer_data.iter().flat_map(|layer| layer.channel_data.list.iter().map(move |c| (layer, c)));
    let found = CHANNELS.iter().find_map(|name| channels().find(|(_, channel)| channel.name == **name));
    // A depth image of one channel needs no name.
    let (layer, channel) =
        found.or_else(|| channels().next().filter(|_| channels().count() == 1)).with_context(|| {
            let names: Vec<_> = channels().map(|(_, channel)| channel.name.to_string()).collect();
            format!("no channel {}; channels in the file: {}", CHANNELS.join(" or "), names.join(", "))
        })?;
    let depth = channel.sample_data.values_as_f32().collect();
    Ok((Depth::Metres(depth), u32::try_from(layer.size.width())?, u32::try_from(layer.size.height())?))
}

fn png(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info().context("not a PNG file")?;
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
