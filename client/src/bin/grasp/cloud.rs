//! Reading of point clouds.

use std::fs;
use std::io::{self, Read};
use std::path::Path;

use anyhow::{Context, bail};
use npyz::{DType, DTypeError, Deserialize, TypeRead};
use pcd_rs::{DynReader, Field, ValueKind};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use crate::document::{document, flat};
use crate::files::{self, Format};

/// Names of the points' array in a .npz file with several arrays.
const ARRAYS: [&str; 2] = ["points", "xyz"];

/// The unit of integer coordinates of most cameras, metres.
const MILLIMETRE: f64 = 1e-3;

/// Points as they are in a file.
struct Points {
    xyz: Vec<[f32; 3]>,
    /// Whether the coordinates are integers.
    are_integers: bool,
}

impl From<Vec<[f32; 3]>> for Points {
    fn from(xyz: Vec<[f32; 3]>) -> Self {
        Self { xyz, are_integers: false }
    }
}

/// Reads points, x y z in units of `scale` metres, from a .npy, .npz, .pcd, .ply or .xyz file. Without a scale,
/// integers are in millimetres and floats in metres.
pub(crate) fn read(path: &Path, scale: Option<f64>) -> anyhow::Result<Vec<[f32; 3]>> {
    let Points { xyz, are_integers } = unscaled(path)?;
    let scale = scale.unwrap_or(if are_integers { MILLIMETRE } else { 1.0 });
    if scale == 1.0 {
        return Ok(xyz);
    }
    Ok(xyz.into_iter().map(|point| point.map(|c| (f64::from(c) * scale) as f32)).collect())
}

fn unscaled(path: &Path) -> anyhow::Result<Points> {
    files::in_file(path, |path| match Format::from_path(path)? {
        Format::Pcd => pcd(path),
        Format::Ply => ply(path),
        Format::Png | Format::Tiff | Format::Exr => bail!("this is an image; for a depth image give --intrinsics"),
        Format::Other if ["xyz", "txt", "csv"].iter().any(|extension| files::has_extension(path, extension)) => {
            Ok(text(path)?.into())
        }
        Format::Other => Ok(arrays(path)?.into()),
    })
}

/// The first three numbers of each line.
fn text(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let document = document(path)?;
    let rows = document.as_array().context("a point cloud as text has rows of numbers: x, y, z")?;
    let point = |row: &serde_json::Value| match flat(row)[..] {
        [x, y, z, ..] => Ok([x, y, z].map(|c| c as f32)),
        _ => bail!("a row of fewer than three numbers"),
    };
    rows.iter().map(point).collect()
}

fn arrays(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let array = files::array_of(path, &ARRAYS)?;
    if let DType::Record(_) = array.dtype() {
        let points =
            files::values::<Structured>(array).context("a structured array needs the fields x, y and z, floats")?;
        return Ok(points.into_iter().map(|Structured(point)| point).collect());
    }
    // Organized clouds are H×W×3. Further columns are colours or normals.
    let columns = match *array.shape() {
        [.., _, columns @ (3 | 4 | 6 | 7)] => columns as usize,
        _ => bail!("shape {:?}: a point cloud must be N×3 or H×W×3 (x, y, z), or N×4, N×6 or N×7", array.shape()),
    };
    let point = |row: &[f64]| [row[0], row[1], row[2]].map(|c| c as f32);
    Ok(files::floats(array)?.chunks_exact(columns).map(point).collect())
}

/// A point of a structured array, as ros2_numpy makes it, with fields besides x, y and z.
#[derive(Clone, Copy)]
struct Structured([f32; 3]);

/// Reads a [`Structured`]: the size of a record, and the offset of each coordinate with the reader of its type.
struct StructuredReader {
    size: usize,
    coordinates: [(usize, Coordinate); 3],
}

enum Coordinate {
    F32(<f32 as Deserialize>::TypeReader),
    F64(<f64 as Deserialize>::TypeReader),
}

impl Deserialize for Structured {
    type TypeReader = StructuredReader;

    fn reader(dtype: &DType) -> Result<StructuredReader, DTypeError> {
        let DType::Record(fields) = dtype else { return Err(DTypeError::custom("no fields")) };
        let size = |dtype: &DType| dtype.num_bytes().ok_or_else(|| DTypeError::custom("a field without a size"));
        let coordinate = |name: &str| {
            let mut offset = 0;
            for field in fields {
                if field.name == name {
                    let double = f64::reader(&field.dtype).map(Coordinate::F64);
                    return Ok((offset, double.or_else(|_| f32::reader(&field.dtype).map(Coordinate::F32))?));
                }
                offset += size(&field.dtype)?;
            }
            Err(DTypeError::custom(format!("no field `{name}`")))
        };
        let coordinates = [coordinate("x")?, coordinate("y")?, coordinate("z")?];
        Ok(StructuredReader { size: size(dtype)?, coordinates })
    }
}

impl TypeRead for StructuredReader {
    type Value = Structured;

    fn read_one<R: Read>(&self, mut bytes: R) -> io::Result<Structured> {
        let mut record = vec![0; self.size];
        bytes.read_exact(&mut record)?;
        let mut point = [0.0; 3];
        for (value, (offset, reader)) in point.iter_mut().zip(&self.coordinates) {
            *value = match reader {
                Coordinate::F32(reader) => reader.read_one(&record[*offset..])?,
                Coordinate::F64(reader) => reader.read_one(&record[*offset..])? as f32,
            };
        }
        Ok(Structured(point))
    }
}

/// The file without the fields whose COUNT is 0, which take no bytes: pcd_rs reads them as one value.
fn without_empty_fields(file: Vec<u8>) -> Vec<u8> {
    const FIELD_LINES: [&str; 5] = ["FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT"];
    let Some(start) = file.windows(5).position(|bytes| bytes == b"\nDATA") else { return file };
    let Ok(header) = std::str::from_utf8(&file[..start]) else { return file };
    let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    let Some(counts) = header.lines().find(|line| line.starts_with("COUNT")).map(words) else { return file };
    let kept = |line: &str| {
        if !FIELD_LINES.iter().any(|name| line.starts_with(name)) {
            return line.to_owned();
        }
        let words = words(line).into_iter().enumerate();
        let words = words.filter(|(i, _)| counts.get(*i).is_none_or(|count| count != "0"));
        words.map(|(_, word)| word).collect::<Vec<_>>().join(" ")
    };
    let header = header.lines().map(kept).collect::<Vec<_>>().join("\n");
    [header.as_bytes(), &file[start..]].concat()
}

fn pcd(path: &Path) -> anyhow::Result<Points> {
    let file = without_empty_fields(fs::read(path)?);
    let reader = DynReader::from_bytes(&file).context("not a valid PCD file")?;
    let names: Vec<_> = reader.meta().field_defs.iter().map(|field| field.name.clone()).collect();
    let column = |name: &str| {
        let found = names.iter().position(|other| other == name);
        found.with_context(|| format!("no field `{name}`; fields in the file: {}", names.join(", ")))
    };
    let columns = [column("x")?, column("y")?, column("z")?];
    let coordinate = |field: &Field| match field {
        Field::F32(values) => values.first().copied(),
        Field::F64(values) => values.first().map(|&value| value as f32),
        Field::I16(values) => values.first().map(|&value| f32::from(value)),
        Field::I32(values) => values.first().map(|&value| value as f32),
        _ => None,
    };
    let point = |record: pcd_rs::Result<pcd_rs::DynRecord>| {
        let record = record.context("not a valid PCD file")?;
        let [x, y, z] = columns.map(|column| record.0.get(column).and_then(coordinate));
        let point = x.zip(y).zip(z).context("x, y and z must be floats, or integers of 16 or 32 bits")?;
        let ((x, y), z) = point;
        Ok([x, y, z])
    };
    let kind = reader.meta().field_defs.iter().nth(columns[0]).map(|field| field.kind);
    let are_integers = matches!(kind, Some(ValueKind::I16 | ValueKind::I32));
    Ok(Points { xyz: reader.map(point).collect::<anyhow::Result<_>>()?, are_integers })
}

/// A vertex of a PLY file.
struct Vertex {
    point: [f32; 3],
    is_integer: bool,
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { point: [f32::NAN; 3], is_integer: false }
    }

    fn set_property(&mut self, key: &str, property: Property) -> PropertyAccessResult {
        let (value, is_integer) = match property {
            Property::Float(value) => (value, false),
            Property::Double(value) => (value as f32, false),
            Property::Short(value) => (f32::from(value), true),
            Property::Int(value) => (value as f32, true),
            _ => return PropertyAccessResult::Ignored,
        };
        let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == key) else {
            return PropertyAccessResult::Ignored;
        };
        self.point[axis] = value;
        self.is_integer = is_integer;
        PropertyAccessResult::Set
    }
}

/// The file with each nan of an ASCII file, a point that was not measured, replaced by a number beyond the range of a
/// float: ply_rs refuses nan.
fn with_numbers_for_nan(file: Vec<u8>) -> Vec<u8> {
    let Some(text) = std::str::from_utf8(&file).ok().filter(|text| text.contains("\nformat ascii")) else {
        return file;
    };
    let line = |line: &str| {
        let word = |word| if str::eq_ignore_ascii_case(word, "nan") { "1e39" } else { word };
        line.split(' ').map(word).collect::<Vec<_>>().join(" ")
    };
    text.lines().map(|text| line(text) + "\n").collect::<String>().into_bytes()
}

fn ply(path: &Path) -> anyhow::Result<Points> {
    let file = with_numbers_for_nan(fs::read(path)?);
    let mut ply = Parser::<Vertex>::new().read_ply(&mut &file[..]).context("not a valid PLY file")?;
    let vertices = ply.payload.swap_remove("vertex").context("no element `vertex`")?;
    let are_integers = vertices.first().is_some_and(|vertex| vertex.is_integer);
    let xyz: Vec<_> = vertices.into_iter().map(|vertex| vertex.point).collect();
    if xyz.iter().all(|point| point.iter().any(|c| !c.is_finite())) {
        bail!("no vertex has x, y and z as numbers");
    }
    Ok(Points { xyz, are_integers })
}
