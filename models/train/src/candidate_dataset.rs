use std::path::PathBuf;

use grasp_data::{Candidates, DataError};
use tch::{Kind, Tensor};

use crate::Examples;

/// Labelled candidates of GPD, all in memory.
pub struct CandidateDataset {
    /// u8 `[n, shape…]`, 255 for 1.
    images: Tensor,
    /// Whether each candidate succeeded.
    labels: Vec<bool>,
    /// Scene number of each candidate.
    scenes: Vec<u64>,
}

impl CandidateDataset {
    /// Reads files of [`Candidates`] with images of `shape`; several are mixed.
    ///
    /// # Errors
    /// [`DataError`] names the file that cannot be used.
    pub fn read(files: &[PathBuf], shape: &[usize]) -> Result<Self, DataError> {
        let (mut images, mut labels, mut scenes) = (Vec::new(), Vec::new(), Vec::new());
        for path in files {
            let candidates = Candidates::read(path)?;
            if candidates.shape != shape {
                let reason = format!("the images are of {:?}, the network needs {shape:?}", candidates.shape);
                let expected = "the candidates of this network";
                return Err(DataError::Scene { path: path.clone(), reason, expected });
            }
            let sizes = [&[candidates.len()], shape].concat();
            let sizes: Vec<i64> = sizes.into_iter().map(|size| size as i64).collect();
            images.push(Tensor::from_slice(&candidates.images).reshape(sizes));
            labels.extend(candidates.labels);
            scenes.extend(candidates.scenes);
        }
        Ok(Self { images: Tensor::cat(&images, 0), labels, scenes })
    }
}

impl Examples for CandidateDataset {
    fn len(&self) -> usize {
        self.labels.len()
    }

    fn class(&self, index: usize) -> usize {
        usize::from(self.labels[index])
    }

    fn classes(&self) -> usize {
        2
    }

    fn scene(&self, index: usize) -> String {
        self.scenes[index].to_string()
    }

    fn images(&self, indices: &[i64], _mirrored: [bool; 2]) -> Tensor {
        self.images.index_select(0, &Tensor::from_slice(indices)).to_kind(Kind::Float) / 255.0
    }
}
