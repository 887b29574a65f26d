use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::error::{At, DataError};
use crate::grasp_table::LengthUnit;
use crate::{Occupancy, Scene, Trial, edge_of, packed, processed};

/// The format of a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataFormat {
    /// Depth images and grasps in metres: the raw format of VGN and GIGA.
    Raw,
    /// Volumes and grasps in voxels: the processed format of VGN and GIGA.
    Processed,
    /// The packed format of graspd.
    Packed,
}

impl DataFormat {
    /// Detects the format of a folder.
    ///
    /// # Errors
    /// [`DataError`] if it cannot be read or is not a data set.
    pub fn from_folder(folder: &Path) -> Result<Self, DataError> {
        fs::metadata(folder).at(folder)?;
        if packed::is_packed(folder) {
            return Ok(Self::Packed);
        }
        match LengthUnit::from_folder(folder)? {
            Some(LengthUnit::Metres) => Ok(Self::Raw),
            Some(LengthUnit::Voxels) => Ok(Self::Processed),
            None => Err(DataError::Empty(folder.to_owned())),
        }
    }
}

/// Scenes of one resolution for training. Packed folders are mapped into memory, processed ones are read.
pub struct Dataset {
    resolution: usize,
    sources: Vec<Source>,
    /// Index of the source, and index of the scene in it.
    scenes: Vec<(usize, usize)>,
}

enum Source {
    Packed(packed::Reader),
    Memory(Vec<Scene>),
}

impl Dataset {
    /// Opens processed or packed folders as one data set.
    ///
    /// # Errors
    /// [`DataError`] names the invalid file.
    pub fn open(folders: &[PathBuf]) -> Result<Self, DataError> {
        let mut dataset = Self::empty();
        for folder in folders {
            let source = match DataFormat::from_folder(folder)? {
                DataFormat::Packed => Source::Packed(packed::Reader::open(folder)?),
                DataFormat::Processed => Source::Memory(processed::read(folder)?),
                DataFormat::Raw => {
                    return Err(DataError::Scene {
                        path: folder.clone(),
                        reason: "the folder holds depth images; fuse them with `grasp-sim convert`".to_owned(),
                        expected: "volumes",
                    });
                }
            };
            if source.len() == 0 {
                return Err(DataError::Empty(folder.clone()));
            }
            dataset.add(source).map_err(|reason| DataError::Scene {
                path: folder.clone(),
                reason,
                expected: "volumes of the same resolution as the other scenes",
            })?;
        }
        Ok(dataset)
    }

    /// An empty data set.
    #[must_use]
    pub fn empty() -> Self {
        Self { resolution: 0, sources: Vec::new(), scenes: Vec::new() }
    }

    /// A data set of scenes in memory; `None` unless all their volumes are cubes of one resolution.
    #[must_use]
    pub fn new(scenes: Vec<Scene>) -> Option<Self> {
        let mut dataset = Self::empty();
        dataset.add(Source::Memory(scenes)).ok()?;
        Some(dataset)
    }

    fn add(&mut self, source: Source) -> Result<(), String> {
        let index = self.sources.len();
        for scene in 0..source.len() {
            let resolution = source.resolution(scene)?;
            if self.resolution != 0 && resolution != self.resolution {
                return Err(format!("a volume has {resolution}³ voxels, the previous ones have {}³", self.resolution));
            }
            self.resolution = resolution;
            self.scenes.push((index, scene));
        }
        self.sources.push(source);
        Ok(())
    }

    /// Adds scenes that were appended to packed folders since the last call, and returns their number. Scenes are
    /// ordered by folder, so the index of scenes of later folders changes.
    ///
    /// # Errors
    /// [`DataError`] names the damaged file.
    pub fn refresh(&mut self) -> Result<usize, DataError> {
        let before = self.scenes.len();
        for source in &mut self.sources {
            if let Source::Packed(reader) = source {
                reader.refresh()?;
            }
        }
        let sizes: Vec<usize> = self.sources.iter().map(Source::len).collect();
        self.limit(&sizes);
        Ok(self.scenes.len() - before)
    }

    /// Number of scenes of each folder.
    #[must_use]
    pub fn sizes(&self) -> Vec<usize> {
        let count = |index| self.scenes.iter().filter(|(source, _)| *source == index).count();
        (0..self.sources.len()).map(count).collect()
    }

    /// Keeps only the first scenes of each folder, as many as `sizes` gives, until the next [`refresh`](Self::refresh).
    pub fn limit(&mut self, sizes: &[usize]) {
        let kept = self.sources.iter().zip(sizes).enumerate();
        self.scenes = kept
            .flat_map(|(index, (source, &size))| (0..size.min(source.len())).map(move |scene| (index, scene)))
            .collect();
    }

    /// N: voxels along an edge of each volume.
    #[must_use]
    pub fn resolution(&self) -> usize {
        self.resolution
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

    /// The name of scene `index`, unique in its folder.
    #[must_use]
    pub fn id(&self, index: usize) -> String {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => format!("{:08}", reader.number(scene)),
            Source::Memory(scenes) => scenes[scene].id.clone(),
        }
    }

    /// Number of volumes of scene `index`.
    #[must_use]
    pub fn volumes(&self, index: usize) -> usize {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.volumes(scene),
            Source::Memory(scenes) => scenes[scene].volumes.len(),
        }
    }

    /// Volume `observation` of scene `index`: `[N, N, N]`, z fastest, as bytes that [`value`](crate::value) converts to
    /// values.
    #[must_use]
    pub fn volume(&self, index: usize, observation: usize) -> &[u8] {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.volume(scene, observation),
            Source::Memory(scenes) => &scenes[scene].volumes[observation],
        }
    }

    /// The trials of scene `index`, in voxels.
    #[must_use]
    pub fn trials(&self, index: usize) -> Vec<Trial> {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.trials(scene),
            Source::Memory(scenes) => scenes[scene].trials.clone(),
        }
    }

    /// The voxels inside the objects of scene `index`, if they are known.
    #[must_use]
    pub fn occupancy(&self, index: usize) -> Option<Occupancy> {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.occupancy(scene),
            Source::Memory(scenes) => scenes[scene].occupancy.clone(),
        }
    }

    /// Number of trials in `scenes`, and number of successes among them.
    #[must_use]
    pub fn grasps(&self, scenes: &[usize]) -> (usize, usize) {
        scenes.iter().fold((0, 0), |(all, successes), &scene| {
            let trials = self.trials(scene);
            (all + trials.len(), successes + trials.iter().filter(|trial| trial.success).count())
        })
    }

    /// A hash of 16 hexadecimal digits over the names, trials, volumes and order of the scenes. Of the volumes only
    /// checksums are hashed, because they are a thousand times larger than the trials.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        for scene in 0..self.len() {
            let (id, trials) = (self.id(scene), self.trials(scene));
            // Lengths are hashed too, so that different data sets do not give the same bytes.
            hash.update((id.len() as u64).to_le_bytes());
            hash.update(&id);
            hash.update((trials.len() as u64).to_le_bytes());
            hash.update((self.volumes(scene) as u64).to_le_bytes());
            hash.update(self.checksum(scene).to_le_bytes());
            update(&mut hash, &trials);
        }
        hash.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// A checksum of the volumes of scene `index`, and of its occupancy.
    fn checksum(&self, index: usize) -> u32 {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.checksum(scene),
            Source::Memory(scenes) => {
                let mut hasher = crc32fast::Hasher::new();
                scenes[scene].volumes.iter().for_each(|volume| hasher.update(volume));
                scenes[scene].occupancy.iter().for_each(|occupancy| hasher.update(occupancy.as_bytes()));
                hasher.finalize()
            }
        }
    }

    /// Whether all folders are packed.
    #[must_use]
    pub fn is_packed(&self) -> bool {
        self.sources.iter().all(|source| matches!(source, Source::Packed(_)))
    }

    /// Indices of the scenes, each once: of a scene that was observed again into another folder, which has the same name
    /// and trials there, only the first.
    #[must_use]
    pub fn distinct(&self) -> Vec<usize> {
        let mut known = HashSet::new();
        let is_new = |&scene: &usize| {
            let mut hash = Sha256::new();
            update(&mut hash, &self.trials(scene));
            known.insert((self.id(scene), hash.finalize()))
        };
        (0..self.len()).filter(is_new).collect()
    }

    /// Indices of the training scenes and of the validation scenes, about `fraction` of all. They are split by a hash of
    /// the scene's name, so that a scene stays on its side when others are added.
    #[must_use]
    pub fn split(&self, fraction: f64) -> (Vec<usize>, Vec<usize>) {
        (0..self.len()).partition(|&index| {
            let hash = Sha256::digest(self.id(index));
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
    }
}

/// Adds trials to a hash.
fn update(hash: &mut Sha256, trials: &[Trial]) {
    for Trial { position, rotation, width, success, yaws, share, clearance } in trials {
        for number in position.coords.iter().chain(rotation.coords.iter()).chain([width]) {
            hash.update(number.to_le_bytes());
        }
        hash.update([u8::from(*success) | yaws]);
        hash.update(share.to_le_bytes());
        hash.update(clearance.to_le_bytes());
    }
}

impl Source {
    fn len(&self) -> usize {
        match self {
            Self::Packed(reader) => reader.len(),
            Self::Memory(scenes) => scenes.len(),
        }
    }

    fn resolution(&self, scene: usize) -> Result<usize, String> {
        match self {
            Self::Packed(reader) => Ok(reader.resolution(scene)),
            Self::Memory(scenes) => {
                let voxels: Vec<usize> = scenes[scene].volumes.iter().map(Vec::len).collect();
                let edge = voxels.first().and_then(|&first| edge_of(first));
                let same = voxels.iter().all(|&count| count == voxels[0]);
                edge.filter(|_| same)
                    .ok_or_else(|| format!("the volumes of scene {} have {voxels:?} voxels", scenes[scene].id))
            }
        }
    }
}
