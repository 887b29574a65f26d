//! The formats of input files, and arrays in .npy and .npz files.

use std::fs::File;
use std::io::{self, BufReader, Cursor, Read};
use std::path::Path;

use anyhow::{Context, anyhow, bail};
use npyz::half::f16;
use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{Deserialize, NpyFile, Order, TypeChar};

/// An array of a file; its values have not been read yet.
pub(crate) type Array = NpyFile<Box<dyn Read>>;

/// First bytes of files that cannot be read, with what to do.
const REFUSED: [(&[u8], &str); 6] = [
    (b"\xff\xd8\xff", "a JPEG file; its compression changes depths: save PNG with 16 bits, TIFF or .npy"),
    (b"GIF8", "a GIF file; save PNG with 16 bits, TIFF or .npy"),
    (b"RIFF", "a RIFF file, such as WebP; save PNG with 16 bits, TIFF or .npy"),
    (b"\x89HDF", "an HDF5 file; save the array as .npy"),
    (b"#ROSBAG", "a ROS bag; save a message as PNG, .npy or PCD"),
    (b"\x89MCAP", "an MCAP file; save a message as PNG, .npy or PCD"),
];

/// Format of a file, judged by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Png,
    Tiff,
    Exr,
    Pcd,
    Ply,
    /// .npy, .npz, or a file of another kind.
    Other,
}

impl Format {
    pub fn from_path(path: &Path) -> anyhow::Result<Self> {
        let mut first = Vec::new();
        File::open(path)?.take(8).read_to_end(&mut first)?;
        let starts = |magic: &[u8]| first.starts_with(magic);
        if let Some((_, reason)) = REFUSED.iter().find(|(magic, _)| starts(magic)) {
            bail!("{reason}");
        }
        Ok(if starts(b"\x89PNG") {
            Self::Png
        } else if starts(b"II*\0") || starts(b"MM\0*") {
            Self::Tiff
        } else if starts(b"\x76\x2f\x31\x01") {
            Self::Exr
        } else if starts(b"# .PCD") || starts(b"VERSION ") {
            Self::Pcd
        } else if starts(b"ply\n") || starts(b"ply\r") {
            Self::Ply
        } else {
            Self::Other
        })
    }
}

/// Adds the path to the error of `read`, and explains an unexpected end of the file.
pub(crate) fn in_file<T>(path: &Path, read: impl FnOnce(&Path) -> anyhow::Result<T>) -> anyhow::Result<T> {
    let is_cut_short = |error: &anyhow::Error| {
        let of_reading = error.downcast_ref::<io::Error>().map(io::Error::kind);
        error.chain().len() == 1 && of_reading == Some(io::ErrorKind::UnexpectedEof)
    };
    let read = read(path).map_err(|error| if is_cut_short(&error) { anyhow!("the file is cut short") } else { error });
    read.with_context(|| path.display().to_string())
}

pub(crate) fn has_extension(path: &Path, wanted: &str) -> bool {
    path.extension().is_some_and(|extension| extension == wanted)
}

/// The array of a .npy file; for a .npz file its only array, or the array of this name.
pub(crate) fn array(path: &Path, name: &str) -> anyhow::Result<Array> {
    array_of(path, &[name])
}

/// As [`array`], with the first of several names.
pub(crate) fn array_of(path: &Path, wanted: &[&str]) -> anyhow::Result<Array> {
    let file = BufReader::new(File::open(path)?);
    if !has_extension(path, "npz") {
        let file = NpyFile::new(Box::new(file) as Box<dyn Read>);
        return plain(file.context("neither a .npy file nor an image or a point cloud of a known format")?);
    }
    let mut archive = NpzArchive::new(file)?;
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let name = match &names[..] {
        [only] => only,
        _ => names.iter().find(|name| wanted.iter().any(|wanted| name.eq_ignore_ascii_case(wanted))).with_context(
            || format!("no array `{}`; arrays in the file: {}", wanted.join("` or `"), names.join(", ")),
        )?,
    };
    let mut bytes = Vec::new();
    archive.zip_archive().by_name(&file_name_from_array_name(name))?.read_to_end(&mut bytes)?;
    plain(NpyFile::new(Box::new(Cursor::new(bytes)) as Box<dyn Read>)?)
}

/// Refuses a pickled Python object: reading it would execute what is in the file.
fn plain(array: Array) -> anyhow::Result<Array> {
    let is_object = matches!(array.dtype(), npyz::DType::Plain(plain) if plain.to_string().ends_with('O'));
    if is_object {
        bail!("a pickled Python object, such as a dictionary; save the array alone: numpy.save(FILE, data[\"depth\"])");
    }
    Ok(array)
}

/// Type and size in bytes of the values. An error names the `needed` types if they are not among `supported`.
pub(crate) fn kind(array: &Array, needed: &str, supported: &[(TypeChar, u64)]) -> anyhow::Result<(TypeChar, u64)> {
    let dtype = array.dtype();
    let npyz::DType::Plain(plain) = &dtype else { bail!("dtype {dtype:?} is not supported; use {needed}") };
    let kind = (plain.type_char(), plain.size_field());
    if supported.contains(&kind) { Ok(kind) } else { bail!("dtype {plain} is not supported; use {needed}") }
}

/// The values in row-major order, also of files in Fortran order.
pub(crate) fn values<T: Deserialize + Copy>(array: Array) -> io::Result<Vec<T>> {
    let (shape, order) = (array.shape().to_vec(), array.order());
    let values: Vec<T> = array.into_vec()?;
    if order == Order::C {
        return Ok(values);
    }
    let value_at = |mut index: usize| {
        let (mut source, mut stride) = (0, values.len());
        for edge in shape.iter().rev().map(|&edge| edge as usize) {
            stride /= edge;
            source += index % edge * stride;
            index /= edge;
        }
        values[source]
    };
    Ok((0..values.len()).map(value_at).collect())
}

/// The values as u16. An error names the value as `what`.
pub(crate) fn narrowed(values: impl IntoIterator<Item = impl Into<i64>>, what: &str) -> anyhow::Result<Vec<u16>> {
    let value = |value: i64| u16::try_from(value).with_context(|| format!("{what} {value}; must be from 0 to 65535"));
    values.into_iter().map(|whole| value(whole.into())).collect()
}

/// The values of an array of floats in row-major order.
pub(crate) fn floats(array: Array) -> anyhow::Result<Vec<f64>> {
    Ok(match kind(&array, "f64, f32 or f16", &[(TypeChar::Float, 8), (TypeChar::Float, 4), (TypeChar::Float, 2)])? {
        (_, 8) => values(array)?,
        (_, 2) => values::<f16>(array)?.into_iter().map(f16::to_f64).collect(),
        _ => values::<f32>(array)?.into_iter().map(f64::from).collect(),
    })
}
