use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};

use crate::files::{self, Format, Purpose, Values};
use crate::image::channels;

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
    files::in_file(path, |path| match Format::from_path(path, Purpose::Labels)? {
        Format::Png => png(path),
        Format::Other => npy(path),
        format => bail!("a file of the format {format:?}; labels must be PNG or .npy"),
    })
}

fn npy(path: &Path) -> anyhow::Result<Labels> {
    let array = files::array(path, &["labels", "label", "mask", "masks", "segmentation"], Purpose::Labels)?;
    let mut shape = array.shape().to_vec();
    if let [_, _, 1] = shape[..] {
        shape.pop();
    }
    let whole = |value: f64| {
        ensure!(value.fract() == 0.0 && value.abs() < 1e9, "label {value}; must be a whole number from 0 to 65535");
        Ok(value as i64)
    };
    let values = match files::numbers(array, "integers, truth values, or whole numbers as floats")? {
        Values::Integers(values) => values,
        Values::Floats(values) => values.into_iter().map(whole).collect::<anyhow::Result<_>>()?,
    };
    Ok(Labels { values: files::narrowed(values, "label")?, shape })
}

fn png(path: &Path) -> anyhow::Result<Labels> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info().context("not a PNG file")?;
    let png::Info { width, height, bit_depth, color_type, .. } = *reader.info();
    ensure!(
        color_type == png::ColorType::Grayscale || color_type == png::ColorType::Indexed,
        "the PNG has {}; labels must be grey values or indices",
        channels(color_type)
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    reader.next_frame(&mut bytes)?;
    let line = reader.output_line_size(width);
    let values: Vec<u16> = match bit_depth {
        png::BitDepth::Sixteen => bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect(),
        // Rows begin at a byte; the first pixel is in the highest bits.
        depth => {
            let (bits, width) = (depth as usize, width as usize);
            let pixel =
                |row: &[u8], at: usize| row[at * bits / 8] >> (8 - bits - at * bits % 8) & (u8::MAX >> (8 - bits));
            let rows = bytes.chunks_exact(line.unwrap_or(1).max(1));
            rows.flat_map(|row| (0..width).map(move |at| u16::from(pixel(row, at)))).collect()
        }
    };
    Ok(Labels { values, shape: vec![height.into(), width.into()] })
}
