use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use npyz::TypeChar;

use crate::files::{self, Format};

/// Labels of pixels or points, with the shape of their array: height and width, or a count.
pub(crate) struct Labels {
    pub values: Vec<u16>,
    pub shape: Vec<u64>,
}

impl Labels {
    /// The labels of the pixels of an image.
    pub fn of_image(self, width: u32, height: u32) -> anyhow::Result<Vec<u16>> {
        let Self { values, shape } = self;
        ensure!(
            shape == [u64::from(height), u64::from(width)],
            "--labels: labels of shape {shape:?} for an image of {height} × {width} (height × width)"
        );
        Ok(values)
    }
}

/// Reads the labels of objects from a PNG with 8- or 16-bit grey values, or a .npy file with integers, booleans, or
/// floats that are whole numbers.
pub(crate) fn read(path: &Path) -> anyhow::Result<Labels> {
    files::in_file(path, |path| match Format::from_path(path)? {
        Format::Png => png(path),
        Format::Other => npy(path),
        format => bail!("a file of the format {format:?}; labels must be PNG or .npy"),
    })
}

fn npy(path: &Path) -> anyhow::Result<Labels> {
    let array = files::array(path, "labels")?;
    let supported = [
        (TypeChar::Bool, 1),
        (TypeChar::Uint, 1),
        (TypeChar::Uint, 2),
        (TypeChar::Int, 4),
        (TypeChar::Int, 8),
        (TypeChar::Float, 2),
        (TypeChar::Float, 4),
        (TypeChar::Float, 8),
    ];
    let shape = array.shape().to_vec();
    let whole = |value: f64| {
        ensure!(value.fract() == 0.0 && value.abs() < 1e9, "label {value}; must be a whole number from 0 to 65535");
        Ok(value as i64)
    };
    let values: anyhow::Result<Vec<u16>> =
        match files::kind(&array, "u8, u16, i32, i64, bool, or whole numbers as floats", &supported)? {
            (TypeChar::Bool, _) => Ok(files::values::<bool>(array)?.into_iter().map(u16::from).collect()),
            (TypeChar::Uint, 1) => Ok(files::values::<u8>(array)?.into_iter().map(u16::from).collect()),
            (TypeChar::Uint, _) => Ok(files::values(array)?),
            (TypeChar::Int, 4) => files::narrowed(files::values::<i32>(array)?, "label"),
            (TypeChar::Int, _) => files::narrowed(files::values::<i64>(array)?, "label"),
            _ => files::narrowed(
                files::floats(array)?.into_iter().map(whole).collect::<anyhow::Result<Vec<i64>>>()?,
                "label",
            ),
        };
    Ok(Labels { values: values?, shape })
}

fn png(path: &Path) -> anyhow::Result<Labels> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info().context("not a PNG file")?;
    let png::Info { width, height, bit_depth, color_type, .. } = *reader.info();
    ensure!(
        color_type == png::ColorType::Grayscale || color_type == png::ColorType::Indexed,
        "PNG is {color_type:?}; labels must be grey values or indices of 8 or 16 bits"
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    reader.next_frame(&mut bytes)?;
    let values = match bit_depth {
        png::BitDepth::Eight => bytes.into_iter().map(u16::from).collect(),
        png::BitDepth::Sixteen => bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect(),
        _ => bail!("PNG has {bit_depth:?} bits; labels must have 8 or 16 bits"),
    };
    Ok(Labels { values, shape: vec![height.into(), width.into()] })
}
