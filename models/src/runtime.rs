//! Binding to ONNX Runtime. No other module of the workspace calls it.

mod backend;
mod batch_session;
mod classifier;
mod reference_check;

use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::fs;
use std::iter;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use grasp::{Maps, Volume};
use ort::LoadDynamicError;
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::value::{Outlet, TensorElementType};
use thiserror::Error;
use tracing::warn;

use crate::{Entry, Metadata, MetadataError};

pub use backend::{Backend, BackendError, Choice, NameError, Precision, Provider};
pub use batch_session::batch_sizes;
pub use classifier::Classifier;

use backend::AvailableBackends;
use batch_session::{BatchSession, ModelFile, OutputTensors};

/// The input of every network: `[batch, 1, N, N, N]`.
pub const INPUT: &str = "tsdf";

/// The outputs of every network with their channels: `[batch, channels, N, N, N]`.
pub const OUTPUTS: [(&str, usize); 3] = [("quality", 1), ("rotation", 4), ("width", 1)];

/// The loaded ONNX Runtime.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RuntimeInfo {
    /// Path of the shared library, as configured.
    pub library: PathBuf,
    /// Version, such as `1.24.1`.
    pub version: String,
}

/// Why ONNX Runtime cannot be loaded or failed.
#[derive(Clone, Debug, Error)]
pub enum RuntimeError {
    /// The shared library cannot be loaded or is too old.
    #[error(
        "ONNX Runtime (at least 1.{}): {reason}; download it with `python3 deploy/native.py onnxruntime` and \
         set ORT_DYLIB_PATH to the printed path",
        ort::MINOR_VERSION
    )]
    Library {
        /// What is wrong.
        reason: String,
    },
    /// The batch has no volume.
    #[error("the batch is empty")]
    EmptyBatch,
    /// The batch is larger than `max_batch` of the options.
    #[error("the batch has {got} volumes, the network was loaded for at most {largest}")]
    Batch {
        /// Volumes in the batch.
        got: usize,
        /// Largest batch.
        largest: usize,
    },
    /// A volume has another resolution than the network reads.
    #[error("resolution is {got}, the model `{model}` needs {expected}")]
    Resolution {
        /// Resolution of the volume.
        got: usize,
        /// Resolution of the network.
        expected: usize,
        /// Name of the model.
        model: String,
    },
    /// The scores of a classifier are not numbers.
    #[error("the model `{model}` computes NaN; use another --precision or --provider, or train it again")]
    Nan {
        /// Name of the model.
        model: String,
    },
    /// ONNX Runtime failed.
    #[error("the model `{model}`: {reason}")]
    Run {
        /// Name of the model.
        model: String,
        /// The error of ONNX Runtime.
        reason: String,
    },
}

/// Why a model file cannot be loaded.
#[derive(Debug, Error)]
#[error("{}: {reason}", path.display())]
pub struct LoadError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with the file.
    pub reason: LoadReason,
}

/// What is wrong with a model file.
#[derive(Debug, Error)]
pub enum LoadReason {
    /// ONNX Runtime cannot be loaded or failed.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// The file cannot be read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The file has changed since the folder was read.
    #[error("SHA-256 is {found}, was {expected} when the folder was read; read the folder again")]
    Changed {
        /// SHA-256 when the folder was read.
        expected: String,
        /// Current SHA-256.
        found: String,
    },
    /// ONNX Runtime rejects the model.
    #[error("ONNX Runtime rejects the model: {0}; if the file is truncated, download or export it again")]
    Model(String),
    /// The weights are in another file.
    #[error(
        "the weights are in a second file, `{0}`; save both as one file with `onnx.save_model(onnx.load(path), path, \
         save_as_external_data=False)`"
    )]
    Split(String),
    /// The requested backend cannot run it.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The requested backend computes other outputs than the reference.
    #[error("with {backend} the outputs differ from the reference: {what}; use another provider or precision")]
    DiffersFromReference {
        /// The backend.
        backend: Backend,
        /// The difference.
        what: String,
    },
    /// The metadata is invalid.
    #[error(transparent)]
    Metadata(#[from] MetadataError),
    /// The inputs or outputs are not those of a grasp network.
    #[error(
        "{what}; a grasp network has the input `tsdf`, f32 [batch, 1, N, N, N], and the outputs `quality`, `rotation` \
         and `width`, f32 [batch, 1, 4 and 1, N, N, N]"
    )]
    Signature {
        /// The difference.
        what: String,
    },
    /// The inputs or outputs are not those of a classifier of grasp candidates.
    #[error(
        "{what}; a classifier has the input `images`, f32 [batch, {}], and the output `scores`, f32 [batch, classes]; \
         train one with `grasp-train classify`",
        shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
    )]
    Classifier {
        /// The difference.
        what: String,
        /// Shape of an image.
        shape: &'static [usize],
    },
}

impl From<ort::Error> for LoadReason {
    fn from(error: ort::Error) -> Self {
        Self::Model(error.to_string())
    }
}

/// Loads ONNX Runtime once: the library that `ORT_DYLIB_PATH` names, or else the system's library.
///
/// Disables telemetry, which official builds enable. ONNX Runtime logs to `tracing`.
///
/// # Errors
/// [`RuntimeError::Library`] describes the problem and how to install the library.
pub fn init() -> Result<&'static RuntimeInfo, RuntimeError> {
    Ok(&runtime()?.info)
}

struct Runtime {
    info: RuntimeInfo,
    /// Never dropped, because threads of ONNX Runtime may outlive `main`.
    environment: Environment,
}

fn runtime() -> Result<&'static Runtime, RuntimeError> {
    static RUNTIME: OnceLock<Result<Runtime, RuntimeError>> = OnceLock::new();
    RUNTIME.get_or_init(load_library).as_ref().map_err(Clone::clone)
}

fn load_library() -> Result<Runtime, RuntimeError> {
    let library = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty());
    let library = library.map_or_else(|| PathBuf::from(format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}")), PathBuf::from);
    let library_error = |error: &dyn std::fmt::Display| RuntimeError::Library { reason: error.to_string() };
    let builder = ort::init_from(&library).map_err(|error| library_error(&with_reason(&error)))?;
    let environment =
        builder.with_name("graspd").with_telemetry(false).build().map_err(|error| library_error(&error))?;
    environment.set_log_level(LogLevel::Warning);
    let info = RuntimeInfo { version: version(ort::info(), &library), library };
    Ok(Runtime { info, environment })
}

/// The error of a library that could not be loaded, with the words of the dynamic linker, which ort leaves out.
fn with_reason(error: &LoadDynamicError) -> String {
    let reason = match error {
        LoadDynamicError::Dlopen { error, .. } => std::error::Error::source(error),
        _ => None,
    };
    reason.map_or_else(|| error.to_string(), |reason| format!("{error}: {reason}"))
}

/// The version, parsed from the release branch in the build info. Other builds are identified by the file name of the
/// library.
fn version(build: &str, library: &Path) -> String {
    let branch = build.split("git-branch=rel-").nth(1).and_then(|rest| rest.split(',').next());
    branch.map_or_else(|| library.file_name().unwrap_or_default().to_string_lossy().into_owned(), str::to_owned)
}

/// Options for running a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Number of threads of one inference.
    pub threads: usize,
    /// Execution provider; `None` selects the fastest available one whose outputs match the reference.
    pub provider: Option<Provider>,
    /// Precision; `None` selects the fastest.
    pub precision: Option<Precision>,
    /// Largest batch. Some providers prepare for each batch size.
    pub max_batch: usize,
}

impl Default for Options {
    /// One thread of ONNX Runtime's CPU kernels, one volume at a time. The results are the same on every machine.
    fn default() -> Self {
        Self { threads: 1, provider: Some(Provider::Cpu), precision: None, max_batch: 1 }
    }
}

impl Options {
    /// The fastest available provider and precision.
    #[must_use]
    pub fn auto(threads: usize) -> Self {
        Self { threads, provider: None, ..Self::default() }
    }
}

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
        Self::try_load(path, options).map_err(|reason| LoadError { path: path.to_owned(), reason })
    }

    /// Loads an entry of a store `count` times, once per thread. All copies use the same backend.
    ///
    /// # Errors
    /// [`LoadError`] names the file and the problem, including a file that changed since the store read it.
    pub fn load_several(entry: &Entry, options: &Options, count: usize) -> Result<Vec<Self>, LoadError> {
        let load = || {
            runtime()?;
            let bytes = entry.bytes()?;
            let model = ModelFile::new(&entry.path, &bytes, options);
            let first = Self::load_fastest(&model, options)?;
            let backend = first.backend();
            let others = (1..count).map(|_| Self::load_with(&model, backend, options.max_batch));
            iter::once(Ok(first)).chain(others).take(count).collect::<Result<_, LoadReason>>()
        };
        load().map_err(|reason| LoadError { path: entry.path.clone(), reason })
    }

    fn try_load(path: &Path, options: &Options) -> Result<Self, LoadReason> {
        // Fails early if ONNX Runtime cannot be loaded.
        runtime()?;
        Self::load_fastest(&ModelFile::new(path, &fs::read(path)?, options), options)
    }

    /// Loads with the first allowed backend whose outputs match the reference.
    fn load_fastest(model: &ModelFile, options: &Options) -> Result<Self, LoadReason> {
        if let Some(file) = &model.external_weights {
            return Err(LoadReason::Split(file.clone()));
        }
        let backends = AvailableBackends::here().backends(options.provider, options.precision, model.is_int8)?;
        let (&last, others) = backends.split_last().ok_or(RuntimeError::EmptyBatch)?;
        for &backend in others {
            match Self::load_checked(model, backend, options.max_batch) {
                Ok(network) => return Ok(network),
                Err(error) => {
                    warn!(model = %model.path.display(), %backend, %error, "backend rejected, trying the next one")
                }
            }
        }
        Self::load_checked(model, last, options.max_batch)
    }

    /// Loads with one backend and compares its outputs with the reference, which is the unmodified file on the CPU
    /// kernels. If the backend is the reference, there is no comparison.
    fn load_checked(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
        let mut network = Self::load_with(model, backend, max_batch)?;
        let original = model.original();
        if backend.provider != Provider::Cpu || original.is_some() {
            let mut reference = Self::load_with(original.as_ref().unwrap_or(model), Backend::REFERENCE, 1)?;
            if let Some(what) = reference_check::difference(&mut network, max_batch, &mut reference)? {
                return Err(LoadReason::DiffersFromReference { backend, what });
            }
        }
        Ok(network)
    }

    fn load_with(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
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

fn run_error(model: &str, error: &ort::Error) -> RuntimeError {
    RuntimeError::Run { model: model.to_owned(), reason: error.to_string() }
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
