use std::fs::File;
use std::io::{BufRead, BufReader, Seek};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use exr::prelude::{ReadChannels, ReadLayers};
use grasp_client::Depth;
use npyz::TypeChar;
use tiff::decoder::{Decoder, DecodingResult};

use crate::files::{self, Format};

/// The unit of integer depths of most cameras, metres.
const MILLIMETRE: f64 = 1e-3;

/// Parses the unit of depths, metres.
pub(crate) fn parse_scale(text: &str) -> Result<f64, String> {
    let scale: f64 = text.parse().map_err(|_| "must be a number".to_owned())?;
    // Written so that NaN fails.
    if !(scale > 0.0 && scale.is_finite()) {
        return Err("must be above 0: the size of one unit of the depths, metres".to_owned());
    }
    if scale > 1.0 {
        return Err(format!("is the size of one unit of the depths, metres; did you mean {}?", scale.recip()));
    }
    Ok(scale)
}

/// Unit of the depths of a file, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scale {
    /// Given by the user, for integers and for floats.
    Given(f64),
    /// That of the camera's file, for integers.
    OfIntegers(f64),
    /// Integers are in millimetres, floats in metres.
    Default,
}

impl Scale {
    /// The unit that the user gives, or that is in the camera's file. Both must agree.
    pub fn new(given: Option<f64>, of_camera: Option<f64>) -> anyhow::Result<Self> {
        match (given, of_camera) {
            (Some(given), Some(of_camera)) if (given - of_camera).abs() > 1e-3 * given => {
                bail!("--depth-scale is {given} m, but the file of the intrinsics has a depth scale of {of_camera} m")
            }
            (Some(given), _) => Ok(Self::Given(given)),
            (None, Some(of_camera)) => Ok(Self::OfIntegers(of_camera)),
            (None, None) => Ok(Self::Default),
        }
    }
}

/// Reads a depth image from a .png, .tiff, .exr or .npy file. Returns the depth, the width and the height.
pub(crate) fn read(path: &Path, scale: Scale) -> anyhow::Result<(Depth, u32, u32)> {
    files::in_file(path, |path| {
        let (depth, width, height) = match Format::from_path(path)? {
            Format::Png => png(path)?,
            Format::Tiff => tiff(path)?,
            Format::Exr => exr(path)?,
            Format::Pcd | Format::Ply => {
                bail!("this is a point cloud; give --camera-position instead of --intrinsics")
            }
            Format::Other => npy(path)?,
        };
        let depth = match (depth, scale) {
            (Depth::Millimetres(depth), Scale::Given(scale) | Scale::OfIntegers(scale)) if scale != MILLIMETRE => {
                Depth::Metres(depth.into_iter().map(|depth| f32::from(depth) * scale as f32).collect())
            }
            (Depth::Metres(depth), Scale::Given(scale)) => {
                Depth::Metres(depth.into_iter().map(|depth| depth * scale as f32).collect())
            }
            (depth, _) => depth,
        };
        Ok((depth, width, height))
    })
}

fn npy(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let array = files::array(path, "depth")?;
    let (&[height, width] | &[height, width, 1]) = array.shape() else {
        bail!(
            "shape {:?}: a depth image must be height × width; for a volume or a point cloud leave out --intrinsics",
            array.shape()
        )
    };
    let supported =
        [(TypeChar::Float, 4), (TypeChar::Float, 8), (TypeChar::Uint, 2), (TypeChar::Int, 4), (TypeChar::Int, 8)];
    let depth = match files::kind(&array, "f32 (metres) or u16 (millimetres)", &supported)? {
        (TypeChar::Int, 4) => Depth::Millimetres(files::narrowed(files::values::<i32>(array)?, "depth")?),
        (TypeChar::Int, _) => Depth::Millimetres(files::narrowed(files::values::<i64>(array)?, "depth")?),
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

/// Whether a channel has the depth, in files of renderers with several channels. Not R: a colour image has it.
fn is_depth(name: &str) -> bool {
    let name = name.to_lowercase();
    ["z", "depth", "depth.z", "depth.v"].contains(&&*name) || name.ends_with(".depth.z") || name.ends_with(".depth.v")
}

fn exr(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().all_layers();
    let image = reader.all_attributes().non_parallel().from_file(path).context("not a valid EXR file")?;
    let channels = || image.layer_data.iter().flat_map(|layer| layer.channel_data.list.iter().map(move |c| (layer, c)));
    let found = channels().find(|(_, channel)| is_depth(&channel.name.to_string()));
    // A depth image with one channel, or with equal channels, needs no channel name.
    let values = |channel: &exr::prelude::AnyChannel<exr::prelude::FlatSamples>| -> Vec<f32> {
        channel.sample_data.values_as_f32().collect()
    };
    let all_equal = || {
        let first = channels().next()?;
        let bits = |channel| values(channel).into_iter().map(f32::to_bits).collect::<Vec<_>>();
        channels().skip(1).all(|(_, other)| bits(other) == bits(first.1)).then_some(first)
    };
    let (layer, channel) = found.or_else(all_equal).with_context(|| {
        let names: Vec<_> = channels().map(|(_, channel)| channel.name.to_string()).collect();
        format!("no channel Z or depth; channels in the file: {}", names.join(", "))
    })?;
    let depth = values(channel);
    Ok((Depth::Metres(depth), u32::try_from(layer.size.width())?, u32::try_from(layer.size.height())?))
}

fn png(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    decode_png(BufReader::new(File::open(path)?))
}

/// The depth image of a PNG file, with its width and height.
pub(crate) fn decode_png(file: impl BufRead + Seek) -> anyhow::Result<(Depth, u32, u32)> {
    let mut reader = png::Decoder::new(file).read_info().context("not a PNG file")?;
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
