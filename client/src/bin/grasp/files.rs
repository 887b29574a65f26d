//! The formats of input files, and arrays in .npy and .npz files.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read};
use std::path::Path;

use anyhow::{Context, anyhow, bail, ensure};
use npyz::half::f16;
use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{Deserialize, NpyFile, Order, TypeChar};

use crate::document::listed;
use crate::notes;

/// An array of a file; its values have not been read yet.
pub(crate) type Array = NpyFile<Box<dyn Read>>;

/// First bytes of files that cannot be read, their names, and what to do where that is not to save another format.
const REFUSED: [(&[u8], &str, Option<&str>); 18] = [
    (b"\xff\xd8\xff", "a JPEG file, whose compression changes the values", None),
    (b"GIF8", "a GIF file", None),
    (b"BM", "a BMP file", None),
    (b"P2", "a PGM file", None),
    (b"P5", "a PGM file", None),
    (b"Pf\n", "a PFM file", None),
    (b"PF\n", "a PFM file", None),
    (b"#?R", "a Radiance HDR file", None),
    (b"RIFF", "a RIFF file, such as WebP", None),
    (b"\x89HDF", "an HDF5 file", None),
    (b"MATLAB", "a MATLAB file", None),
    (b"SQLite", "an SQLite file, such as a ROS 2 bag", Some("save a message as PNG, .npy or PCD")),
    (b"#ROSBAG", "a ROS bag", Some("save a message as PNG, .npy or PCD")),
    (b"\x89MCAP", "an MCAP file", Some("save a message as PNG, .npy or PCD")),
    (b"\x1f\x8b", "a gzip file", Some("unpack it with gunzip")),
    (b"\x80\x03", "a pickle", Some("save the array with numpy.save")),
    (b"\x80\x04", "a pickle", Some("save the array with numpy.save")),
    (b"\x80\x05", "a pickle", Some("save the array with numpy.save")),
];

/// What a file is read for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    Volume,
    Depth,
    Labels,
    Points,
    Intrinsics,
    Pose,
}

impl Purpose {
    /// The formats in which an error advises to save it.
    fn formats(self) -> &'static str {
        match self {
            Self::Volume => ".npy or .npz",
            Self::Depth => "PNG with 16 bits, TIFF, EXR or .npy",
            Self::Labels => "PNG or .npy",
            Self::Points => "PCD, PLY or .npy",
            Self::Intrinsics | Self::Pose => "JSON, YAML or .npy",
        }
    }

    /// Name of its array in the files of data sets.
    fn key(self) -> &'static str {
        match self {
            Self::Volume => "grid",
            Self::Depth => "depth",
            Self::Labels => "labels",
            Self::Points => "points",
            Self::Intrinsics => "K",
            Self::Pose => "pose",
        }
    }
}

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
    pub fn from_path(path: &Path, purpose: Purpose) -> anyhow::Result<Self> {
        let mut first = Vec::new();
        File::open(path)?.take(12).read_to_end(&mut first)?;
        let starts = |magic: &[u8]| first.starts_with(magic);
        ensure!(!first.is_empty(), "the file is empty");
        let formats = purpose.formats();
        ensure!(first.get(4..8) != Some(b"ftyp"), "a HEIC, AVIF or MP4 file; save {formats}");
        match REFUSED.iter().find(|(magic, ..)| starts(magic)) {
            Some((_, name, Some(advice))) => bail!("{name}; {advice}"),
            Some((_, name, None)) => bail!("{name}; save {formats}"),
            None => (),
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
    let read = notes::about(path, read)
        .map_err(|error| if is_cut_short(&error) { anyhow!("the file is cut short") } else { error });
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
pub(crate) fn arrays(path: &Path, purpose: Purpose) -> anyhow::Result<Option<Vec<(String, Array)>>> {
    /// More values than the poses of any request have.
    const MOST: u64 = 1 << 16;
    let mut archive = match open(path)? {
        None => return Ok(None),
        Some(Arrays::Npy(array)) => return Ok(Some(vec![(String::new(), plain(array, purpose)?)])),
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

/// The array of a .npy file; for a .npz file its only array, or that of the first of these names.
pub(crate) fn array(path: &Path, wanted: &[&str], purpose: Purpose) -> anyhow::Result<Array> {
    let mut archive = match open(path)? {
        None => bail!("not a file of a known format: PNG, TIFF, EXR, PCD, PLY, .npy or .npz, whatever its name"),
        Some(Arrays::Npy(array)) => return plain(array, purpose),
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
    plain(member(&mut archive, name)?, purpose)
}

/// Refuses a pickled Python object: reading it would execute what is in the file.
fn plain(array: Array, purpose: Purpose) -> anyhow::Result<Array> {
    let key = purpose.key();
    ensure!(
        !is_object(&array),
        "a pickled Python object, such as a dictionary; save the array alone: numpy.save(FILE, data[\"{key}\"])"
    );
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
