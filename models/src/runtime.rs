//! ONNX Runtime: the only module that touches it.

mod agreement;
mod backend;
mod classifier;
mod plan;

use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::fs;
use std::iter;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use grasp::{Maps, Volume};
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::value::{Outlet, TensorElementType};
use thiserror::Error;
use tracing::warn;

use crate::{Entry, Metadata, MetadataError};

pub use backend::{Backend, BackendError, Choice, NameError, Precision, Provider};
pub use classifier::Classifier;
pub use plan::batch_sizes;

use backend::Machine;
use plan::{Model, Outputs, Plan};

/// The input every network has: `[batch, 1, N, N, N]`.
pub const INPUT: &str = "tsdf";

/// The outputs every network has, with their channels: `[batch, channels, N, N, N]`.
pub const OUTPUTS: [(&str, usize); 3] = [("quality", 1), ("rotation", 4), ("width", 1)];

/// What was loaded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RuntimeInfo {
    /// The shared library, as it was asked for.
    pub library: PathBuf,
    /// Its version, such as `1.24.1`.
    pub version: String,
}

/// Why ONNX Runtime is not there or did not compute.
#[derive(Clone, Debug, Error)]
pub enum RuntimeError {
    /// The shared library could not be loaded, or is too old.
    #[error(
        "ONNX Runtime (at least 1.{}): {reason}; get it with `python3 deploy/native.py onnxruntime` and set \
         ORT_DYLIB_PATH to the path that prints",
        ort::MINOR_VERSION
    )]
    Library {
        /// What is wrong.
        reason: String,
    },
    /// A batch without a volume.
    #[error("the batch is empty")]
    EmptyBatch,
    /// A batch with more volumes than was said when the network was loaded.
    #[error("a batch of {got}, the network was loaded for batches of at most {largest}")]
    Batch {
        /// Volumes in the batch.
        got: usize,
        /// The most that are taken.
        largest: usize,
    },
    /// A volume is of another size than the network reads.
    #[error("resolution is {got}, the model `{model}` reads {expected}")]
    Resolution {
        /// The volume's.
        got: usize,
        /// The network's.
        expected: usize,
        /// The network.
        model: String,
    },
    /// ONNX Runtime failed.
    #[error("the model `{model}`: {reason}")]
    Run {
        /// The network.
        model: String,
        /// What it said.
        reason: String,
    },
}

/// Why a file is not a network that can be served.
#[derive(Debug, Error)]
#[error("{}: {reason}", path.display())]
pub struct LoadError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub reason: LoadReason,
}

/// What is wrong with a file.
#[derive(Debug, Error)]
pub enum LoadReason {
    /// ONNX Runtime is not there.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// The file system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Another file took its place since the folder was read.
    #[error("has the SHA-256 {found} now, it had {expected} when the folder was read; load it anew")]
    Changed {
        /// When the folder was read.
        expected: String,
        /// Now.
        found: String,
    },
    /// ONNX Runtime refuses it.
    #[error("ONNX Runtime refuses it: {0}; if the file was cut short, fetch or export it again")]
    Model(String),
    /// Its weights are elsewhere.
    #[error(
        "keeps its weights in a second file, `{0}`; save both as one, with `onnx.save_model(onnx.load(path), path, \
         save_as_external_data=False)`"
    )]
    Split(String),
    /// It cannot be run as was asked.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The way it was asked to be run gives other answers.
    #[error("with {backend} it gives other answers: {what}")]
    Disagrees {
        /// Which way.
        backend: Backend,
        /// What differs.
        what: String,
    },
    /// Its metadata cannot be.
    #[error(transparent)]
    Metadata(#[from] MetadataError),
    /// Its inputs or outputs are not those of a grasp network.
    #[error(
        "{what}; a grasp network reads `tsdf` f32 [batch, 1, N, N, N] and gives `quality`, `rotation` and `width`, \
         f32 [batch, 1, 4 and 1, N, N, N]"
    )]
    Signature {
        /// What is different.
        what: String,
    },
    /// Its inputs or outputs are not those of a classifier of grasp candidates.
    #[error(
        "{what}; a classifier reads `images` f32 [batch, {c}, {n}, {n}] and gives `scores` f32 [batch, 2], as \
         `grasp-train classify` writes it",
        c = grasp::gpd::CHANNELS,
        n = grasp::gpd::IMAGE_SIZE
    )]
    Classifier {
        /// What is different.
        what: String,
    },
}

impl From<ort::Error> for LoadReason {
    fn from(error: ort::Error) -> Self {
        Self::Model(error.to_string())
    }
}

/// Loads ONNX Runtime, once: the library that `ORT_DYLIB_PATH` names, or else the system's.
///
/// Telemetry, which official builds switch on, is switched off; its log goes to `tracing`.
///
/// # Errors
/// [`RuntimeError::Library`] says what is wrong with the library and how to get one.
pub fn init() -> Result<&'static RuntimeInfo, RuntimeError> {
    Ok(&runtime()?.info)
}

struct Runtime {
    info: RuntimeInfo,
    /// Never dropped: threads of ONNX Runtime may outlive `main`.
    environment: Environment,
}

fn runtime() -> Result<&'static Runtime, RuntimeError> {
    static RUNTIME: OnceLock<Result<Runtime, RuntimeError>> = OnceLock::new();
    RUNTIME.get_or_init(load_library).as_ref().map_err(Clone::clone)
}

fn load_library() -> Result<Runtime, RuntimeError> {
    let library = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty());
    let library = library.map_or_else(|| PathBuf::from(format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}")), PathBuf::from);
    let refuse = |error: &dyn std::fmt::Display| RuntimeError::Library { reason: error.to_string() };
    let builder = ort::init_from(&library).map_err(|error| refuse(&error))?;
    let environment = builder.with_name("graspd").with_telemetry(false).build().map_err(|error| refuse(&error))?;
    environment.set_log_level(LogLevel::Warning);
    let info = RuntimeInfo { version: version(ort::info(), &library), library };
    Ok(Runtime { info, environment })
}

/// The version, from the branch it was built from; a build from elsewhere is known by its file name alone.
fn version(build: &str, library: &Path) -> String {
    let branch = build.split("git-branch=rel-").nth(1).and_then(|rest| rest.split(',').next());
    branch.map_or_else(|| library.file_name().unwrap_or_default().to_string_lossy().into_owned(), str::to_owned)
}

/// How a network is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// Threads one inference is spread over.
    pub threads: usize,
    /// By what; `None` takes the fastest that this machine and this library have, and that gives the network's answers.
    pub provider: Option<Provider>,
    /// In which numbers; `None` takes the fastest.
    pub precision: Option<Precision>,
    /// The largest batch that it will be asked about. Some providers need to know.
    pub max_batch: usize,
}

impl Default for Options {
    /// One thread of ONNX Runtime's own kernels, one volume at a time: the same numbers everywhere.
    fn default() -> Self {
        Self { threads: 1, provider: Some(Provider::Cpu), precision: None, max_batch: 1 }
    }
}

impl Options {
    /// The fastest there is.
    #[must_use]
    pub fn auto(threads: usize) -> Self {
        Self { threads, provider: None, ..Self::default() }
    }
}

/// A network ready to run, with its buffers. A server thread owns one each: ONNX Runtime does not promise that one
/// session can be run from several threads at a time.
pub struct Network {
    metadata: Metadata,
    backend: Backend,
    /// The smallest batch first.
    plans: Vec<Plan>,
}

/// The maps of a batch, in the network's buffers until it runs again.
pub struct Output<'a> {
    outputs: &'a Outputs,
    batch: usize,
    voxels: usize,
}

impl Network {
    /// Loads a file, and checks that its inputs and outputs are those of a grasp network, and that the way it is run
    /// gives the answers that ONNX Runtime's own kernels give in f32.
    ///
    /// # Errors
    /// [`LoadError`] names the file and what is wrong with it.
    pub fn load(path: &Path, options: &Options) -> Result<Self, LoadError> {
        Self::try_load(path, options).map_err(|reason| LoadError { path: path.to_owned(), reason })
    }

    /// Loads an entry of a store several times, for as many threads that run it at the same time. What runs the first
    /// runs the others.
    ///
    /// # Errors
    /// [`LoadError`] names the file and what is wrong with it, if it is not the one that the store read, too.
    pub fn load_several(entry: &Entry, options: &Options, count: usize) -> Result<Vec<Self>, LoadError> {
        let load = || {
            runtime()?;
            let bytes = entry.bytes()?;
            let model = Model::new(&entry.path, &bytes, options);
            let first = Self::choose(&model, options)?;
            let backend = first.backend();
            let others = (1..count).map(|_| Self::with(&model, backend, options.max_batch));
            iter::once(Ok(first)).chain(others).take(count).collect::<Result<_, LoadReason>>()
        };
        load().map_err(|reason| LoadError { path: entry.path.clone(), reason })
    }

    fn try_load(path: &Path, options: &Options) -> Result<Self, LoadReason> {
        // Before anything is asked of it.
        runtime()?;
        Self::choose(&Model::new(path, &fs::read(path)?, options), options)
    }

    /// The first way to run it, of those that may, that gives its answers.
    fn choose(model: &Model, options: &Options) -> Result<Self, LoadReason> {
        if let Some(file) = &model.weights_elsewhere {
            return Err(LoadReason::Split(file.clone()));
        }
        let backends = Machine::here().backends(options.provider, options.precision, model.is_int8)?;
        let (&last, others) = backends.split_last().ok_or(RuntimeError::EmptyBatch)?;
        for &backend in others {
            match Self::checked(model, backend, options.max_batch) {
                Ok(network) => return Ok(network),
                Err(error) => warn!(model = %model.path.display(), %backend, %error, "passed over"),
            }
        }
        Self::checked(model, last, options.max_batch)
    }

    /// Compared with the file as it is, run by ONNX Runtime's own kernels, unless this is just that.
    fn checked(model: &Model, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
        let mut network = Self::with(model, backend, max_batch)?;
        let original = model.original();
        if backend.provider != Provider::Cpu || original.is_some() {
            let mut reference = Self::with(original.as_ref().unwrap_or(model), Backend::REFERENCE, 1)?;
            if let Some(what) = agreement::difference(&mut network, max_batch, &mut reference)? {
                return Err(LoadReason::Disagrees { backend, what });
            }
        }
        Ok(network)
    }

    fn with(model: &Model, backend: Backend, max_batch: usize) -> Result<Self, LoadReason> {
        let plans = Plan::all(model, backend, max_batch)?;
        let session = plans[0].session();
        let resolution = check_signature(session.inputs(), session.outputs(), plans[0].size().map(|size| size as i64))?;
        let metadata = read_metadata(session, Metadata::defaults(model.path, resolution))?;
        if let Some(resolution) = resolution.filter(|&resolution| resolution != metadata.resolution) {
            let what = format!("its metadata says N = {}, its input has N = {resolution}", metadata.resolution);
            return Err(LoadReason::Signature { what });
        }
        Ok(Self { metadata, backend, plans })
    }

    /// What runs it.
    #[must_use]
    pub fn backend(&self) -> Backend {
        self.backend
    }

    /// What the file says of itself.
    #[must_use]
    pub fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// Runs the network over a batch of volumes of its resolution.
    ///
    /// # Errors
    /// [`RuntimeError`] when the batch does not fit the network, or ONNX Runtime fails.
    pub fn infer(&mut self, batch: &[&Volume]) -> Result<Output<'_>, RuntimeError> {
        self.fill(batch)?;
        self.run(batch.len())
    }

    /// Copies a batch to where ONNX Runtime reads it.
    ///
    /// # Errors
    /// [`RuntimeError`] when the batch does not fit the network.
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
        let Self { metadata, plans, .. } = self;
        let refused = |error| refusal(&metadata.name, &error);
        let input = plan(plans, batch.len())?.input(batch.len(), expected).map_err(refused)?;
        for (values, volume) in input.chunks_exact_mut(voxels).zip(batch) {
            values.copy_from_slice(volume.values());
        }
        Ok(())
    }

    /// Runs the network over what [`fill`](Self::fill) last left for this batch size, zeros at first: inference
    /// without the copy, which is what a bare `session.run` is measured by.
    ///
    /// # Errors
    /// [`RuntimeError`] when no batch of this size can be run, or ONNX Runtime fails.
    pub fn run(&mut self, batch: usize) -> Result<Output<'_>, RuntimeError> {
        let Self { metadata, plans, .. } = self;
        let resolution = metadata.resolution;
        let outputs = plan(plans, batch)?.run(batch, resolution).map_err(|error| refusal(&metadata.name, &error))?;
        Ok(Output { outputs, batch, voxels: resolution.pow(3) })
    }
}

/// The first that takes a batch of this size.
fn plan(plans: &mut [Plan], batch: usize) -> Result<&mut Plan, RuntimeError> {
    if batch == 0 {
        return Err(RuntimeError::EmptyBatch);
    }
    let largest = plans.last().and_then(Plan::size).unwrap_or(usize::MAX);
    plans.iter_mut().find(|plan| plan.takes(batch)).ok_or(RuntimeError::Batch { got: batch, largest })
}

impl Output<'_> {
    /// How many volumes the batch had.
    #[must_use]
    pub fn len(&self) -> usize {
        self.batch
    }

    /// Never: an empty batch is refused.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.batch == 0
    }

    /// The maps of one volume of the batch.
    ///
    /// # Panics
    /// When `index` is not below [`len`](Self::len).
    #[must_use]
    pub fn maps(&self, index: usize) -> Maps<'_> {
        let [quality, rotation, width] = [0, 1, 2].map(|output: usize| {
            let size = OUTPUTS[output].1 * self.voxels;
            &self.outputs[output].extract_tensor().1[index * size..][..size]
        });
        Maps { quality, rotation, width }
    }
}

fn refusal(model: &str, error: &ort::Error) -> RuntimeError {
    RuntimeError::Run { model: model.to_owned(), reason: error.to_string() }
}

/// The resolution, if the input's shape fixes it. The batch must be free, but for the size that it was fixed to here.
fn check_signature(inputs: &[Outlet], outputs: &[Outlet], fixed: Option<i64>) -> Result<Option<usize>, LoadReason> {
    if let Some(extra) = inputs.iter().find(|input| input.name() != INPUT) {
        return Err(LoadReason::Signature { what: format!("it has an input `{}`", extra.name()) });
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
    let Some(dtype) = outlet.map(Outlet::dtype) else { return wrong(format!("it has no `{name}`")) };
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
            wrong(format!("its `{name}` takes batches of {batch} alone; export it with a dynamic first axis"))
        }
        _ => wrong(format!("its `{name}` is {dtype}")),
    }
}

fn read_metadata(session: &Session, defaults: Metadata) -> Result<Metadata, LoadReason> {
    let properties = session.metadata()?;
    let keys = properties.custom_keys()?;
    let pairs = keys.into_iter().filter_map(|key| properties.custom(&key).map(|value| (key, value)));
    Ok(Metadata::from_properties(pairs, defaults)?)
}
