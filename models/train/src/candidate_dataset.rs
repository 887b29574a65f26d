use std::path::PathBuf;

use grasp_data::{Candidates, DataError};
use sha2::{Digest, Sha256};
use tch::{Kind, Tensor};

/// Labelled grasp candidates, all in memory.
pub struct CandidateDataset {
    /// u8 `[n, shape…]`, 255 for 1.
    images: Tensor,
    /// Whether each candidate succeeded.
    labels: Vec<bool>,
    /// File index and scene number of each candidate.
    scenes: Vec<(usize, u64)>,
}

impl CandidateDataset {
    /// Reads files of [`Candidates`] with images of `shape`; several are mixed.
    ///
    /// # Errors
    /// [`DataError`] names the file that cannot be used.
    pub fn read(files: &[PathBuf], shape: &[usize]) -> Result<Self, DataError> {
        let (mut images, mut labels, mut scenes) = (Vec::new(), Vec::new(), Vec::new());
        for (file, path) in files.iter().enumerate() {
            let candidates = Candidates::read(path)?;
            if candidates.shape != shape {
                let reason = format!("the images are of {:?}, the network needs {shape:?}", candidates.shape);
                let expected =
                    "the candidates of this network; `grasp-sim candidates --network` writes those of an evaluator";
                return Err(DataError::Scene { path: path.clone(), reason, expected });
            }
            let sizes = [&[candidates.len()], shape].concat();
            let sizes: Vec<i64> = sizes.into_iter().map(|size| size as i64).collect();
            images.push(Tensor::from_slice(&candidates.images).reshape(sizes));
            labels.extend(candidates.labels);
            scenes.extend(candidates.scenes.into_iter().map(|scene| (file, scene)));
        }
        Ok(Self { images: Tensor::cat(&images, 0), labels, scenes })
    }

    /// Number of candidates.
    #[must_use]
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Always false: files without candidates are errors.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// Number of successes.
    #[must_use]
    pub fn successes(&self) -> usize {
        self.labels.iter().filter(|&&label| label).count()
    }

    /// Indices of the training and the validation candidates. Validation has all candidates of about `fraction` of the
    /// scenes, chosen by a hash of the scene's file and number.
    #[must_use]
    pub fn split(&self, fraction: f64) -> (Vec<i64>, Vec<i64>) {
        (0..self.len() as i64).partition(|&index| {
            let (file, scene) = self.scenes[index as usize];
            let hash = Sha256::digest(format!("{file}/{scene}"));
            let leading = hash.iter().take(8).fold(0_u64, |number, &byte| number << 8 | u64::from(byte));
            leading as f64 >= fraction * 2.0_f64.powi(64)
        })
    }

    /// Images, f32 `[n, shape…]` in [0, 1], and their classes, i64 `[n]`: 1 for a success.
    pub(crate) fn batch(&self, indices: &[i64]) -> (Tensor, Tensor) {
        let images = self.images.index_select(0, &Tensor::from_slice(indices)).to_kind(Kind::Float) / 255.0;
        let labels: Vec<i64> = indices.iter().map(|&index| i64::from(self.labels[index as usize])).collect();
        (images, Tensor::from_slice(&labels))
    }

    /// Number of failures and of successes among these candidates.
    pub(crate) fn class_counts(&self, indices: &[i64]) -> [usize; 2] {
        let successes = indices.iter().filter(|&&index| self.labels[index as usize]).count();
        [indices.len() - successes, successes]
    }
}
