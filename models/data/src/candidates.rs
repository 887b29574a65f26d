//! Tried grasp candidates, the training data of GPD's classifier: an `.npz` file with
//!
//! - `images`, u8 `[n, shape…]`, 255 for 1: [`grasp::gpd::Image`]s;
//! - `labels`, u8 `[n]`, 1 for a success;
//! - `scenes`, u64 `[n]`, the scene number of each candidate.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use npyz::npz::{NpzArchive, NpzWriter, file_name_from_array_name};
use npyz::{AutoSerialize, Deserialize, NpyFile, WriterBuilder};

use crate::error::{At, DataError};
use crate::{finish, without_time};

const EXPECTED: &str =
    "`images` u8 [n, shape…], `labels` u8 [n] of 0 and 1, and `scenes` u64 [n], as `grasp-sim candidates` writes them";

/// Candidates in memory.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Candidates {
    /// Shape of an image. Empty without candidates.
    pub shape: Vec<usize>,
    /// The images of the candidates, one after the other.
    pub images: Vec<u8>,
    /// Whether each candidate succeeded.
    pub labels: Vec<bool>,
    /// Scene number of each candidate.
    pub scenes: Vec<u64>,
}

impl Candidates {
    /// Adds a candidate of scene `scene`, with an image of `shape`.
    ///
    /// # Panics
    /// If the shape is not that of the other images, or the image does not have it.
    pub fn push(&mut self, scene: u64, shape: &[usize], image: &[u8], success: bool) {
        assert!(self.is_empty() || self.shape == shape, "the images are of {:?}, not {shape:?}", self.shape);
        assert_eq!(image.len(), shape.iter().product::<usize>(), "the image is of {shape:?}");
        self.shape = shape.to_vec();
        self.images.extend_from_slice(image);
        self.labels.push(success);
        self.scenes.push(scene);
    }

    /// Adds all candidates of `others`.
    ///
    /// # Panics
    /// If the shapes of the images differ.
    pub fn append(&mut self, mut others: Self) {
        if others.is_empty() {
            return;
        }
        assert!(self.is_empty() || self.shape == others.shape, "{:?} is not {:?}", others.shape, self.shape);
        self.shape = others.shape;
        self.images.append(&mut others.images);
        self.labels.append(&mut others.labels);
        self.scenes.append(&mut others.scenes);
    }

    /// Number of candidates.
    #[must_use]
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there are no candidates.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// Number of successes.
    #[must_use]
    pub fn successes(&self) -> usize {
        self.labels.iter().filter(|&&label| label).count()
    }

    /// Writes a file under a temporary name and renames it. The same candidates give the same bytes.
    ///
    /// # Errors
    /// [`DataError`] names the file.
    pub fn write(&self, path: &Path) -> Result<(), DataError> {
        let partial = path.with_extension("npz.partial");
        self.write_arrays(&partial).at(&partial)?;
        fs::rename(&partial, path).at(path)
    }

    fn write_arrays(&self, path: &Path) -> io::Result<()> {
        let mut archive = NpzWriter::create(path)?;
        let count = self.labels.len() as u64;
        let shape: Vec<u64> = [count].into_iter().chain(self.shape.iter().map(|&size| size as u64)).collect();
        write_array(&mut archive, "images", &shape, self.images.iter().copied())?;
        write_array(&mut archive, "labels", &[count], self.labels.iter().map(|&label| u8::from(label)))?;
        write_array(&mut archive, "scenes", &[self.scenes.len() as u64], self.scenes.iter().copied())?;
        finish(archive)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`DataError`] names the file and its invalid array.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let wrong = |reason| DataError::Scene { path: path.to_owned(), reason, expected: EXPECTED };
        let mut archive = NpzArchive::open(path).at(path)?;
        let (shape, images) = read_array::<u8>(&mut archive, "images").at(path)?;
        let (_, labels) = read_array::<u8>(&mut archive, "labels").at(path)?;
        let (_, scenes) = read_array::<u64>(&mut archive, "scenes").at(path)?;
        let count = labels.len();
        if shape.len() < 2 || shape[0] != count as u64 {
            return Err(wrong(format!("the shape of `images` is {shape:?} for {count} labels")));
        }
        if scenes.len() != count || count == 0 {
            return Err(wrong(format!("there are {count} labels and {} scene numbers", scenes.len())));
        }
        if let Some(label) = labels.iter().find(|&&label| label > 1) {
            return Err(wrong(format!("a label is {label}")));
        }
        let shape = shape[1..].iter().map(|&size| size as usize).collect();
        Ok(Self { shape, images, labels: labels.into_iter().map(|label| label == 1).collect(), scenes })
    }
}

fn write_array<T: AutoSerialize>(
    archive: &mut NpzWriter<io::BufWriter<File>>,
    name: &str,
    shape: &[u64],
    values: impl Iterator<Item = T>,
) -> io::Result<()> {
    // The images of 100,000 candidates have more than 4 GiB.
    archive.zip_writer().start_file(file_name_from_array_name(name), without_time().large_file(true))?;
    // Buffered: a call to the compressor for every pixel takes about as long as the trials.
    let mut file = io::BufWriter::with_capacity(1 << 16, archive.zip_writer());
    let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut file).begin_nd()?;
    array.extend(values)?;
    array.finish()?;
    file.flush()
}

fn read_array<T: Deserialize>(
    archive: &mut NpzArchive<io::BufReader<File>>,
    name: &str,
) -> io::Result<(Vec<u64>, Vec<T>)> {
    let file = archive.zip_archive().by_name(&file_name_from_array_name(name));
    let file = file.map_err(|error| io::Error::other(format!("`{name}`: {error}")))?;
    // Buffered, to avoid a call to the decompressor for every pixel.
    let array = NpyFile::new(io::BufReader::with_capacity(1 << 16, file))?;
    if array.order() != npyz::Order::C {
        return Err(io::Error::other(format!("`{name}` is in Fortran order; save it in C order")));
    }
    Ok((array.shape().to_vec(), array.into_vec()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> Candidates {
        let images = (0..2 * 24).collect();
        Candidates { shape: vec![2, 3, 4], images, labels: vec![true, false], scenes: vec![7, 9] }
    }

    #[test]
    fn candidates_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("candidates.npz");
        two().write(&path).unwrap();
        assert_eq!(Candidates::read(&path).unwrap(), two());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "no partial file remains");
    }

    #[test]
    fn an_error_names_the_file_and_the_invalid_array() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("candidates.npz");
        let refused = |candidates: Candidates| {
            candidates.write(&path).unwrap();
            Candidates::read(&path).unwrap_err().to_string()
        };
        let text = refused(Candidates { scenes: vec![7], ..two() });
        assert!(text.contains("candidates.npz: there are 2 labels and 1 scene numbers; it must hold"), "{text}");
        assert!(refused(Candidates::default()).contains("0 labels"));
        let missing = Candidates::read(&folder.path().join("no.npz")).unwrap_err().to_string();
        assert!(missing.contains("no.npz"), "{missing}");
    }
}
