//! ONNX Runtime's shared library.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use ort::LoadDynamicError;
use ort::environment::Environment;
use ort::logging::LogLevel;

use super::{RuntimeError, search};

/// The loaded ONNX Runtime.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RuntimeInfo {
    /// Path of the shared library.
    pub library: PathBuf,
    /// Version, such as `1.24.1`.
    pub version: String,
}

/// Loads ONNX Runtime once: the library that `ORT_DYLIB_PATH` names; or that of the Python environment in which the program
/// is installed; or the one that `deploy/native.py` has downloaded; or that of the system.
///
/// Disables telemetry, which official builds enable. ONNX Runtime logs to `tracing`.
///
/// # Errors
/// [`RuntimeError::Library`] describes the problem and how to install the library.
pub fn init() -> Result<&'static RuntimeInfo, RuntimeError> {
    Ok(&runtime()?.info)
}

pub(super) struct Runtime {
    info: RuntimeInfo,
    /// Never dropped, because threads of ONNX Runtime may outlive `main`.
    pub environment: Environment,
}

pub(super) fn runtime() -> Result<&'static Runtime, RuntimeError> {
    static RUNTIME: OnceLock<Result<Runtime, RuntimeError>> = OnceLock::new();
    RUNTIME.get_or_init(load_library).as_ref().map_err(Clone::clone)
}

fn load_library() -> Result<Runtime, RuntimeError> {
    let library = search::library();
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
