//! Loading a model with the fastest backend that computes what the reference computes.

use std::fs;
use std::path::Path;

use tracing::warn;

use super::backend::{AvailableBackends, Backend};
use super::library::runtime;
use super::model_file::{ModelFile, without_weight_inputs};
use super::{LoadError, LoadReason, Options, RuntimeError};
use crate::Entry;

/// Loads a file. `content` returns the part of its bytes that is loaded. `open_checked` loads the model with one backend
/// and compares its outputs with the reference.
pub(super) fn load<T>(
    path: &Path,
    options: &Options,
    content: impl Fn(Vec<u8>) -> Result<Vec<u8>, LoadReason>,
    open_checked: impl Fn(&ModelFile, Backend) -> Result<T, LoadReason>,
) -> Result<T, LoadError> {
    let load = || {
        // Fails early if ONNX Runtime cannot be loaded.
        runtime()?;
        let bytes = without_weight_inputs(content(fs::read(path)?)?)?;
        let (model, _) = fastest(&ModelFile::new(path, &bytes, options), options, open_checked)?;
        Ok(model)
    };
    load().map_err(|reason| LoadError { path: path.to_owned(), reason })
}

/// Loads an entry of a store once per session. The first copy is checked; the others use its backend and are not.
pub(super) fn load_several<T>(
    entry: &Entry,
    options: &Options,
    content: impl Fn(Vec<u8>) -> Result<Vec<u8>, LoadReason>,
    open_checked: impl Fn(&ModelFile, Backend) -> Result<T, LoadReason>,
    open: impl Fn(&ModelFile, Backend) -> Result<T, LoadReason>,
) -> Result<Vec<T>, LoadError> {
    let load = || {
        runtime()?;
        let bytes = without_weight_inputs(content(entry.bytes()?)?)?;
        let model = ModelFile::new(&entry.path, &bytes, options);
        let (first, backend) = fastest(&model, options, open_checked)?;
        let others = (1..options.sessions(backend)).map(|_| open(&model, backend));
        std::iter::once(Ok(first)).chain(others).collect::<Result<_, LoadReason>>()
    };
    load().map_err(|reason| LoadError { path: entry.path.clone(), reason })
}

/// Loads with the first allowed backend that passes the check.
fn fastest<T>(
    model: &ModelFile,
    options: &Options,
    open_checked: impl Fn(&ModelFile, Backend) -> Result<T, LoadReason>,
) -> Result<(T, Backend), LoadReason> {
    if let Some(file) = &model.external_weights {
        return Err(LoadReason::Split(file.clone()));
    }
    let backends = AvailableBackends::here().backends(options.provider, options.precision, model.is_int8)?;
    let backends: Vec<Backend> = if options.cuda_graphs {
        backends.into_iter().flat_map(Backend::and_with_cuda_graph).collect()
    } else {
        backends
    };
    let (&last, others) = backends.split_last().ok_or(RuntimeError::EmptyBatch)?;
    for &backend in others {
        match open_checked(model, backend) {
            Ok(loaded) => return Ok((loaded, backend)),
            Err(error) => {
                warn!(model = %model.path.display(), %backend, %error, "backend rejected, trying the next one")
            }
        }
    }
    Ok((open_checked(model, last)?, last))
}
