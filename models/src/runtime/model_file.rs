//! A model file, from which sessions are created.

use std::cell::OnceCell;
use std::collections::HashSet;
use std::path::Path;

use ort::session::Session;
use prost::Message;

use super::backend::{Backend, Precision, Provider};
use super::library::runtime;
use super::{BackendError, INPUT, LoadReason, Options};
use crate::gpd;
use crate::half_computation::with_half_computation;
use crate::onnx::ModelProto;
use crate::upsampling::with_upsampling_folded;
use crate::{Calibration, MetadataError, with_full_weights};

/// A model file with the properties that are needed to load it.
pub(super) struct ModelFile<'a> {
    pub path: &'a Path,
    /// Content of the file.
    bytes: &'a [u8],
    /// An equivalent graph with fewer multiplications, if there is one.
    optimized: Option<Vec<u8>>,
    /// The graph with its convolutions and matrix products in f16, converted when it is first needed.
    half: OnceCell<Result<Vec<u8>, BackendError>>,
    pub options: &'a Options,
    /// Whether the model is quantised to 8 bits.
    pub is_int8: bool,
    /// The external file with its weights, if any.
    pub external_weights: Option<String>,
    /// Name of the batch dimension.
    pub batch: Option<String>,
    /// The calibration of a classifier.
    pub calibration: Result<Calibration, MetadataError>,
}

impl<'a> ModelFile<'a> {
    /// Reads the properties. An invalid file has none; ONNX Runtime reports a better error when it loads the file.
    pub fn new(path: &'a Path, bytes: &'a [u8], options: &'a Options) -> Self {
        let model = ModelProto::from_bytes(bytes).unwrap_or_default();
        let optimized = optimized(&model, bytes);
        let calibration = Calibration::from_model(&model);
        let graph = model.graph.unwrap_or_default();
        let is_int8 = graph.node.iter().any(|node| node.op_type() == "QuantizeLinear");
        let is_batch = |name: &str| name == INPUT || name == gpd::INPUT;
        let batch = graph.input.iter().find(|input| is_batch(input.name())).and_then(|input| input.free(0));
        let batch = batch.map(str::to_owned);
        let external_weights = graph.initializer.iter().find_map(|tensor| tensor.external_file()).map(str::to_owned);
        let half = OnceCell::new();
        Self { path, bytes, optimized, half, options, is_int8, external_weights, batch, calibration }
    }

    /// The unmodified file, if an optimized graph is used.
    pub fn original(&self) -> Option<Self> {
        self.optimized.as_ref()?;
        let (batch, calibration) = (self.batch.clone(), self.calibration.clone());
        let half = OnceCell::new();
        Some(Self { optimized: None, half, external_weights: None, batch, calibration, ..*self })
    }

    /// Creates a session, for one fixed batch size if given.
    pub fn open(&self, backend: Backend, size: Option<usize>) -> Result<Session, LoadReason> {
        let runtime = runtime()?;
        let threads = self.options.threads();
        let builder = Session::builder(&runtime.environment)?;
        let builder = builder.with_intra_threads(threads).map_err(ort::Error::from)?;
        let builder = builder.with_inter_threads(1).map_err(ort::Error::from)?;
        // Idle threads would wait in a loop, which takes CPU time from other sessions and makes the start longer.
        let mut builder = builder.with_intra_op_spinning(false).map_err(ort::Error::from)?;
        if let (Some(name), Some(size)) = (&self.batch, size) {
            builder = builder.with_dimension_override(name, size as i64).map_err(ort::Error::from)?;
        }
        if let Some(provider) = backend.dispatch(threads) {
            builder = builder.with_execution_providers([provider]).map_err(ort::Error::from)?;
        }
        if matches!(backend.provider, Provider::OpenVino | Provider::Cuda) {
            // Without this option, operators that the provider does not support run on the CPU kernels without an error.
            builder = builder.with_config_entry("session.disable_cpu_ep_fallback", "1").map_err(ort::Error::from)?;
        }
        // ONNX Runtime's CUDA kernels compute in the types of the graph.
        let bytes = match backend {
            Backend { provider: Provider::Cuda, precision: Precision::Fp16, .. } => self.half()?,
            _ => self.graph(),
        };
        Ok(builder.commit_from_memory(bytes)?)
    }

    fn graph(&self) -> &[u8] {
        self.optimized.as_deref().unwrap_or(self.bytes)
    }

    fn half(&self) -> Result<&[u8], BackendError> {
        let convert = || -> Result<_, Box<dyn std::error::Error>> {
            let model = with_full_weights(&ModelProto::from_bytes(self.graph())?)?;
            Ok(with_half_computation(&model)?.encode_to_vec())
        };
        let half = self.half.get_or_init(|| convert().map_err(|error| BackendError::Half(error.to_string())));
        half.as_deref().map_err(Clone::clone)
    }
}

/// An equivalent graph, if there is one. Only if our ONNX types represent the whole file: unknown fields would
/// be lost.
fn optimized(model: &ModelProto, bytes: &[u8]) -> Option<Vec<u8>> {
    if model.encoded_len() != bytes.len() {
        return None;
    }
    with_upsampling_folded(&with_full_weights(model).ok()?).map(|model| model.encode_to_vec())
}

/// The file without the weights among its inputs, as old exporters list them: ONNX Runtime would not treat these weights as
/// constants, and its OpenVINO provider crashes the process.
pub(super) fn without_weight_inputs(bytes: Vec<u8>) -> Result<Vec<u8>, LoadReason> {
    let Ok(mut model) = ModelProto::from_bytes(&bytes) else { return Ok(bytes) };
    let is_whole = model.encoded_len() == bytes.len();
    let Some(graph) = &mut model.graph else { return Ok(bytes) };
    let weights: HashSet<String> = graph.initializer.iter().map(|weight| weight.name().to_owned()).collect();
    let Some(listed) = graph.input.iter().find(|input| weights.contains(input.name())) else { return Ok(bytes) };
    if !is_whole {
        let what =
            format!("the weight `{}` is also an input; export with keep_initializers_as_inputs=False", listed.name());
        return Err(LoadReason::Signature { what });
    }
    graph.input.retain(|input| !weights.contains(input.name()));
    Ok(model.encode_to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::{StringStringEntryProto, ValueInfoProto};

    #[test]
    fn a_file_is_rewritten_only_if_no_content_is_lost() {
        let mut vgn = crate::build("vgn", 0).unwrap();
        let graph = vgn.graph.as_mut().unwrap();
        let comment = StringStringEntryProto { key: Some("from".to_owned()), value: Some("line 7".to_owned()) };
        graph.node[0].metadata_props.push(comment);
        graph.value_info.push(ValueInfoProto::tensor(&graph.node[0].output[0].clone(), vec![]));
        let mut bytes = vgn.encode_to_vec();
        let read = |bytes: &[u8]| ModelProto::from_bytes(bytes).unwrap();
        assert!(optimized(&read(&bytes), &bytes).is_some());

        // Field 100, which the published format does not have.
        bytes.extend([0xa2, 0x06, 0x00]);
        assert!(optimized(&read(&bytes), &bytes).is_none());
    }
}
