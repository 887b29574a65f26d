use std::fs::File;
use std::io::{BufRead, BufReader, Seek};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use exr::prelude::{ReadChannels, ReadLayers};
use grasp_client::Depth;
use tiff::decoder::{Decoder, DecodingResult};

use crate::document::listed;
use crate::files::{self, Format, Purpose, Values};

/// The unit of integer depths of most cameras, metres.
const MILLIMETRE: f64 = 1e-3;

/// Parses the unit of depths or points, metres.
pub(crate) fn parse_scale(text: &str) -> Result<f64, String> {
    let scale: f64 = text.parse().map_err(|_| "must be a number".to_owned())?;
    // Written so that NaN fails.
    if !(scale > 0.0 && scale.is_finite()) {
        return Err("must be above 0: the size of one unit of the file, metres".to_owned());
    }
    if scale > 1.0 {
        return Err(format!(
            "must be at most 1: the size of one unit of the file, metres; did you mean {}?",
            scale.recip()
        ));
    }
    Ok(scale)
}

/// Unit of depths, metres. Without any, integers are in millimetres and floats in metres.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Scale {
    /// Given by the user, for integers and for floats.
    pub given: Option<f64>,
    /// That of the camera's file, for integers.
    pub of_camera: Option<f64>,
}

impl Scale {
    /// The unit of integers. Both must agree.
    fn of_integers(self) -> anyhow::Result<f64> {
        if let (Some(given), Some(of_camera)) = (self.given, self.of_camera) {
            ensure!(
                (given - of_camera).abs() <= 1e-3 * given,
                "--depth-scale is {given} m, but the file of the intrinsics has a depth scale of {of_camera} m"
            );
        }
        Ok(self.given.or(self.of_camera).unwrap_or(MILLIMETRE))
    }
}

/// Depths as they are in a file.
enum Stored {
    Floats(Vec<f32>),
    U16(Vec<u16>),
    Integers(Vec<i64>),
}

/// Reads a depth image from a .png, .tiff, .exr or .npy file. Returns the depth, the width and the height.
pub(crate) fn read(path: &Path, scale: Scale) -> anyhow::Result<(Depth, u32, u32)> {
    files::in_file(path, |path| {
        let (stored, width, height) = match Format::from_path(path, Purpose::Depth)? {
            Format::Png => png(BufReader::new(File::open(path)?))?,
            Format::Tiff => tiff(path)?,
            Format::Exr => exr(path)?,
            Format::Pcd | Format::Ply => {
                bail!("this is a point cloud; give --camera-position instead of --intrinsics")
            }
            Format::Other => npy(path)?,
        };
        Ok((depth(stored, scale)?, width, height))
    })
}

fn depth(stored: Stored, scale: Scale) -> anyhow::Result<Depth> {
    let integers = match stored {
        Stored::Floats(depth) => {
            let scale = scale.given.unwrap_or(1.0) as f32;
            return Ok(Depth::Metres(depth.into_iter().map(|depth| depth * scale).collect()));
        }
        Stored::U16(depth) if scale.of_integers()? == MILLIMETRE => return Ok(Depth::Millimetres(depth)),
        Stored::U16(depth) => depth.into_iter().map(i64::from).collect(),
        Stored::Integers(depth) => depth,
    };
    let scale = scale.of_integers()?;
    if scale == MILLIMETRE {
        return Ok(Depth::Millimetres(files::narrowed(integers, "depth").context("--depth-scale gives another unit")?));
    }
    Ok(Depth::Metres(integers.into_iter().map(|depth| depth as f32 * scale as f32).collect()))
}

fn npy(path: &Path) -> anyhow::Result<(Stored, u32, u32)> {
    let array = files::array(path, &["depth"], Purpose::Depth)?;
    let (&[height, width] | &[height, width, 1]) = array.shape() else {
        bail!(
            "shape {:?}: a depth image must be height × width; for a volume or a point cloud leave out --intrinsics",
            array.shape()
        )
    };
    let shape = (u32::try_from(width)?, u32::try_from(height)?);
    let needed = "floats in metres or integers of 16 bits or more in millimetres";
    if let npyz::DType::Plain(plain) = array.dtype()
        && plain.size_field() == 1
    {
        bail!("dtype {plain} has 8 bits, too few for depths; use {needed}");
    }
    let stored = match files::numbers(array, needed)? {
        Values::Integers(depth) => Stored::Integers(depth),
        Values::Floats(depth) => Stored::Floats(depth.into_iter().map(|depth| depth as f32).collect()),
    };
    Ok((stored, shape.0, shape.1))
}

fn tiff(path: &Path) -> anyhow::Result<(Stored, u32, u32)> {
    let mut decoder = Decoder::new(BufReader::new(File::open(path)?)).context("not a TIFF file")?;
    let (width, height) = decoder.dimensions()?;
    let whole = |values: Vec<i64>| (values.len(), Stored::Integers(values));
    let real = |values: Vec<f32>| (values.len(), Stored::Floats(values));
    let (count, stored) = match decoder.read_image()? {
        DecodingResult::U16(depth) => (depth.len(), Stored::U16(depth)),
        DecodingResult::I16(depth) => whole(depth.into_iter().map(i64::from).collect()),
        DecodingResult::U32(depth) => whole(depth.into_iter().map(i64::from).collect()),
        DecodingResult::I32(depth) => whole(depth.into_iter().map(i64::from).collect()),
        DecodingResult::F16(depth) => real(depth.into_iter().map(f32::from).collect()),
        DecodingResult::F32(depth) => real(depth),
        DecodingResult::F64(depth) => real(depth.into_iter().map(|depth| depth as f32).collect()),
        _ => bail!(
            "the TIFF has {:?}; a depth image must have one channel of floats or integers, of 16 bits or more",
            decoder.colortype()?
        ),
    };
    let pixels = u64::from(width) * u64::from(height);
    ensure!(
        count as u64 == pixels,
        "the TIFF has {count} values for {pixels} pixels; a depth image must have one channel"
    );
    Ok((stored, width, height))
}

/// Whether a channel has the depth, in files of renderers with several channels. Not R: a colour image has it.
fn is_depth(name: &str) -> bool {
    let name = name.to_lowercase();
    ["z", "depth", "depth.z", "depth.v"].contains(&&*name) || name.ends_with(".depth.z") || name.ends_with(".depth.v")
}

/// Renderers write the opacity beside a depth that is the same in R, G and B.
fn is_alpha(name: &str) -> bool {
    name.rsplit('.').next().is_some_and(|last| last.eq_ignore_ascii_case("a") || last.eq_ignore_ascii_case("alpha"))
}

fn exr(path: &Path) -> anyhow::Result<(Stored, u32, u32)> {
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().all_layers();
    let image = reader.all_attributes().non_parallel().from_file(path).context("not a valid EXR file")?;
    let channels = || image.layer_data.iter().flat_map(|layer| layer.channel_data.list.iter().map(move |c| (layer, c)));
    // A depth image with one channel, or with equal channels, needs no channel name.
    let values = |channel: &exr::prelude::AnyChannel<exr::prelude::FlatSamples>| -> Vec<f32> {
        channel.sample_data.values_as_f32().collect()
    };
    type Channels = exr::prelude::AnyChannels<exr::prelude::FlatSamples>;
    type Found<'a> = (&'a exr::prelude::Layer<Channels>, &'a exr::prelude::AnyChannel<exr::prelude::FlatSamples>);
    let bits = |(_, channel): &Found| values(channel).into_iter().map(f32::to_bits).collect::<Vec<_>>();
    let are_equal = |found: &[Found]| found.iter().skip(1).all(|other| bits(other) == bits(&found[0]));
    let list = |found: &[Found]| {
        let name = |(layer, channel): &Found| match &layer.attributes.layer_name {
            Some(layer) => format!("{layer}.{}", channel.name),
            None => channel.name.to_string(),
        };
        let names: Vec<String> = found.iter().map(name).collect();
        listed(names.iter().map(String::as_str))
    };
    let all: Vec<Found> = channels().filter(|(_, channel)| !is_alpha(&channel.name.to_string())).collect();
    let depths: Vec<Found> = all.iter().copied().filter(|(_, channel)| is_depth(&channel.name.to_string())).collect();
    ensure!(are_equal(&depths), "several channels with depths: {}; give a file with one of them", list(&depths));
    let of_equal = || all.first().filter(|_| are_equal(&all));
    let (layer, channel) = depths
        .first()
        .or_else(of_equal)
        .with_context(|| format!("no channel Z or depth; channels in the file: {}", list(&all)))?;
    let depth = Stored::Floats(values(channel));
    Ok((depth, u32::try_from(layer.size.width())?, u32::try_from(layer.size.height())?))
}

/// The depth image of a PNG file in millimetres, with its width and height.
pub(crate) fn decode_png(file: impl BufRead + Seek) -> anyhow::Result<(Depth, u32, u32)> {
    let (stored, width, height) = png(file)?;
    Ok((depth(stored, Scale::default())?, width, height))
}

/// What the pixels of a PNG have.
pub(crate) fn channels(color_type: png::ColorType) -> &'static str {
    match color_type {
        png::ColorType::Grayscale => "grey values",
        png::ColorType::GrayscaleAlpha => "grey values and opacity",
        png::ColorType::Rgb => "colours (RGB)",
        png::ColorType::Rgba => "colours and opacity (RGBA)",
        png::ColorType::Indexed => "indexed colours",
    }
}

fn png(file: impl BufRead + Seek) -> anyhow::Result<(Stored, u32, u32)> {
    let mut reader = png::Decoder::new(file).read_info().context("not a valid PNG file")?;
    let png::Info { width, height, bit_depth, color_type, .. } = *reader.info();
    ensure!(
        (color_type, bit_depth) == (png::ColorType::Grayscale, png::BitDepth::Sixteen),
        "the PNG has {} of {} bits; a depth image must have one channel of grey values of 16 bits",
        channels(color_type),
        bit_depth as u8
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    reader.next_frame(&mut bytes)?;
    let depth = bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect();
    Ok((Stored::U16(depth), width, height))
}
