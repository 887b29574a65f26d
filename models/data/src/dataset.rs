use std::fs;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::error::{At, DataError};
use crate::table::Unit;
use crate::{Scene, Trial, edge_of, packed, processed};

/// In which of the three forms a folder is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// VGN's depth images.
    Raw,
    /// VGN's volumes.
    Processed,
    /// Ours.
    Packed,
}

impl Form {
    /// What a folder holds.
    ///
    /// # Errors
    /// [`DataError`] when it cannot be read, or is no data set.
    pub fn of(folder: &Path) -> Result<Self, DataError> {
        fs::metadata(folder).at(folder)?;
        if packed::is_packed(folder) {
            return Ok(Self::Packed);
        }
        match Unit::of(folder) {
            Some(Unit::Metres) => Ok(Self::Raw),
            Some(Unit::Voxels) => Ok(Self::Processed),
            None => Err(DataError::Empty(folder.to_owned())),
        }
    }
}

/// Scenes of one resolution to learn from: packed folders are mapped, processed ones read into memory.
pub struct Dataset {
    resolution: usize,
    sources: Vec<Source>,
    /// Which source, and which scene of it.
    scenes: Vec<(usize, usize)>,
}

enum Source {
    Packed(packed::Reader),
    Memory(Vec<Scene>),
}

impl Dataset {
    /// Opens folders, processed or packed, as one data set.
    ///
    /// # Errors
    /// [`DataError`] names the file that cannot be used.
    pub fn open(folders: &[PathBuf]) -> Result<Self, DataError> {
        let mut dataset = Self::none();
        for folder in folders {
            let source = match Form::of(folder)? {
                Form::Packed => Source::Packed(packed::Reader::open(folder)?),
                Form::Processed => Source::Memory(processed::read(folder)?),
                Form::Raw => {
                    return Err(DataError::Scene {
                        path: folder.clone(),
                        reason: "it holds depth images, which are fused first: `grasp-sim convert`".to_owned(),
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
                expected: "volumes of the same size as the others",
            })?;
        }
        Ok(dataset)
    }

    /// No scenes at all.
    #[must_use]
    pub fn none() -> Self {
        Self { resolution: 0, sources: Vec::new(), scenes: Vec::new() }
    }

    /// Scenes that are in memory already; `None` unless all their volumes are cubes of one size.
    #[must_use]
    pub fn of(scenes: Vec<Scene>) -> Option<Self> {
        let mut dataset = Self::none();
        dataset.add(Source::Memory(scenes)).ok()?;
        Some(dataset)
    }

    fn add(&mut self, source: Source) -> Result<(), String> {
        let index = self.sources.len();
        for scene in 0..source.len() {
            let resolution = source.resolution(scene)?;
            if self.resolution != 0 && resolution != self.resolution {
                return Err(format!("it has {resolution}³ voxels, what came before {}³", self.resolution));
            }
            self.resolution = resolution;
            self.scenes.push((index, scene));
        }
        self.sources.push(source);
        Ok(())
    }

    /// Takes in the scenes that were added to packed folders since; says how many. Scenes are in the order of their
    /// folders, so that all that follow a folder which grew have another index then.
    ///
    /// # Errors
    /// [`DataError`] names the file that is damaged.
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

    /// How many scenes of each folder there are.
    #[must_use]
    pub fn sizes(&self) -> Vec<usize> {
        let count = |index| self.scenes.iter().filter(|(source, _)| *source == index).count();
        (0..self.sources.len()).map(count).collect()
    }

    /// Keeps so many scenes of each folder, the first, until the next [`refresh`](Self::refresh).
    pub fn limit(&mut self, sizes: &[usize]) {
        let kept = self.sources.iter().zip(sizes).enumerate();
        self.scenes = kept
            .flat_map(|(index, (source, &size))| (0..size.min(source.len())).map(move |scene| (index, scene)))
            .collect();
    }

    /// N: voxels along an edge of every volume.
    #[must_use]
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// How many scenes there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.scenes.len()
    }

    /// Whether there are none.
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

    /// In how many volumes scene `index` was observed.
    #[must_use]
    pub fn volumes(&self, index: usize) -> usize {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.volumes(scene),
            Source::Memory(scenes) => scenes[scene].volumes.len(),
        }
    }

    /// One of them: `[N, N, N]`, z fastest, as bytes of which [`value`](crate::value) tells the meaning.
    #[must_use]
    pub fn volume(&self, index: usize, look: usize) -> &[u8] {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.volume(scene, look),
            Source::Memory(scenes) => &scenes[scene].volumes[look],
        }
    }

    /// The grasps of scene `index`, in voxels.
    #[must_use]
    pub fn trials(&self, index: usize) -> Vec<Trial> {
        let (source, scene) = self.scenes[index];
        match &self.sources[source] {
            Source::Packed(reader) => reader.trials(scene),
            Source::Memory(scenes) => scenes[scene].trials.clone(),
        }
    }

    /// How many grasps some scenes have, and how many of those succeeded.
    #[must_use]
    pub fn grasps(&self, scenes: &[usize]) -> (usize, usize) {
        scenes.iter().fold((0, 0), |(all, successes), &scene| {
            let trials = self.trials(scene);
            (all + trials.len(), successes + trials.iter().filter(|trial| trial.success).count())
        })
    }

    /// Sixteen hexadecimal digits that change when the name of a scene or a grasp of it does, and with the order of the
    /// scenes. Their volumes, a thousand times as much, are left out: who makes them anew tries other grasps, too.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        for scene in 0..self.len() {
            let (id, trials) = (self.id(scene), self.trials(scene));
            // With their lengths, so that no two data sets are the same bytes.
            hash.update((id.len() as u64).to_le_bytes());
            hash.update(&id);
            hash.update((trials.len() as u64).to_le_bytes());
            hash.update((self.volumes(scene) as u64).to_le_bytes());
            for Trial { position, rotation, width, success, turns, share, clearance } in &trials {
                for number in position.coords.iter().chain(rotation.coords.iter()).chain([width]) {
                    hash.update(number.to_le_bytes());
                }
                hash.update([u8::from(*success) | turns]);
                hash.update(share.to_le_bytes());
                hash.update(clearance.to_le_bytes());
            }
        }
        hash.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// Indices of the scenes to learn from and of those held out: about `fraction` of them, chosen by a hash of the
    /// scene's name, so that a scene stays on its side when others are added.
    #[must_use]
    pub fn split(&self, fraction: f64) -> (Vec<usize>, Vec<usize>) {
        (0..self.len()).partition(|&index| {
            let hash = Sha256::digest(self.id(index));
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
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
                    .ok_or_else(|| format!("scene {} has volumes of {voxels:?} voxels", scenes[scene].id))
            }
        }
    }
}
