use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use npyz::TypeChar;

use crate::files::{self, Format};

/// Reads the labels of objects from a PNG with 8- or 16-bit grey values or a .npy file with integers.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<u16>> {
    files::in_file(path, |path| match Format::of(path)? {
        Format::Png => png(path),
        Format::Other => npy(path),
        format => bail!("a file of the format {format:?}; labels must be PNG or .npy"),
    })
}

fn npy(path: &Path) -> anyhow::Result<Vec<u16>> {
    let array = files::array(path, "labels")?;
    let supported = [(TypeChar::Uint, 1), (TypeChar::Uint, 2), (TypeChar::Int, 4), (TypeChar::Int, 8)];
    let narrowed = |labels: Vec<i64>| {
        let label =
            |label: i64| u16::try_from(label).with_context(|| format!("label {label}; must be from 0 to 65535"));
        labels.into_iter().map(label).collect()
    };
    match files::kind(&array, "u8, u16, i32 or i64", &supported)? {
        (TypeChar::Uint, 1) => Ok(files::values::<u8>(array)?.into_iter().map(u16::from).collect()),
        (TypeChar::Uint, _) => Ok(files::values(array)?),
        (_, 4) => narrowed(files::values::<i32>(array)?.into_iter().map(i64::from).collect()),
        _ => narrowed(files::values(array)?),
    }
}

fn png(path: &Path) -> anyhow::Result<Vec<u16>> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info().context("not a PNG file")?;
    let png::Info { bit_depth, color_type, .. } = *reader.info();
    ensure!(
        color_type == png::ColorType::Grayscale || color_type == png::ColorType::Indexed,
        "PNG is {color_type:?}; labels must be grey values or indices of 8 or 16 bits"
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("the image is too large")?];
    reader.next_frame(&mut bytes)?;
    match bit_depth {
        png::BitDepth::Eight => Ok(bytes.into_iter().map(u16::from).collect()),
        png::BitDepth::Sixteen => Ok(bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect()),
        _ => bail!("PNG has {bit_depth:?} bits; labels must have 8 or 16 bits"),
    }
}
