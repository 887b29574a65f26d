use std::fs;
use std::path::Path;

use ort::session::Session;
use ort::value::{Outlet, Tensor, TensorElementType};

use super::batch_session::ModelFile;
use super::{Backend, LoadError, LoadReason, Options, RuntimeError, run_error};
use crate::Entry;
use crate::gpd::{INPUT, OUTPUT};

/// Batch size, which bounds the memory: 5.5 MB of input for GPD.
const BATCH: usize = 32;

/// A loaded classifier of grasp candidates: of images, as GPD's, or of patches of a volume, as the evaluator.
pub struct Classifier {
    session: Session,
    /// Shape of an image.
    shape: &'static [usize],
    /// Name in error messages.
    name: String,
}

impl Classifier {
    /// Loads a file and checks that its input and output are those of a classifier of images of `shape`.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem.
    pub fn load(path: &Path, shape: &'static [usize], options: &Options) -> Result<Self, LoadError> {
        let load = || Self::open(path, &fs::read(path)?, shape, options);
        load().map_err(|reason| LoadError { path: path.to_owned(), reason })
    }

    /// Loads an entry of a store `count` times, once per thread.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem, including a file that changed since the store read it.
    pub fn load_several(
        entry: &Entry,
        shape: &'static [usize],
        options: &Options,
        count: usize,
    ) -> Result<Vec<Self>, LoadError> {
        let load = || {
            let bytes = entry.bytes()?;
            (0..count).map(|_| Self::open(&entry.path, &bytes, shape, options)).collect::<Result<_, LoadReason>>()
        };
        load().map_err(|reason| LoadError { path: entry.path.clone(), reason })
    }

    /// Loads the model and runs it once, so that buffers are allocated before the first request.
    fn open(path: &Path, bytes: &[u8], shape: &'static [usize], options: &Options) -> Result<Self, LoadReason> {
        let session = ModelFile::new(path, bytes, options).open(Backend::REFERENCE, None)?;
        check(session.inputs(), INPUT, shape)?;
        check(session.outputs(), OUTPUT, &[2])?;
        let mut classifier = Self { session, shape, name: path.display().to_string() };
        classifier.logits(vec![0.0; BATCH * shape.iter().product::<usize>()])?;
        Ok(classifier)
    }

    /// The score of each image: the logit of success minus the logit of failure. Above 0, success is more likely. An
    /// image has the values of the classifier's shape; 255 stands for 1.
    ///
    /// # Errors
    /// [`RuntimeError::Run`] if ONNX Runtime fails.
    pub fn score(&mut self, images: &[&[u8]]) -> Result<Vec<f32>, RuntimeError> {
        let mut scores = Vec::with_capacity(images.len());
        for batch in images.chunks(BATCH) {
            let pixels = batch.iter().copied().flatten().map(|&value| f32::from(value) / 255.0).collect();
            let logits = self.logits(pixels).map_err(|error| run_error(&self.name, &error))?;
            scores.extend(logits.chunks_exact(2).map(|pair| pair[1] - pair[0]));
        }
        Ok(scores)
    }

    /// The logits of concatenated images.
    fn logits(&mut self, pixels: Vec<f32>) -> ort::Result<Vec<f32>> {
        let images = pixels.len() / self.shape.iter().product::<usize>();
        let shape: Vec<usize> = [&[images], self.shape].concat();
        let outputs = self.session.run(ort::inputs![INPUT => Tensor::from_array((shape, pixels))?])?;
        Ok(outputs[OUTPUT].try_extract_tensor::<f32>()?.1.to_vec())
    }
}

/// Checks that `name` is f32 of shape `[batch, dims…]`.
fn check(outlets: &[Outlet], name: &str, dims: &[usize]) -> Result<(), LoadReason> {
    let wrong = |what: String| LoadReason::Classifier { what };
    if let [other] = outlets
        && other.name() != name
    {
        return Err(wrong(format!("found `{}` instead of `{name}`", other.name())));
    }
    let outlet = outlets.iter().find(|outlet| outlet.name() == name);
    let dtype = outlet.ok_or_else(|| wrong(format!("`{name}` is missing")))?.dtype();
    let fits = |shape: &[i64]| {
        shape.len() == dims.len() + 1
            && shape[0] < 0
            && shape[1..].iter().zip(dims).all(|(&dim, &size)| dim < 0 || dim == size as i64)
    };
    let is_float = dtype.tensor_type() == Some(TensorElementType::Float32);
    match dtype.tensor_shape() {
        Some(shape) if is_float && fits(shape) => Ok(()),
        _ => Err(wrong(format!("`{name}` is {dtype}"))),
    }
}
