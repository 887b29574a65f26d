//! Reading of point clouds.

use std::fs;
use std::io::{self, Read};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use npyz::{DType, DTypeError, Deserialize, TypeChar, TypeRead};
use pcd_rs::{DynReader, Field, ValueKind, ViewPoint};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use crate::document::{cells, listed};
use crate::files::{self, Format, Purpose, Values};
use crate::notes::note;

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

/// Distance of points, metres, beyond which integers are not in millimetres.
const FARTHEST: f64 = 100.0;

/// Reads points, x y z in units of `scale` metres, from a .npy, .npz, .pcd, .ply or .xyz file. Without a scale,
/// integers are in millimetres and floats in metres.
pub(crate) fn read(path: &Path, scale: Option<f64>) -> anyhow::Result<Vec<[f32; 3]>> {
    let Points { xyz, are_integers } = unscaled(path)?;
    let far = |point: &&[f32; 3]| point.iter().any(|&c| f64::from(c.abs()) * MILLIMETRE > FARTHEST);
    ensure!(
        !are_integers || scale.is_some() || xyz.iter().filter(far).count() * 2 <= xyz.len(),
        "{}: the points are integers, and read as millimetres most are beyond {FARTHEST} m; give --cloud-scale, such as \
         0.000001 for micrometres",
        path.display()
    );
    let scale = scale.unwrap_or(if are_integers { MILLIMETRE } else { 1.0 });
    if scale == 1.0 {
        return Ok(xyz);
    }
    Ok(xyz.into_iter().map(|point| point.map(|c| (f64::from(c) * scale) as f32)).collect())
}

fn unscaled(path: &Path) -> anyhow::Result<Points> {
    files::in_file(path, |path| match Format::from_path(path, Purpose::Points)? {
        Format::Pcd => pcd(path),
        Format::Ply => ply(path),
        Format::Png | Format::Tiff | Format::Exr => bail!("this is an image; for a depth image give --intrinsics"),
        Format::Other
            if ["xyz", "txt", "csv", "asc", "pts"].iter().any(|extension| files::has_extension(path, extension)) =>
        {
            Ok(text(&fs::read_to_string(path)?)?.into())
        }
        Format::Other => arrays(path),
    })
}

/// The coordinates of each line: the first three numbers, or those under x, y and z of a first line with names. An empty
/// cell is NaN. A first line with the number of points, as in .pts files, is left out.
fn text(text: &str) -> anyhow::Result<Vec<[f32; 3]>> {
    let lines =
        text.trim_start_matches('\u{feff}').lines().map(|line| line.split('#').next().unwrap_or_default().trim());
    let mut lines = lines.enumerate().filter(|(_, line)| !line.is_empty()).peekable();
    let mut columns = [0, 1, 2];
    let line = lines.peek().map(|(_, line)| *line).unwrap_or_default();
    let first = cells(line);
    let is_header = first.iter().any(|cell| coordinate(cell).is_none());
    if is_header {
        // Units that follow the names.
        let names: Vec<&str> = first.iter().copied().filter(|cell| !cell.starts_with(['[', '('])).collect();
        let column = |axis: &str| {
            let found = names.iter().position(|cell| named(cell).eq_ignore_ascii_case(axis));
            found.with_context(|| format!("the first line has no column `{axis}`: {line}"))
        };
        columns = [column("x")?, column("y")?, column("z")?];
    }
    if is_header || first.len() == 1 {
        lines.next();
    }
    let point = |(index, line): (usize, &str)| {
        let row = cells(line);
        let [x, y, z] = columns.map(|column| row.get(column).and_then(|cell| coordinate(cell)));
        let ((x, y), z) =
            x.zip(y).zip(z).with_context(|| format!("line {} is `{line}`, must have x, y and z", index + 1))?;
        Ok([x, y, z])
    };
    lines.map(point).collect()
}

/// The number of a cell, which may have a comma for the point.
fn coordinate(cell: &str) -> Option<f32> {
    if cell.is_empty() { Some(f32::NAN) } else { cell.replace(',', ".").parse().ok() }
}

/// The name of a column, without its unit: that of `points.x [m]` is `x`.
fn named(cell: &str) -> &str {
    let name = cell.split(['[', '(']).next().unwrap_or_default();
    name.rsplit('.').next().unwrap_or_default().trim_matches(['"', '/', ' '])
}

fn arrays(path: &Path) -> anyhow::Result<Points> {
    let array = files::array(path, &ARRAYS, Purpose::Points)?;
    if let DType::Record(fields) = array.dtype() {
        let is_integer = |field: &npyz::Field| match &field.dtype {
            DType::Plain(plain) => {
                field.name.eq_ignore_ascii_case("x") && !matches!(plain.type_char(), TypeChar::Float)
            }
            _ => false,
        };
        let are_integers = fields.iter().any(is_integer);
        let points = files::values::<Structured>(array).context("a structured array needs numbers x, y and z")?;
        return Ok(Points { xyz: points.into_iter().map(|Structured(point)| point).collect(), are_integers });
    }
    // Organized clouds are H×W×3. Further columns are colours or normals.
    let columns = match *array.shape() {
        [.., _, columns @ 3..=7] => columns as usize,
        _ => bail!(
            "shape {:?}: a point cloud must be N×3 or H×W×3 (x, y, z), with at most 4 further columns",
            array.shape()
        ),
    };
    let (are_integers, numbers) = match files::numbers(array, "numbers x, y, z")? {
        Values::Integers(numbers) => (true, numbers.into_iter().map(|number| number as f32).collect::<Vec<_>>()),
        Values::Floats(numbers) => (false, numbers.into_iter().map(|number| number as f32).collect()),
    };
    let xyz = numbers.chunks_exact(columns).map(|row| [row[0], row[1], row[2]]).collect();
    Ok(Points { xyz, are_integers })
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
    I16(<i16 as Deserialize>::TypeReader),
    I32(<i32 as Deserialize>::TypeReader),
    U16(<u16 as Deserialize>::TypeReader),
}

impl Coordinate {
    fn new(dtype: &DType) -> Result<Self, DTypeError> {
        (f64::reader(dtype).map(Self::F64))
            .or_else(|_| i16::reader(dtype).map(Self::I16))
            .or_else(|_| i32::reader(dtype).map(Self::I32))
            .or_else(|_| u16::reader(dtype).map(Self::U16))
            .or_else(|_| f32::reader(dtype).map(Self::F32))
    }

    fn read(&self, bytes: &[u8]) -> io::Result<f32> {
        Ok(match self {
            Self::F32(reader) => reader.read_one(bytes)?,
            Self::F64(reader) => reader.read_one(bytes)? as f32,
            Self::I16(reader) => reader.read_one(bytes)?.into(),
            Self::I32(reader) => reader.read_one(bytes)? as f32,
            Self::U16(reader) => reader.read_one(bytes)?.into(),
        })
    }
}

impl Deserialize for Structured {
    type TypeReader = StructuredReader;

    fn reader(dtype: &DType) -> Result<StructuredReader, DTypeError> {
        let DType::Record(fields) = dtype else { return Err(DTypeError::custom("no fields")) };
        let size = |dtype: &DType| dtype.num_bytes().ok_or_else(|| DTypeError::custom("a field without a size"));
        let coordinate = |name: &str| {
            let mut offset = 0;
            for field in fields {
                if field.name.eq_ignore_ascii_case(name) {
                    return Ok((offset, Coordinate::new(&field.dtype)?));
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
            *value = reader.read(&record[*offset..])?;
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
        let found = names.iter().position(|other| other.eq_ignore_ascii_case(name));
        found.with_context(|| {
            format!("no field `{name}`; fields in the file: {}", listed(names.iter().map(String::as_str)))
        })
    };
    let columns = [column("x")?, column("y")?, column("z")?];
    let coordinate = |field: &Field| match field {
        Field::F32(values) => values.first().copied(),
        Field::F64(values) => values.first().map(|&value| value as f32),
        Field::I8(values) => values.first().map(|&value| f32::from(value)),
        Field::I16(values) => values.first().map(|&value| f32::from(value)),
        Field::I32(values) => values.first().map(|&value| value as f32),
        Field::U8(values) => values.first().map(|&value| f32::from(value)),
        Field::U16(values) => values.first().map(|&value| f32::from(value)),
        Field::U32(values) => values.first().map(|&value| value as f32),
        Field::I64(values) => values.first().map(|&value| value as f32),
        Field::U64(values) => values.first().map(|&value| value as f32),
    };
    let point = |record: pcd_rs::Result<pcd_rs::DynRecord>| {
        let record = record.context("not a valid PCD file")?;
        let [x, y, z] = columns.map(|column| record.0.get(column).and_then(coordinate));
        let ((x, y), z) = x.zip(y).zip(z).context("a point has no x, y or z")?;
        Ok([x, y, z])
    };
    let kind = reader.meta().field_defs.iter().nth(columns[0]).map(|field| field.kind);
    let are_integers = !matches!(kind, Some(ValueKind::F32 | ValueKind::F64));
    let ViewPoint { tx, ty, tz, qw, qx, qy, qz } = reader.meta().viewpoint;
    if [tx, ty, tz, qx, qy, qz] != [0.0; 6] {
        note(format_args!(
            "the VIEWPOINT {tx} {ty} {tz} {qw} {qx} {qy} {qz} of the file is not applied to its points; if they \
             are in the frame of the camera, give it as --frame-from-cloud={tx},{ty},{tz},{qx},{qy},{qz},{qw}"
        ));
    }
    Ok(Points { xyz: reader.map(point).collect::<anyhow::Result<_>>()?, are_integers })
}

/// A vertex of a PLY file.
struct Vertex {
    point: [f32; 3],
    /// Whether all coordinates are integers.
    is_integer: bool,
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { point: [f32::NAN; 3], is_integer: true }
    }

    fn set_property(&mut self, key: &str, property: Property) -> PropertyAccessResult {
        let (value, is_integer) = match property {
            Property::Float(value) => (value, false),
            Property::Double(value) => (value as f32, false),
            Property::Char(value) => (f32::from(value), true),
            Property::UChar(value) => (f32::from(value), true),
            Property::Short(value) => (f32::from(value), true),
            Property::UShort(value) => (f32::from(value), true),
            Property::Int(value) => (value as f32, true),
            Property::UInt(value) => (value as f32, true),
            _ => return PropertyAccessResult::Ignored,
        };
        let Some(axis) = ["x", "y", "z"].iter().position(|axis| key.eq_ignore_ascii_case(axis)) else {
            return PropertyAccessResult::Ignored;
        };
        self.point[axis] = value;
        self.is_integer &= is_integer;
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
        // C prints -nan, and Windows -nan(ind).
        let is_number = |word: &str| {
            let word = word.trim_start_matches(['-', '+']).to_ascii_lowercase();
            !(word.starts_with("nan") || word.starts_with("inf"))
        };
        let word = |word| if is_number(word) { word } else { "1e39" };
        line.split(' ').map(word).collect::<Vec<_>>().join(" ")
    };
    let Some((header, points)) = text.split_once("end_header") else { return file };
    let points: String = points.lines().map(|text| line(text) + "\n").collect();
    format!("{header}end_header{points}").into_bytes()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_text_keep_their_columns() {
        let expected = [[0.1, 0.2, 0.7], [0.3, 0.4, 0.8]];
        for lines in [
            "x,y,z\n0.1,0.2,0.7\n0.3,0.4,0.8",
            "Point ID,x,y,z\n0,0.1,0.2,0.7\n1,0.3,0.4,0.8",
            "x [m],y [m],z [m],intensity\n0.1, 0.2, 0.7, 5\n0.3, 0.4, 0.8,",
            "points.z (m),\"X\",Y\n0.7,0.1,0.2\n0.8,0.3,0.4",
            "//X [m] Y [m] Z [m]\n0.1 0.2 0.7\n0.3\t0.4  0.8",
            "0,1;0,2;0,7\n0,3;0,4;0,8",
            "2\n0.1 0.2 0.7 255\n0.3 0.4 0.8 255",
        ] {
            assert_eq!(text(lines).unwrap(), expected, "{lines}");
        }
        for lines in [",0.2,0.7,0.5\n0.3,0.4,0.8,0.5", "x;y;z;i\n;0.2;0.7;0.5\n0.3;0.4;0.8;0.5"] {
            let points = text(lines).unwrap();
            assert!(points[0][0].is_nan() && points[0][1..] == [0.2, 0.7] && points[1] == expected[1], "{points:?}");
        }
        let error = text("0.1,0.2\n").unwrap_err().to_string();
        assert_eq!(error, "line 1 is `0.1,0.2`, must have x, y and z");
    }
}
