//! `grasps.csv`: one row per trial. Both formats of VGN have the same columns and differ in the unit of lengths.
//! Columns are found by name. The tables of VGN and GIGA have no `share` and no `clearance`; the clearance is in metres
//! in both formats.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, ErrorKind, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use nalgebra::{Point3, Quaternion, UnitQuaternion};
use serde::{Deserialize, Deserializer};

use crate::error::{At, DataError};
use crate::{MAX_CLEARANCE, Trial, scene_number};

pub(crate) const FILE: &str = "grasps.csv";

/// The unit of a table's positions and widths.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LengthUnit {
    Metres,
    Voxels,
}

impl LengthUnit {
    /// The header that the writer writes.
    fn header(self) -> &'static str {
        match self {
            Self::Metres => "scene_id,qx,qy,qz,qw,x,y,z,width,label,share,clearance",
            Self::Voxels => "scene_id,qx,qy,qz,qw,i,j,k,width,label,share,clearance",
        }
    }

    /// The columns that every table must have.
    fn required(self) -> impl Iterator<Item = &'static str> {
        self.header().split(',').filter(|column| !["share", "clearance"].contains(column))
    }

    fn columns(self) -> &'static str {
        match self {
            Self::Metres => {
                "scene_id,qx,qy,qz,qw,x,y,z,width,label, with x, y, z and width in metres, \
                 optionally share,clearance, with clearance in metres"
            }
            Self::Voxels => {
                "scene_id,qx,qy,qz,qw,i,j,k,width,label, with i, j, k and width in voxels, \
                 optionally share,clearance, with clearance in metres"
            }
        }
    }

    /// The unit of a folder's table, from its header; `None` if there is no table.
    pub(crate) fn from_folder(folder: &Path) -> Result<Option<Self>, DataError> {
        let path = folder.join(FILE);
        let file = match File::open(&path) {
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(None),
            file => file.at(&path)?,
        };
        let mut reader = csv::Reader::from_reader(file);
        let wrong =
            |reason, unit: Self| DataError::Row { path: path.clone(), line: 1, reason, columns: unit.columns() };
        let header = reader.headers().map_err(|error| wrong(error.to_string(), Self::Voxels))?;
        if [Self::Metres, Self::Voxels].iter().all(|unit| unit.missing(header).is_some()) {
            // The position tells which of the units is meant.
            let unit = if header.iter().any(|column| column == "x") { Self::Metres } else { Self::Voxels };
            let column = unit.missing(header).unwrap_or_default();
            return Err(wrong(format!("the column `{column}` is missing"), unit));
        }
        Ok([Self::Metres, Self::Voxels].into_iter().find(|unit| unit.missing(header).is_none()))
    }

    /// A required column that is missing.
    fn missing(self, header: &csv::StringRecord) -> Option<&'static str> {
        self.required().find(|&column| header.iter().all(|found| found != column))
    }
}

/// Writes scenes in the order of their numbers, so that an interrupted run can continue.
pub(crate) struct TableWriter {
    path: PathBuf,
    file: File,
}

impl TableWriter {
    /// Opens a folder's table, which is new or was written by an earlier run. The last scene of that run may be
    /// incomplete. Its rows are removed, and its number is returned as the next scene to write.
    pub(crate) fn open(folder: &Path, unit: LengthUnit) -> Result<(Self, Option<u64>), DataError> {
        let path = folder.join(FILE);
        let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).at(&path)?;
        let (kept, last) = last_scene(&file).at(&path)?.map_err(|line| DataError::Row {
            path: path.clone(),
            line,
            reason: "the scene id has no number, so no rows can be appended; write into another folder".to_owned(),
            columns: unit.columns(),
        })?;
        if kept > 0 {
            check_columns(&path, unit)?;
        }
        file.set_len(kept).at(&path)?;
        file.seek(SeekFrom::End(0)).at(&path)?;
        if kept == 0 {
            writeln!(file, "{}", unit.header()).at(&path)?;
        }
        Ok((Self { path, file }, last))
    }

    /// Appends the trials of a scene, in the unit of the table, in one write.
    pub(crate) fn append(&mut self, id: &str, trials: &[Trial]) -> Result<(), DataError> {
        let mut rows = String::new();
        for Trial { position: p, rotation, width, success, share, clearance, .. } in trials {
            let (q, label) = (rotation.coords, u8::from(*success));
            // Writing to a string cannot fail.
            let _ = writeln!(
                rows,
                "{id},{:.7},{:.7},{:.7},{:.7},{:.6},{:.6},{:.6},{width:.6},{label},{share:.6},{clearance:.6}",
                q.x, q.y, q.z, q.w, p.x, p.y, p.z
            );
        }
        self.file.write_all(rows.as_bytes()).at(&self.path)
    }
}

/// Checks that the header is that of the current version, because its rows are longer than those of earlier versions.
fn check_columns(path: &Path, unit: LengthUnit) -> Result<(), DataError> {
    let mut header = String::new();
    BufReader::new(File::open(path).at(path)?).read_line(&mut header).at(path)?;
    if header.trim_end() == unit.header() {
        return Ok(());
    }
    let reason = format!("the header must be `{}` to append rows; write into another folder", unit.header());
    Err(DataError::Row { path: path.to_owned(), line: 1, reason, columns: unit.columns() })
}

/// Length of the table without the rows of its last scene, which may be incomplete, and the number of that scene. The
/// error is the line of a scene whose id has no number, as in VGN's own tables.
fn last_scene(table: &File) -> io::Result<Result<(u64, Option<u64>), u64>> {
    let mut reader = BufReader::new(table);
    let mut line = String::new();
    let (mut offset, mut start, mut last) = (0, 0, None);
    for number in 1.. {
        line.clear();
        if reader.read_line(&mut line)? == 0 {
            break;
        }
        // A row without a line end may be truncated within the scene number. It is counted with the previous scene.
        if number > 1 && line.ends_with('\n') {
            let Some(scene) = line.split(',').next().and_then(scene_number) else {
                return Ok(Err(number));
            };
            if last != Some(scene) {
                last = Some(scene);
                start = offset;
            }
        }
        offset += line.len() as u64;
    }
    Ok(Ok((start, last)))
}

#[derive(Deserialize)]
struct Row {
    scene_id: String,
    qx: f64,
    qy: f64,
    qz: f64,
    qw: f64,
    #[serde(alias = "i")]
    x: f64,
    #[serde(alias = "j")]
    y: f64,
    #[serde(alias = "k")]
    z: f64,
    width: f64,
    label: f64,
    #[serde(default, deserialize_with = "number")]
    share: Option<f32>,
    #[serde(default, deserialize_with = "number")]
    clearance: Option<f32>,
}

/// Parses an optional column. If the column exists, every row must have a value: an empty value is a truncated row.
fn number<'de, D: Deserializer<'de>>(value: D) -> Result<Option<f32>, D::Error> {
    f32::deserialize(value).map(Some)
}

/// Reads the trials of each scene from a folder's table, in the unit of the table.
pub(crate) fn read(folder: &Path, unit: LengthUnit) -> Result<BTreeMap<String, Vec<Trial>>, DataError> {
    let path = folder.join(FILE);
    let wrong = |line, reason| DataError::Row { path: path.clone(), line, reason, columns: unit.columns() };
    let mut reader = csv::Reader::from_reader(File::open(&path).at(&path)?);
    let header = reader.headers().map_err(|error| wrong(1, error.to_string()))?;
    if let Some(column) = unit.missing(header) {
        return Err(wrong(1, format!("the column `{column}` is missing")));
    }
    let mut trials: BTreeMap<String, Vec<Trial>> = BTreeMap::new();
    // The header is line 1.
    for (line, row) in (2..).zip(reader.deserialize::<Row>()) {
        let row = row.map_err(|error| wrong(line, error.to_string()))?;
        let id = row.scene_id.clone();
        let trial = row.check().map_err(|reason| wrong(line, reason))?;
        trials.entry(id).or_default().push(trial);
    }
    if trials.is_empty() {
        return Err(DataError::Empty(folder.to_owned()));
    }
    Ok(trials)
}

impl Row {
    fn check(self) -> Result<Trial, String> {
        let Self { qx, qy, qz, qw, x, y, z, width, label, share, clearance, .. } = self;
        for (name, value) in [("the position", x), ("the position", y), ("the position", z), ("width", width)] {
            if !value.is_finite() {
                return Err(format!("{name} is {value}"));
            }
        }
        let rotation = Quaternion::new(qw, qx, qy, qz);
        if !(0.999..1.001).contains(&rotation.norm()) {
            return Err(format!("the quaternion has length {}", rotation.norm()));
        }
        let success = match label {
            0.0 => false,
            1.0 => true,
            _ => return Err(format!("label is {label}, must be 0 or 1")),
        };
        let share = share.unwrap_or(if success { 1.0 } else { 0.0 });
        if !(0.0..=1.0).contains(&share) {
            return Err(format!("share is {share}, must be from 0 to 1"));
        }
        let clearance = clearance.unwrap_or(0.0);
        if !(0.0..=MAX_CLEARANCE).contains(&clearance) {
            return Err(format!("clearance is {clearance}, must be from 0 to {MAX_CLEARANCE} metres"));
        }
        Ok(Trial {
            position: Point3::new(x, y, z),
            rotation: UnitQuaternion::from_quaternion(rotation),
            width,
            success,
            yaws: 0,
            share,
            clearance,
        })
    }
}
