use std::path::Path;

use grasp::Patch;
use grasp::gpd::Image;
use ort::session::Session;
use ort::value::{Outlet, Tensor, TensorElementType};
use prost::Message;
use rayon::prelude::*;

use super::model_file::ModelFile;
use super::{Backend, LoadError, LoadReason, Options, Provider, RuntimeError, loading, run_error};
use crate::gpd::{INPUT, OUTPUT};
use crate::onnx::ModelProto;
use crate::{Calibration, Entry, coarse_evaluator_of, without_coarse_evaluator};

/// Largest allowed difference from the reference of the predicted probability of success, on average and at most.
const MEAN_DIFFERENCE: f32 = 0.02;
const LARGEST_DIFFERENCE: f32 = 0.2;

/// What a classifier scores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClassifierKind {
    /// Images of grasp candidates: GPD's classifier.
    Gpd,
    /// Patches of a volume: an evaluator.
    Evaluator,
    /// Coarse patches: the coarse evaluator in the file of an evaluator.
    CoarseEvaluator,
}

impl ClassifierKind {
    /// Shape of an image.
    #[must_use]
    pub fn shape(self) -> &'static [usize] {
        match self {
            Self::Gpd => &Image::SHAPE,
            Self::Evaluator => &Patch::SHAPE,
            Self::CoarseEvaluator => &Patch::COARSE_SHAPE,
        }
    }

    /// Batch size, which bounds the memory. A larger one is not faster per patch of the evaluator, and pads a few patches
    /// more.
    fn batch(self) -> usize {
        match self {
            Self::Gpd | Self::Evaluator => 16,
            Self::CoarseEvaluator => 32,
        }
    }

    /// The part of a file with the classifier.
    fn of_file(self, bytes: Vec<u8>) -> Result<Vec<u8>, LoadReason> {
        if self == Self::Gpd {
            return Ok(bytes);
        }
        // ONNX Runtime reports a better error of an invalid file.
        let Ok(model) = ModelProto::from_bytes(&bytes) else { return Ok(bytes) };
        let coarse = coarse_evaluator_of(&model);
        Ok(match (self, coarse) {
            (Self::CoarseEvaluator, coarse) => coarse.ok_or(LoadReason::NoCoarseEvaluator)?.encode_to_vec(),
            (_, Some(_)) => without_coarse_evaluator(&model).encode_to_vec(),
            (_, None) => bytes,
        })
    }
}

/// A loaded classifier of grasp candidates.
pub struct Classifier {
    session: Session,
    backend: Backend,
    kind: ClassifierKind,
    /// Name in error messages.
    name: String,
    calibration: Calibration,
}

impl Classifier {
    /// Loads a file. Checks that its input and output are those of a classifier of this kind, and that its scores on this
    /// backend match those of ONNX Runtime's CPU kernels in f32.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem: [`LoadReason::NoCoarseEvaluator`] if there is none.
    pub fn load(path: &Path, kind: ClassifierKind, options: &Options) -> Result<Self, LoadError> {
        let checked = |model: &ModelFile<'_>, backend| Self::open_checked(model, backend, kind);
        loading::load(path, &Self::options(options), |bytes| kind.of_file(bytes), checked)
    }

    /// Loads an entry of a store once per session. All copies use the same backend.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem, including a file that changed since the store read it.
    pub fn load_several(entry: &Entry, kind: ClassifierKind, options: &Options) -> Result<Vec<Self>, LoadError> {
        let checked = |model: &ModelFile<'_>, backend| Self::open_checked(model, backend, kind);
        let others = |model: &ModelFile<'_>, backend| Self::open(model, backend, kind);
        loading::load_several(entry, &Self::options(options), |bytes| kind.of_file(bytes), checked, others)
    }

    /// Without CUDA graphs, because batches have any size.
    fn options(options: &Options) -> Options {
        Options { cuda_graphs: false, ..*options }
    }

    /// Loads with one backend and compares its scores with the reference, ONNX Runtime's CPU kernels.
    fn open_checked(model: &ModelFile, backend: Backend, kind: ClassifierKind) -> Result<Self, LoadReason> {
        let mut classifier = Self::open(model, backend, kind)?;
        if backend.provider != Provider::Cpu {
            let mut reference = Self::open(model, Backend::REFERENCE, kind)?;
            let [got, expected] =
                [&mut classifier, &mut reference].map(|classifier| classifier.score(kind.batch() + 1, write_sample));
            if let Some(what) = difference(&got?, &expected?) {
                return Err(LoadReason::DiffersFromReference { backend, what });
            }
        }
        Ok(classifier)
    }

    /// Loads the model and runs it once, so that buffers are allocated before the first request.
    fn open(model: &ModelFile, backend: Backend, kind: ClassifierKind) -> Result<Self, LoadReason> {
        let session = model.open(backend, is_fixed(backend).then_some(kind.batch()))?;
        let (shape, batch) = (kind.shape(), kind.batch());
        let wrong = |what| LoadReason::Classifier { what, shape };
        check(session.inputs(), INPUT, batch, &shape.iter().map(|&size| size..=size).collect::<Vec<_>>())
            .map_err(wrong)?;
        check(session.outputs(), OUTPUT, batch, &[2..=usize::MAX]).map_err(wrong)?;
        let calibration = model.calibration.clone()?;
        let name = model.path.display().to_string();
        let mut classifier = Self { session, backend, kind, name, calibration };
        classifier.run(batch, vec![0.0; batch * classifier.size()])?;
        Ok(classifier)
    }

    /// Values of an image.
    fn size(&self) -> usize {
        self.kind.shape().iter().product()
    }

    /// The backend in use.
    #[must_use]
    pub fn backend(&self) -> Backend {
        self.backend
    }

    /// The scores of `count` images: the calibrated log-odds of success. Above 0, success is more likely. `write`
    /// writes the image of an index, whose values have the classifier's shape and are in [0, 1]. It is called on
    /// several threads.
    ///
    /// The first class is failure, all others are successes.
    ///
    /// # Errors
    /// [`RuntimeError::Run`] if ONNX Runtime fails.
    pub fn score(&mut self, count: usize, write: impl Fn(usize, &mut [f32]) + Sync) -> Result<Vec<f32>, RuntimeError> {
        let mut scores = Vec::with_capacity(count);
        while scores.len() < count {
            let first = scores.len();
            let images = self.kind.batch().min(count - first);
            let batch = if is_fixed(self.backend) { self.kind.batch() } else { images };
            let mut pixels = vec![0.0; batch * self.size()];
            let parts = pixels[..images * self.size()].par_chunks_exact_mut(self.size()).enumerate();
            parts.for_each(|(index, image)| write(first + index, image));
            let logits = self.run(batch, pixels).map_err(|error| run_error(&self.name, &error))?;
            let logits = logits.chunks_exact(logits.len() / batch).take(images);
            scores.extend(logits.map(|logits| self.calibration.apply(log_odds(logits))));
            if scores.iter().any(|score| score.is_nan()) {
                return Err(RuntimeError::Nan { model: self.name.clone() });
            }
        }
        Ok(scores)
    }

    /// The logits of a batch of concatenated images.
    fn run(&mut self, batch: usize, pixels: Vec<f32>) -> ort::Result<Vec<f32>> {
        let shape: Vec<usize> = [&[batch], self.kind.shape()].concat();
        let outputs = self.session.run(ort::inputs![INPUT => Tensor::from_array((shape, pixels))?])?;
        Ok(outputs[OUTPUT].try_extract_tensor::<f32>()?.1.to_vec())
    }
}

/// Whether a provider is given the batch size when the model is loaded, as for networks.
fn is_fixed(backend: Backend) -> bool {
    matches!(backend.provider, Provider::OpenVino | Provider::TensorRt)
}

/// Log-odds of the classes after the first against the first.
fn log_odds(logits: &[f32]) -> f32 {
    let largest = logits[1..].iter().copied().fold(f32::NEG_INFINITY, f32::max);
    largest + logits[1..].iter().map(|logit| (logit - largest).exp()).sum::<f32>().ln() - logits[0]
}

/// Writes the test image of an index: a smooth pattern that differs between images.
fn write_sample(index: usize, image: &mut [f32]) {
    let step = 0.01 + 0.003 * index as f32;
    for (at, value) in image.iter_mut().enumerate() {
        *value = 0.5 + 0.5 * (at as f32 * step).sin();
    }
}

/// Describes the difference between the probabilities, if it exceeds the limits.
fn difference(got: &[f32], expected: &[f32]) -> Option<String> {
    let probability = |score: f32| 1.0 / (1.0 + (-score).exp());
    let differences = || got.iter().zip(expected).map(|(&a, &b)| (probability(a) - probability(b)).abs());
    let mean = differences().sum::<f32>() / got.len().max(1) as f32;
    let largest = differences().fold(0.0, f32::max);
    // With NaN both comparisons are false.
    let agrees = mean <= MEAN_DIFFERENCE && largest <= LARGEST_DIFFERENCE;
    (!agrees).then(|| {
        format!(
            "the probability of success differs by {mean:.4} on average (limit {MEAN_DIFFERENCE}) and by at most \
             {largest:.4} (limit {LARGEST_DIFFERENCE})"
        )
    })
}

/// Checks that `name` is f32 of shape `[batch, dims…]`. The error describes the difference.
fn check(outlets: &[Outlet], name: &str, batch: usize, dims: &[std::ops::RangeInclusive<usize>]) -> Result<(), String> {
    if let [other] = outlets
        && other.name() != name
    {
        return Err(format!("found `{}` instead of `{name}`", other.name()));
    }
    let outlet = outlets.iter().find(|outlet| outlet.name() == name);
    let dtype = outlet.ok_or_else(|| format!("`{name}` is missing"))?.dtype();
    // The batch is a free dimension, or fixed by the provider.
    let fits = |shape: &[i64]| {
        shape.len() == dims.len() + 1
            && (shape[0] < 0 || shape[0] == batch as i64)
            && shape[1..].iter().zip(dims).all(|(&dim, sizes)| dim < 0 || sizes.contains(&(dim as usize)))
    };
    let is_float = dtype.tensor_type() == Some(TensorElementType::Float32);
    match dtype.tensor_shape() {
        Some(shape) if is_float && fits(shape) => Ok(()),
        _ => Err(format!("`{name}` is {dtype}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_classes_but_the_first_are_successes() {
        assert!((log_odds(&[1.0, 3.5]) - 2.5).abs() < 1e-6);
        let probability = 1.0 / (1.0 + (-log_odds(&[0.0, 1.0, 2.0])).exp());
        let [e, e2] = [1.0_f32, 2.0].map(f32::exp);
        assert!((probability - (e + e2) / (1.0 + e + e2)).abs() < 1e-6);
        assert!(log_odds(&[0.0, 500.0, 400.0]).is_finite());
    }
}
