//! The formats of input files, and arrays in .npy and .npz files.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read};
use std::path::Path;

use anyhow::{Context, anyhow, bail, ensure};
use npyz::half::f16;
use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{Deserialize, NpyFile, Order, TypeChar};

use crate::document::listed;

/// An array of a file; its values have not been read yet.
pub(crate) type Array = NpyFile<Box<dyn Read>>;

/// First bytes of files that cannot be read, with what to do.
const REFUSED: [(&[u8], &str); 18] = [
    (b"\xff\xd8\xff", "a JPEG file; its compression changes depths: save PNG with 16 bits, TIFF or .npy"),
    (b"GIF8", "a GIF file; save PNG with 16 bits, TIFF or .npy"),
    (b"BM", "a BMP file; save PNG with 16 bits, TIFF or .npy"),
    (b"P2", "a PGM file; save PNG with 16 bits, TIFF or .npy"),
    (b"P5", "a PGM file; save PNG with 16 bits, TIFF or .npy"),
    (b"Pf\n", "a PFM file; save TIFF, EXR or .npy"),
    (b"PF\n", "a PFM file; save TIFF, EXR or .npy"),
    (b"#?R", "a Radiance HDR file; save TIFF, EXR or .npy"),
    (b"RIFF", "a RIFF file, such as WebP; save PNG with 16 bits, TIFF or .npy"),
    (b"\x89HDF", "an HDF5 file; save the array as .npy"),
    (b"MATLAB", "a MATLAB file; save the array as .npy"),
    (b"SQLite", "an SQLite file, such as a ROS 2 bag; save a message as PNG, .npy or PCD"),
    (b"#ROSBAG", "a ROS bag; save a message as PNG, .npy or PCD"),
    (b"\x89MCAP", "an MCAP file; save a message as PNG, .npy or PCD"),
    (b"\x1f\x8b", "a gzip file; unpack it with gunzip"),
    (b"\x80\x03", "a pickle; save the array with numpy.save"),
    (b"\x80\x04", "a pickle; save the array with numpy.save"),
    (b"\x80\x05", "a pickle; save the array with numpy.save"),
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
        File::open(path)?.take(12).read_to_end(&mut first)?;
        let starts = |magic: &[u8]| first.starts_with(magic);
        ensure!(!first.is_empty(), "the file is empty");
        ensure!(first.get(4..8) != Some(b"ftyp"), "a HEIC, AVIF or MP4 file; save PNG with 16 bits, TIFF or .npy");
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
        let of_reading = |cause: &(dyn std::error::Error + 'static)| {
            cause.downcast_ref::<io::Error>().map(io::Error::kind) == Some(io::ErrorKind::UnexpectedEof)
                || cause.to_string().contains("failed to fill whole buffer")
        };
        error.chain().any(of_reading)
    };
    let read = read(path).map_err(|error| if is_cut_short(&error) { anyhow!("the file is cut short") } else { error });
    read.with_context(|| path.display().to_string())
}

pub(crate) fn has_extension(path: &Path, wanted: &str) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(wanted))
}

/// A file with arrays.
enum Arrays {
    Npy(Array),
    Npz(NpzArchive<BufReader<File>>),
}

/// The arrays of a .npy or .npz file, judged by its first bytes; None for files of another kind.
fn open(path: &Path) -> anyhow::Result<Option<Arrays>> {
    let mut file = BufReader::new(File::open(path)?);
    let first = file.fill_buf()?;
    if first.starts_with(b"PK\x03\x04") || first.starts_with(b"PK\x05\x06") {
        let archive = NpzArchive::new(file).context("not a valid .npz file")?;
        ensure!(archive.array_names().next().is_some(), "a ZIP file without arrays; a .npz file has them");
        return Ok(Some(Arrays::Npz(archive)));
    }
    if !first.starts_with(b"\x93NUMPY") {
        return Ok(None);
    }
    Ok(Some(Arrays::Npy(NpyFile::new(Box::new(file) as Box<dyn Read>)?)))
}

fn member(archive: &mut NpzArchive<BufReader<File>>, name: &str) -> anyhow::Result<Array> {
    let mut bytes = Vec::new();
    archive.zip_archive().by_name(&file_name_from_array_name(name))?.read_to_end(&mut bytes)?;
    Ok(NpyFile::new(Box::new(Cursor::new(bytes)) as Box<dyn Read>)?)
}

/// The arrays of a .npz file with their names, or that of a .npy file with an empty name; None for files of another
/// kind. Images and pickled objects beside other arrays are left out.
pub(crate) fn arrays(path: &Path) -> anyhow::Result<Option<Vec<(String, Array)>>> {
    /// More values than the poses of any request have.
    const MOST: u64 = 1 << 16;
    let mut archive = match open(path)? {
        None => return Ok(None),
        Some(Arrays::Npy(array)) => return Ok(Some(vec![(String::new(), plain(array)?)])),
        Some(Arrays::Npz(archive)) => archive,
    };
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let mut arrays = Vec::new();
    for name in names {
        let array = member(&mut archive, &name)?;
        if array.shape().iter().product::<u64>() <= MOST && !is_object(&array) {
            arrays.push((name, array));
        }
    }
    Ok(Some(arrays))
}

/// The array of a .npy file; for a .npz file its only array, or the array of this name.
pub(crate) fn array(path: &Path, name: &str) -> anyhow::Result<Array> {
    array_of(path, &[name])
}

/// As [`array`], with the first of several names.
pub(crate) fn array_of(path: &Path, wanted: &[&str]) -> anyhow::Result<Array> {
    let mut archive = match open(path)? {
        None => bail!("not a file of a known format: PNG, TIFF, EXR, PCD, PLY, .npy or .npz, whatever its name"),
        Some(Arrays::Npy(array)) => return plain(array),
        Some(Arrays::Npz(archive)) => archive,
    };
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let named = |wanted: &&str| names.iter().find(|name| name.eq_ignore_ascii_case(wanted));
    let name = match &names[..] {
        [only] => only,
        _ => wanted.iter().find_map(named).with_context(|| {
            let found = listed(names.iter().map(String::as_str));
            format!("no array `{}`; arrays in the file: {found}", wanted.join("` or `"))
        })?,
    };
    plain(member(&mut archive, name)?)
}

/// Refuses a pickled Python object: reading it would execute what is in the file.
fn plain(array: Array) -> anyhow::Result<Array> {
    if is_object(&array) {
        bail!("a pickled Python object, such as a dictionary; save the array alone: numpy.save(FILE, data[\"depth\"])");
    }
    Ok(array)
}

fn is_object(array: &Array) -> bool {
    matches!(array.dtype(), npyz::DType::Plain(plain) if plain.to_string().ends_with('O'))
}

/// Type and size in bytes of the values. An error names the `needed` types if they are not among `supported`.
pub(crate) fn kind(array: &Array, needed: &str, supported: &[(TypeChar, u64)]) -> anyhow::Result<(TypeChar, u64)> {
    let dtype = array.dtype();
    let npyz::DType::Plain(plain) = &dtype else { bail!("a structured array; save one of its fields alone: {needed}") };
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
pub(crate) fn narrowed(values: impl IntoIterator<Item = i64>, what: &str) -> anyhow::Result<Vec<u16>> {
    let value =
        |value: i64| u16::try_from(value).ok().with_context(|| format!("{what} {value}; must be from 0 to 65535"));
    values.into_iter().map(value).collect()
}

/// The values of an array of numbers.
pub(crate) enum Values {
    /// Also truth values.
    Integers(Vec<i64>),
    Floats(Vec<f64>),
}

/// The numbers of an array in row-major order. `needed` says in an error what the array must have.
pub(crate) fn numbers(array: Array, needed: &str) -> anyhow::Result<Values> {
    fn whole<T: Deserialize + Copy>(array: Array, to: impl Fn(T) -> i64) -> io::Result<Values> {
        Ok(Values::Integers(values(array)?.into_iter().map(to).collect()))
    }
    fn real<T: Deserialize + Copy>(array: Array, to: impl Fn(T) -> f64) -> io::Result<Values> {
        Ok(Values::Floats(values(array)?.into_iter().map(to).collect()))
    }
    let sizes = |kind: TypeChar| [1, 2, 4, 8].map(|size| (kind, size));
    let supported = [TypeChar::Bool, TypeChar::Int, TypeChar::Uint, TypeChar::Float].map(sizes).concat();
    Ok(match kind(&array, needed, &supported)? {
        (TypeChar::Bool, _) => whole(array, i64::from as fn(bool) -> i64)?,
        (TypeChar::Int, 1) => whole(array, i64::from as fn(i8) -> i64)?,
        (TypeChar::Int, 2) => whole(array, i64::from as fn(i16) -> i64)?,
        (TypeChar::Int, 4) => whole(array, i64::from as fn(i32) -> i64)?,
        (TypeChar::Int, _) => whole(array, |value: i64| value)?,
        (TypeChar::Uint, 1) => whole(array, i64::from as fn(u8) -> i64)?,
        (TypeChar::Uint, 2) => whole(array, i64::from as fn(u16) -> i64)?,
        (TypeChar::Uint, 4) => whole(array, i64::from as fn(u32) -> i64)?,
        // Larger values are refused where they are used.
        (TypeChar::Uint, _) => whole(array, |value: u64| i64::try_from(value).unwrap_or(i64::MAX))?,
        (_, 2) => real(array, f16::to_f64)?,
        (_, 4) => real(array, f64::from as fn(f32) -> f64)?,
        _ => real(array, |value: f64| value)?,
    })
}

/// Whether the values are texts.
pub(crate) fn is_text(array: &Array) -> bool {
    matches!(array.dtype(), npyz::DType::Plain(plain)
        if matches!(plain.type_char(), TypeChar::UnicodeStr | TypeChar::ByteStr))
}
