use std::path::Path;

use grasp::{Maps, Volume};
use ort::session::Session;
use ort::value::{Outlet, TensorElementType};

use super::batch_session::{BatchSession, OutputTensors};
use super::model_file::ModelFile;
use super::{
    Backend, INPUT, LoadError, LoadReason, OUTPUTS, Options, Provider, RuntimeError, loading, reference_check,
    run_error,
};
use crate::{Entry, Metadata};

/// A loaded network with its buffers. Each session thread owns one, because ONNX Runtime does not guarantee that one
/// session can run on several threads at the same time.
pub struct Network {
    metadata: Metadata,
    backend: Backend,
    /// By batch size, smallest first.
    sessions: Vec<BatchSession>,
}

/// The output maps of a batch. They borrow the network's buffers, which the next run overwrites.
pub struct Output<'a> {
    outputs: &'a OutputTensors,
    batch: usize,
    voxels: usize,
}

impl Network {
    /// Loads a file. Checks that its inputs and outputs are those of a grasp network, and that its outputs on this
    /// backend match those of ONNX Runtime's CPU kernels in f32.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        loading::load(path, options, Ok, |model, backend| Self::open_checked(model, backend, options.max_batch))
    }

    /// Loads an entry of a store once per session. All copies use the same backend.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem, including a file that changed since the store read it.
    pub fn load_several(entry: &Entry, options: &Options) -> Result<Vec<Self>, LoadError> {
        let checked = |model: &ModelFile<'_>, backend| Self::open_checked(model, backend, options.max_batch);
        let others = |model: &ModelFile<'_>, backend| Self::open(model, backend, options.max_batch);
        loading::load_several(entry, options, Ok, checked, others)
    }

    /// Loads with one backend and compares its outputs with the reference, which is the unmodified file on the CPU
    /// kernels. If the backend is the reference, there is no comparison.
    fn open_checked(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
        let mut network = Self::open(model, backend, max_batch)?;
        let original = model.original();
        if backend.provider != Provider::Cpu || original.is_some() {
            let mut reference = Self::open(original.as_ref().unwrap_or(model), Backend::REFERENCE, 1)?;
            if let Some(what) = reference_check::difference(&mut network, max_batch, &mut reference)? {
                return Err(LoadReason::DiffersFromReference { backend, what });
            }
        }
        Ok(network)
    }

    fn open(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
        let sessions = BatchSession::all(model, backend, max_batch)?;
        let session = sessions[0].session();
        let resolution =
            check_signature(session.inputs(), session.outputs(), sessions[0].size().map(|size| size as i64))?;
        let metadata = read_metadata(session, Metadata::defaults(model.path, resolution))?;
        if let Some(resolution) = resolution.filter(|&resolution| resolution != metadata.resolution) {
            let what = format!("N is {} in the metadata and {resolution} in the input", metadata.resolution);
            return Err(LoadReason::Signature { what });
        }
        Ok(Self { metadata, backend, sessions })
    }

    /// The backend in use.
    #[must_use]
    pub fn backend(&self) -> Backend {
        self.backend
    }

    /// The metadata of the file.
    #[must_use]
    pub fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// Runs the network over a batch of volumes of its resolution.
    ///
    /// # Errors
    /// [`RuntimeError`] if the batch does not fit the network or ONNX Runtime fails.
    pub fn infer(&mut self, batch: &[&Volume]) -> Result<Output<'_>, RuntimeError> {
        self.fill(batch)?;
        self.run(batch.len())
    }

    /// Copies a batch into the input buffer.
    ///
    /// # Errors
    /// [`RuntimeError`] if the batch does not fit the network.
    pub fn fill(&mut self, batch: &[&Volume]) -> Result<(), RuntimeError> {
        if batch.is_empty() {
            return Err(RuntimeError::EmptyBatch);
        }
        let expected = self.metadata.resolution;
        for volume in batch {
            let got = volume.resolution();
            if got != expected {
                return Err(RuntimeError::Resolution { got, expected, model: self.metadata.name.clone() });
            }
        }
        let voxels = expected.pow(3);
        let Self { metadata, sessions, .. } = self;
        let failed = |error| run_error(&metadata.name, &error);
        let input = session_for(sessions, batch.len())?.input(batch.len(), expected).map_err(failed)?;
        for (values, volume) in input.chunks_exact_mut(voxels).zip(batch) {
            values.copy_from_slice(volume.values());
        }
        Ok(())
    }

    /// Runs the network on the content of the input buffer for this batch size, as left by [`fill`](Self::fill);
    /// initially zeros. This is inference without the copy, comparable to a bare `session.run`.
    ///
    /// # Errors
    /// [`RuntimeError`] if this batch size is not supported or ONNX Runtime fails.
    pub fn run(&mut self, batch: usize) -> Result<Output<'_>, RuntimeError> {
        let Self { metadata, sessions, .. } = self;
        let resolution = metadata.resolution;
        let outputs =
            session_for(sessions, batch)?.run(batch, resolution).map_err(|error| run_error(&metadata.name, &error))?;
        Ok(Output { outputs, batch, voxels: resolution.pow(3) })
    }
}

/// The session with the smallest batch size that fits a batch.
fn session_for(sessions: &mut [BatchSession], batch: usize) -> Result<&mut BatchSession, RuntimeError> {
    if batch == 0 {
        return Err(RuntimeError::EmptyBatch);
    }
    let largest = sessions.last().and_then(BatchSession::size).unwrap_or(usize::MAX);
    sessions.iter_mut().find(|session| session.fits(batch)).ok_or(RuntimeError::Batch { got: batch, largest })
}

impl Output<'_> {
    /// Number of volumes in the batch.
    #[must_use]
    pub fn len(&self) -> usize {
        self.batch
    }

    /// Always false: empty batches are rejected.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.batch == 0
    }

    /// The maps of one volume of the batch.
    ///
    /// # Panics
    /// If `index` is not below [`len`](Self::len).
    #[must_use]
    pub fn maps(&self, index: usize) -> Maps<'_> {
        let [quality, rotation, width] = [0, 1, 2].map(|output: usize| {
            let size = OUTPUTS[output].1 * self.voxels;
            &self.outputs[output].extract_tensor().1[index * size..][..size]
        });
        Maps { quality, rotation, width }
    }
}

/// Checks inputs and outputs. Returns the resolution if the shape of the input fixes it. The batch dimension must be
/// dynamic, or `fixed` if this code has fixed it.
fn check_signature(inputs: &[Outlet], outputs: &[Outlet], fixed: Option<i64>) -> Result<Option<usize>, LoadReason> {
    if let Some(extra) = inputs.iter().find(|input| input.name() != INPUT) {
        return Err(LoadReason::Signature { what: format!("unexpected input `{}`", extra.name()) });
    }
    let resolution = check_tensor(inputs, INPUT, 1, fixed)?;
    for (name, channels) in OUTPUTS {
        check_tensor(outputs, name, channels, fixed)?;
    }
    Ok(resolution)
}

fn check_tensor(
    outlets: &[Outlet],
    name: &str,
    channels: usize,
    fixed: Option<i64>,
) -> Result<Option<usize>, LoadReason> {
    let wrong = |what: String| Err(LoadReason::Signature { what });
    let outlet = outlets.iter().find(|outlet| outlet.name() == name);
    let Some(dtype) = outlet.map(Outlet::dtype) else { return wrong(format!("`{name}` is missing")) };
    let fits = |dim: i64, size: usize| dim < 0 || dim == size as i64;
    match dtype.tensor_shape().map(|shape| &**shape) {
        Some(&[batch, c, x, y, z])
            if dtype.tensor_type() == Some(TensorElementType::Float32)
                && (batch < 0 || Some(batch) == fixed)
                && fits(c, channels)
                && [y, z].iter().all(|&edge| edge < 0 || x < 0 || edge == x) =>
        {
            Ok([x, y, z].into_iter().find_map(|edge| usize::try_from(edge).ok()))
        }
        Some(&[batch, _, _, _, _]) if batch >= 0 && Some(batch) != fixed => {
            wrong(format!("`{name}` has a fixed batch size of {batch}, export it with a dynamic first axis"))
        }
        _ => wrong(format!("`{name}` is {dtype}")),
    }
}

fn read_metadata(session: &Session, defaults: Metadata) -> Result<Metadata, LoadReason> {
    let properties = session.metadata()?;
    let keys = properties.custom_keys()?;
    let pairs = keys.into_iter().filter_map(|key| properties.custom(&key).map(|value| (key, value)));
    Ok(Metadata::from_properties(pairs, defaults)?)
}
