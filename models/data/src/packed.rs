//! The packed format: a few large append-only files.
//!
//! A folder holds `setup.json` and `scenes-NNNNN.pack`. A file is a header of 16 bytes (`graspack`, the version 4 and N
//! as little-endian u32), followed by records, one per scene:
//!
//! | bytes | content |
//! |---|---|
//! | 4 | length of the content after the checksum |
//! | 4 | CRC-32 of that content |
//! | 8 | number of the scene |
//! | 4, 4, 4 | number of trials, number of volumes, number of occupancies: 0 or 1 |
//! | 41 per trial | position (voxels), quaternion x y z w, width (voxels): eight f32; one byte, bit 0: success, bit k: the grasp rotated by k · 36° about the approach is a success too; share of successful executions and clearance (metres): two f32 |
//! | N³ per volume | [`quantise`]d values, `[x][y][z]` |
//! | ⌈N³ / 8⌉ per occupancy | a bit per voxel, least significant first: whether its centre is inside an object |
//!
//! Files of other versions are refused: `grasp-sim label` makes the scenes again from the folder's `setup.json`.
//!
//! All numbers are little-endian. Readers ignore an incomplete record at the end of a file. A run that continues after
//! an interruption starts a new file, so that a file that is mapped by a reader never shrinks.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use memmap2::Mmap;
use nalgebra::{Point3, Quaternion, UnitQuaternion};

use crate::error::{At, DataError};
use crate::{Occupancy, Setup, Trial, edge_of, quantise};

const MAGIC: &[u8; 8] = b"graspack";
const VERSION: u32 = 4;
const HEADER: usize = 16;
/// Bytes of the length and the checksum before a record's content.
const PREFIX: usize = 8;
/// Bytes of the number of the scene and the counts after it.
const COUNTS: usize = 20;
/// Bytes of a trial.
const TRIAL_SIZE: usize = 41;
/// Largest edge of a volume, voxels: larger ones would fill the memory of every reader.
const MAX_EDGE: usize = 256;

/// Size at which the writer starts the next file, bytes.
const FILE_SIZE: u64 = 1 << 30;

/// Writes scenes in the order of their numbers.
pub struct Writer {
    folder: PathBuf,
    next: Option<u64>,
    /// The open file, its path and its size.
    file: Option<(File, PathBuf, u64)>,
    record: Vec<u8>,
}

impl Writer {
    /// Opens a folder, which is new or was written by an earlier run of the same `setup`.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn open(folder: &Path, setup: &Setup) -> Result<Self, DataError> {
        setup.write_or_compare(folder)?;
        let mut reader = Reader::new(folder);
        reader.refresh()?;
        let next = reader.scenes.iter().map(|scene| scene.number + 1).max();
        Ok(Self { folder: folder.to_owned(), next, file: None, record: Vec::new() })
    }

    /// The number of the next scene, if the folder has scenes already.
    #[must_use]
    pub fn next(&self) -> Option<u64> {
        self.next
    }

    /// Appends a scene in one write: its volumes, each `[N, N, N]` in [0, 1], its trials in voxels, and the voxels inside
    /// its objects, if they are known.
    ///
    /// # Errors
    /// [`DataError`] names the file. Earlier scenes are not lost.
    pub fn append(
        &mut self,
        number: u64,
        volumes: &[Vec<f32>],
        trials: &[Trial],
        occupancy: Option<&Occupancy>,
    ) -> Result<(), DataError> {
        let edge = volumes.first().and_then(|volume| edge_of(volume.len())).unwrap_or(0);
        self.record.clear();
        self.record.extend([0; PREFIX]);
        self.record.extend(number.to_le_bytes());
        self.record.extend((trials.len() as u32).to_le_bytes());
        self.record.extend((volumes.len() as u32).to_le_bytes());
        self.record.extend(u32::from(occupancy.is_some()).to_le_bytes());
        for Trial { position: p, rotation, width, success, yaws, share, clearance } in trials {
            let q = rotation.coords;
            for number in [p.x, p.y, p.z, q.x, q.y, q.z, q.w, *width] {
                self.record.extend((number as f32).to_le_bytes());
            }
            self.record.push(u8::from(*success) | yaws);
            self.record.extend(share.to_le_bytes());
            self.record.extend(clearance.to_le_bytes());
        }
        volumes.iter().for_each(|volume| self.record.extend(quantise(volume)));
        self.record.extend(occupancy.map_or(&[][..], Occupancy::as_bytes));
        let content = &self.record[PREFIX..];
        let (length, checksum) = (content.len() as u32, crc32fast::hash(content));
        self.record[..4].copy_from_slice(&length.to_le_bytes());
        self.record[4..PREFIX].copy_from_slice(&checksum.to_le_bytes());

        let full = self.file.as_ref().is_some_and(|(_, _, size)| *size + self.record.len() as u64 > FILE_SIZE);
        let (mut file, path, size) = match self.file.take() {
            Some(open) if !full => open,
            _ => self.begin_file(edge)?,
        };
        // After an error no file is open, so nothing is appended after an incomplete record.
        file.write_all(&self.record).at(&path)?;
        self.file = Some((file, path, size + self.record.len() as u64));
        self.next = Some(number + 1);
        Ok(())
    }

    fn begin_file(&self, edge: usize) -> Result<(File, PathBuf, u64), DataError> {
        let path = next_file(&self.folder)?;
        let mut file = OpenOptions::new().append(true).create_new(true).open(&path).at(&path)?;
        let header = [MAGIC.as_slice(), &VERSION.to_le_bytes(), &(edge as u32).to_le_bytes()].concat();
        file.write_all(&header).at(&path)?;
        Ok((file, path, HEADER as u64))
    }
}

/// The packed files of a folder, oldest first.
fn files(folder: &Path) -> Result<Vec<PathBuf>, DataError> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).at(folder)? {
        let path = entry.at(folder)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with("scenes-") && name.ends_with(".pack") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Path of the next file.
fn next_file(folder: &Path) -> Result<PathBuf, DataError> {
    let last = files(folder)?.pop();
    let number = last.and_then(|path| path.file_stem()?.to_str()?.strip_prefix("scenes-")?.parse::<u32>().ok());
    Ok(folder.join(format!("scenes-{:05}.pack", number.map_or(0, |number| number + 1))))
}

/// Whether a folder has this format.
pub(crate) fn is_packed(folder: &Path) -> bool {
    files(folder).is_ok_and(|files| !files.is_empty())
}

/// A reader of the complete scenes of a folder, mapped into memory.
pub struct Reader {
    folder: PathBuf,
    files: Vec<PackFile>,
    scenes: Vec<SceneLocation>,
}

struct PackFile {
    path: PathBuf,
    map: Mmap,
    edge: usize,
    /// End of the last complete record.
    end: usize,
}

/// Location of a scene in its file. Checksum and lengths are valid.
struct SceneLocation {
    file: usize,
    number: u64,
    trials: usize,
    volumes: usize,
    has_occupancy: bool,
    /// Offset of the trials.
    start: usize,
    /// Checksum of the record.
    checksum: u32,
}

impl Reader {
    /// Opens a folder. Its writer may still be running.
    ///
    /// # Errors
    /// [`DataError`] names the file that is damaged or not a packed file.
    pub fn open(folder: &Path) -> Result<Self, DataError> {
        let mut reader = Self::new(folder);
        reader.refresh()?;
        Ok(reader)
    }

    fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), files: Vec::new(), scenes: Vec::new() }
    }

    /// Finds scenes that were appended since, and returns their number.
    ///
    /// # Errors
    /// As [`open`](Self::open). Scenes that were read before stay available.
    pub fn refresh(&mut self) -> Result<usize, DataError> {
        let before = self.scenes.len();
        for path in files(&self.folder)? {
            // Not the position in the folder: files without a complete header are skipped.
            let index = self.files.iter().position(|file| file.path == path).unwrap_or(self.files.len());
            let known = self.files.get(index);
            let length = fs::metadata(&path).at(&path)?.len() as usize;
            if length < HEADER || known.is_some_and(|file| file.map.len() == length) {
                continue;
            }
            let map = map(&path)?;
            let edge = check_header(&path, &map)?;
            let end = known.map_or(HEADER, |file| file.end);
            let mut file = PackFile { path, map, edge, end };
            // Offsets of earlier records stay valid.
            self.scenes.extend(file.read_appended(index)?);
            match self.files.get_mut(index) {
                Some(known) => *known = file,
                None => self.files.push(file),
            }
        }
        Ok(self.scenes.len() - before)
    }

    /// Number of scenes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.scenes.len()
    }

    /// Whether there are no scenes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.scenes.is_empty()
    }

    /// Voxels along an edge of scene `index`.
    #[must_use]
    pub fn resolution(&self, index: usize) -> usize {
        self.files[self.scenes[index].file].edge
    }

    /// The number of scene `index`.
    #[must_use]
    pub fn number(&self, index: usize) -> u64 {
        self.scenes[index].number
    }

    /// Checksum of scene `index`, with its volumes.
    pub(crate) fn checksum(&self, index: usize) -> u32 {
        self.scenes[index].checksum
    }

    /// Number of volumes of scene `index`.
    #[must_use]
    pub fn volumes(&self, index: usize) -> usize {
        self.scenes[index].volumes
    }

    /// Volume `observation` of scene `index`, [`quantise`]d.
    #[must_use]
    pub fn volume(&self, index: usize, observation: usize) -> &[u8] {
        let scene = &self.scenes[index];
        let file = &self.files[scene.file];
        let size = file.edge.pow(3);
        &file.map[scene.start + scene.trials * TRIAL_SIZE + observation * size..][..size]
    }

    /// The voxels inside the objects of scene `index`, if they are known.
    #[must_use]
    pub fn occupancy(&self, index: usize) -> Option<Occupancy> {
        let scene = &self.scenes[index];
        let file = &self.files[scene.file];
        let voxels = file.edge.pow(3);
        let start = scene.start + scene.trials * TRIAL_SIZE + scene.volumes * voxels;
        let bytes = scene.has_occupancy.then(|| &file.map[start..][..Occupancy::size(voxels)])?;
        Occupancy::from_bytes(bytes, voxels)
    }

    /// The trials of scene `index`.
    #[must_use]
    pub fn trials(&self, index: usize) -> Vec<Trial> {
        let scene = &self.scenes[index];
        let file = &self.files[scene.file];
        file.map[scene.start..][..scene.trials * TRIAL_SIZE].chunks_exact(TRIAL_SIZE).map(parse_trial).collect()
    }
}

fn parse_trial(bytes: &[u8]) -> Trial {
    let [x, y, z, qx, qy, qz, qw, width] = std::array::from_fn(|i| f64::from(f32_at(bytes, 4 * i)));
    Trial {
        position: Point3::new(x, y, z),
        rotation: UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz)),
        width,
        success: bytes[32] & 1 != 0,
        yaws: bytes[32] & !1,
        share: f32_at(bytes, 33),
        clearance: f32_at(bytes, 37),
    }
}

impl PackFile {
    /// Reads the complete records after `end` and moves `end` behind them. `file` is the index of this file.
    fn read_appended(&mut self, file: usize) -> Result<Vec<SceneLocation>, DataError> {
        let mut scenes = Vec::new();
        while let Some(prefix) = self.map.get(self.end..self.end + PREFIX) {
            let (length, checksum) = (u32_at(prefix, 0) as usize, u32_at(prefix, 4));
            let start = self.end + PREFIX;
            let Some(content) = self.map.get(start..start + length) else { break };
            let damaged = |reason: String| {
                let (path, offset) = (self.path.clone(), self.end as u64);
                DataError::Damaged { path, offset, reason }
            };
            if crc32fast::hash(content) != checksum {
                return Err(damaged("the checksum of a scene does not match".to_owned()));
            }
            if length < COUNTS {
                return Err(damaged(format!("a scene of {length} bytes is too short")));
            }
            let [trials, volumes, occupancies] = [8, 12, 16].map(|offset| u32_at(content, offset) as usize);
            let voxels = self.edge.pow(3);
            // Fits: the counts have 32 bits, and a volume at most 2²⁴ voxels.
            let size = COUNTS + trials * TRIAL_SIZE + volumes * voxels + occupancies * Occupancy::size(voxels);
            if occupancies > 1 || length != size {
                return Err(damaged(format!(
                    "a scene of {trials} trials, {volumes} volumes and {occupancies} occupancies cannot have {length} \
                     bytes"
                )));
            }
            let number = u64::from(u32_at(content, 0)) | u64::from(u32_at(content, 4)) << 32;
            let (start_of_trials, has_occupancy) = (start + COUNTS, occupancies > 0);
            scenes.push(SceneLocation {
                file,
                number,
                trials,
                volumes,
                has_occupancy,
                start: start_of_trials,
                checksum,
            });
            self.end = start + length;
        }
        Ok(scenes)
    }
}

/// Edge of the volumes of a file.
fn check_header(path: &Path, bytes: &[u8]) -> Result<usize, DataError> {
    let damaged = |reason: String| DataError::Damaged { path: path.to_owned(), offset: 0, reason };
    if &bytes[..8] != MAGIC {
        return Err(damaged("the file does not begin with `graspack`".to_owned()));
    }
    let (version, edge) = (u32_at(bytes, 8), u32_at(bytes, 12) as usize);
    if version != VERSION {
        return Err(damaged(format!(
            "the version is {version}, must be {VERSION}; make the scenes again with `grasp-sim label` and the settings in \
             setup.json"
        )));
    }
    if edge > MAX_EDGE {
        return Err(damaged(format!("the edge of a volume is {edge} voxels, must be at most {MAX_EDGE}")));
    }
    Ok(edge)
}

#[expect(
    unsafe_code,
    reason = "sound because the file does not shrink: a writer only appends, and only to files that it created"
)]
fn map(path: &Path) -> Result<Mmap, DataError> {
    let file = File::open(path).at(path)?;
    // SAFETY: see the reason above.
    unsafe { Mmap::map(&file) }.at(path)
}

fn u32_at(bytes: &[u8], offset: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes[offset + i]))
}

fn f32_at(bytes: &[u8], offset: usize) -> f32 {
    f32::from_bits(u32_at(bytes, offset))
}

/// Copies the packed files of several folders with the same setup into one folder, and returns the number of scenes.
///
/// # Errors
/// [`DataError`] names a folder with another setup or without packed files, or two folders with the same scene. `into` is
/// not changed then.
pub fn merge(folders: &[PathBuf], into: &Path) -> Result<usize, DataError> {
    let mut seen = BTreeMap::new();
    let mut setup: Option<Setup> = None;
    for folder in folders {
        let found = Setup::read(folder)?;
        match &setup {
            Some(first) if *first != found => {
                let found = fs::read_to_string(folder.join("setup.json")).at(folder)?;
                return Err(DataError::OtherSetup { path: folder.join("setup.json"), found });
            }
            _ => setup = Some(found),
        }
        if !is_packed(folder) {
            return Err(DataError::Empty(folder.clone()));
        }
        let reader = Reader::open(folder)?;
        for index in 0..reader.len() {
            let number = reader.number(index);
            if let Some(first) = seen.insert(number, folder) {
                let (first, second) = (first.clone(), folder.clone());
                return Err(DataError::DuplicateScene { id: format!("{number:08}"), first, second });
            }
        }
    }
    let Some(setup) = setup else { return Err(DataError::Empty(into.to_owned())) };
    setup.write_or_compare(into)?;
    if is_packed(into) {
        return Err(DataError::NotEmpty(into.to_owned()));
    }
    for folder in folders {
        for source in files(folder)? {
            let path = next_file(into)?;
            // Copied under another name and renamed when complete.
            let partial = path.with_extension("partial");
            fs::copy(&source, &partial).at(&partial)?;
            fs::rename(&partial, &path).at(&path)?;
        }
    }
    Ok(seen.len())
}
