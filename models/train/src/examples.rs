use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use grasp::gpd::{CHANNELS, IMAGE_SIZE};
use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{Deserialize, NpyFile};
use sha2::{Digest, Sha256};
use tch::{Kind, Tensor};
use thiserror::Error;

/// Tried grasp candidates, all in memory.
pub struct Examples {
    /// u8 `[n, CHANNELS, IMAGE_SIZE, IMAGE_SIZE]`, 255 for 1.
    images: Tensor,
    /// Whether each succeeded.
    labels: Vec<bool>,
    /// The file and the scene of each.
    scenes: Vec<(usize, u64)>,
}

/// What is wrong with a file of candidates.
#[derive(Debug, Error)]
#[error(
    "{}: {reason}; it must hold `images` u8 [n, {CHANNELS}, {IMAGE_SIZE}, {IMAGE_SIZE}], `labels` u8 [n] of 0 and 1, and \
     `scenes` u64 [n], as `grasp-sim candidates` writes them",
    path.display()
)]
pub struct ExamplesError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub reason: String,
}

impl Examples {
    /// Reads files that `grasp-sim candidates` wrote; several are mixed.
    ///
    /// # Errors
    /// [`ExamplesError`] names the file that cannot be used.
    pub fn read(files: &[PathBuf]) -> Result<Self, ExamplesError> {
        let (mut images, mut labels, mut scenes) = (Vec::new(), Vec::new(), Vec::new());
        for (file, path) in files.iter().enumerate() {
            let wrong = |reason: String| ExamplesError { path: path.clone(), reason };
            let arrays = read(path).map_err(|error| wrong(error.to_string()))?;
            let count = arrays.labels.len();
            if arrays.shape != [count as u64, CHANNELS as u64, IMAGE_SIZE as u64, IMAGE_SIZE as u64] {
                return Err(wrong(format!("`images` is {:?} and there are {count} labels", arrays.shape)));
            }
            if arrays.scenes.len() != count || count == 0 {
                return Err(wrong(format!("there are {count} labels and {} scenes", arrays.scenes.len())));
            }
            if let Some(label) = arrays.labels.iter().find(|&&label| label > 1) {
                return Err(wrong(format!("a label is {label}")));
            }
            let shape = arrays.shape.map(|dim| dim as i64);
            images.push(Tensor::from_slice(&arrays.images).reshape(shape));
            labels.extend(arrays.labels.into_iter().map(|label| label == 1));
            scenes.extend(arrays.scenes.into_iter().map(|scene| (file, scene)));
        }
        Ok(Self { images: Tensor::cat(&images, 0), labels, scenes })
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Never: a file without candidates is refused.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// How many of them succeeded.
    #[must_use]
    pub fn successes(&self) -> usize {
        self.labels.iter().filter(|&&label| label).count()
    }

    /// Which ones to learn from and which are held out: all candidates of about `fraction` of the scenes, chosen by a
    /// hash of the scene's file and number.
    #[must_use]
    pub fn split(&self, fraction: f64) -> (Vec<i64>, Vec<i64>) {
        (0..self.len() as i64).partition(|&index| {
            let (file, scene) = self.scenes[index as usize];
            let hash = Sha256::digest(format!("{file}/{scene}"));
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
    }

    /// Some images, f32 in [0, 1], and their classes: 1 for a success.
    pub(crate) fn batch(&self, indices: &[i64]) -> (Tensor, Tensor) {
        let images = self.images.index_select(0, &Tensor::from_slice(indices)).to_kind(Kind::Float) / 255.0;
        let labels: Vec<i64> = indices.iter().map(|&index| i64::from(self.labels[index as usize])).collect();
        (images, Tensor::from_slice(&labels))
    }

    /// How many of these failed, and how many succeeded.
    pub(crate) fn classes(&self, indices: &[i64]) -> [usize; 2] {
        let successes = indices.iter().filter(|&&index| self.labels[index as usize]).count();
        [indices.len() - successes, successes]
    }
}

struct Arrays {
    shape: [u64; 4],
    images: Vec<u8>,
    labels: Vec<u8>,
    scenes: Vec<u64>,
}

fn read(path: &Path) -> io::Result<Arrays> {
    let mut archive = NpzArchive::open(path)?;
    let (shape, images) = array(&mut archive, "images")?;
    let shape = <[u64; 4]>::try_from(shape)
        .map_err(|shape| io::Error::new(io::ErrorKind::InvalidData, format!("`images` is {shape:?}")))?;
    Ok(Arrays { shape, images, labels: array(&mut archive, "labels")?.1, scenes: array(&mut archive, "scenes")?.1 })
}

fn array<T: Deserialize>(archive: &mut NpzArchive<io::BufReader<File>>, name: &str) -> io::Result<(Vec<u64>, Vec<T>)> {
    let file = archive.zip_archive().by_name(&file_name_from_array_name(name));
    let file = file.map_err(|error| io::Error::other(format!("`{name}`: {error}")))?;
    // Without a buffer every pixel would be a call to the decompressor.
    let array = NpyFile::new(io::BufReader::with_capacity(1 << 16, file))?;
    Ok((array.shape().to_vec(), array.into_vec()?))
}
