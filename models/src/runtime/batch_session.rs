//! Sessions with their buffers, each for one batch size or for all.

use std::collections::{BTreeMap, btree_map};
use std::path::Path;

use ort::memory::Allocator;
use ort::session::{IoBinding, Session};
use ort::value::Tensor;
use prost::Message;

use super::backend::{Backend, Precision, Provider};
use super::{BackendError, INPUT, LoadReason, OUTPUTS, Options, runtime};
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
    threads: usize,
    /// Whether the model is quantised to 8 bits.
    pub is_int8: bool,
    /// The external file with its weights, if any.
    pub external_weights: Option<String>,
    /// Name of the batch dimension.
    batch: Option<String>,
    /// The calibration of a classifier.
    pub calibration: Result<Calibration, MetadataError>,
}

/// A session with its buffers.
pub(super) struct BatchSession {
    session: Session,
    /// The fixed batch size; smaller batches are padded. `None` for any size.
    size: Option<usize>,
    /// Sizes that batches are padded to, smallest first; empty if they are not padded.
    padded_sizes: Vec<usize>,
    /// Buffers by batch size: the powers of two, and one other size. They need less than three times the memory of the
    /// largest batch.
    buffers: BTreeMap<usize, Buffers>,
}

/// Input and outputs of one batch size, which ONNX Runtime reads and writes in place.
struct Buffers {
    binding: IoBinding,
    input: Tensor<f32>,
    outputs: OutputTensors,
}

/// In the order of [`OUTPUTS`].
pub(super) type OutputTensors = [Tensor<f32>; 3];

impl<'a> ModelFile<'a> {
    /// Reads the properties. An invalid file has none; ONNX Runtime reports a better error when it loads the file.
    pub fn new(path: &'a Path, bytes: &'a [u8], options: &Options) -> Self {
        let model = ModelProto::from_bytes(bytes).unwrap_or_default();
        let optimized = optimized(&model, bytes);
        let calibration = Calibration::of(&model);
        let graph = model.graph.unwrap_or_default();
        let is_int8 = graph.node.iter().any(|node| node.op_type() == "QuantizeLinear");
        let is_batch = |name: &str| name == INPUT || name == gpd::INPUT;
        let batch = graph.input.iter().find(|input| is_batch(input.name())).and_then(|input| input.free(0));
        let batch = batch.map(str::to_owned);
        let external_weights = graph.initializer.iter().find_map(|tensor| tensor.external_file()).map(str::to_owned);
        Self { path, bytes, optimized, threads: options.threads, is_int8, external_weights, batch, calibration }
    }

    /// The unmodified file, if an optimized graph is used.
    pub fn original(&self) -> Option<Self> {
        self.optimized.as_ref()?;
        let (batch, calibration) = (self.batch.clone(), self.calibration.clone());
        Some(Self { optimized: None, external_weights: None, batch, calibration, ..*self })
    }

    /// Creates a session, for one fixed batch size if given.
    pub fn open(&self, backend: Backend, size: Option<usize>) -> Result<Session, LoadReason> {
        let runtime = runtime()?;
        let builder = Session::builder(&runtime.environment)?;
        let builder = builder.with_intra_threads(self.threads).map_err(ort::Error::from)?;
        let mut builder = builder.with_inter_threads(1).map_err(ort::Error::from)?;
        if let (Some(name), Some(size)) = (&self.batch, size) {
            builder = builder.with_dimension_override(name, size as i64).map_err(ort::Error::from)?;
        }
        if let Some(provider) = backend.dispatch(self.threads) {
            builder = builder.with_execution_providers([provider]).map_err(ort::Error::from)?;
        }
        if matches!(backend.provider, Provider::OpenVino | Provider::Cuda) {
            // Without this option, operators that the provider does not support run on the CPU kernels without an error.
            builder = builder.with_config_entry("session.disable_cpu_ep_fallback", "1").map_err(ort::Error::from)?;
        }
        let bytes = self.optimized.as_deref().unwrap_or(self.bytes);
        // ONNX Runtime's CUDA kernels compute in the types of the graph.
        let half = (backend == Backend { provider: Provider::Cuda, precision: Precision::Fp16 })
            .then(|| half_precision(bytes))
            .transpose()?;
        Ok(builder.commit_from_memory(half.as_deref().unwrap_or(bytes))?)
    }
}

/// The graph with its convolutions and matrix products in f16.
fn half_precision(bytes: &[u8]) -> Result<Vec<u8>, LoadReason> {
    let convert = || -> Result<_, Box<dyn std::error::Error>> {
        let model = with_full_weights(&ModelProto::from_bytes(bytes)?)?;
        Ok(with_half_computation(&model)?.encode_to_vec())
    };
    convert().map_err(|error| BackendError::Half(error.to_string()).into())
}

/// An equivalent graph, if there is one. Only if our ONNX types represent the whole file: unknown fields would
/// be lost.
fn optimized(model: &ModelProto, bytes: &[u8]) -> Option<Vec<u8>> {
    if model.encoded_len() != bytes.len() {
        return None;
    }
    with_upsampling_folded(&with_full_weights(model).ok()?).map(|model| model.encode_to_vec())
}

impl BatchSession {
    /// The sessions for batches of up to `max_batch`, smallest first. One session serves all sizes if the provider
    /// supports changing shapes; otherwise there is one per size of [`batch_sizes`].
    ///
    /// OpenVINO fuses the operators after the heads only for a known shape, which halves the time of VGN's network in
    /// bf16. TensorRT would build a new engine for each size. CUDA searches the fastest convolutions for each new size
    /// (`cudnn_conv_algo_search`, by default exhaustive), so that batches are padded to sizes that were run when the model was loaded.
    pub fn all(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Vec<Self>, LoadReason> {
        let fixed = matches!(backend.provider, Provider::OpenVino | Provider::TensorRt) && model.batch.is_some();
        let sizes = if fixed { batch_sizes(max_batch).map(Some).collect() } else { vec![None] };
        let padded_sizes: Vec<usize> =
            if backend.provider == Provider::Cuda { batch_sizes(max_batch).collect() } else { Vec::new() };
        let session = |size| {
            let (session, padded_sizes) = (model.open(backend, size)?, padded_sizes.clone());
            Ok(Self { session, size, padded_sizes, buffers: BTreeMap::new() })
        };
        sizes.into_iter().map(session).collect()
    }

    pub fn session(&self) -> &Session {
        &self.session
    }

    pub fn size(&self) -> Option<usize> {
        self.size
    }

    pub fn fits(&self, batch: usize) -> bool {
        self.size.is_none_or(|size| batch <= size)
    }

    /// The input buffer of a batch, volume by volume.
    pub fn input(&mut self, batch: usize, resolution: usize) -> ort::Result<&mut [f32]> {
        let (_, buffers) = self.session_and_buffers(batch, resolution)?;
        Ok(buffers.input.extract_tensor_mut().1)
    }

    /// Runs a batch on the content of its buffers. If the batch is padded, the outputs of the remaining volumes are
    /// ignored.
    pub fn run(&mut self, batch: usize, resolution: usize) -> ort::Result<&OutputTensors> {
        let (session, buffers) = self.session_and_buffers(batch, resolution)?;
        // Bound again for each run, because on some devices binding copies the input.
        buffers.binding.bind_input(INPUT, &buffers.input)?;
        session.run_binding(&buffers.binding)?;
        Ok(&buffers.outputs)
    }

    fn session_and_buffers(&mut self, batch: usize, resolution: usize) -> ort::Result<(&mut Session, &mut Buffers)> {
        let size = self.size.unwrap_or_else(|| padded(batch, &self.padded_sizes));
        if !size.is_power_of_two() && !self.buffers.contains_key(&size) {
            self.buffers.retain(|size, _| size.is_power_of_two());
        }
        let buffers = match self.buffers.entry(size) {
            btree_map::Entry::Occupied(entry) => entry.into_mut(),
            btree_map::Entry::Vacant(entry) => entry.insert(Buffers::new(&self.session, size, resolution)?),
        };
        Ok((&mut self.session, buffers))
    }
}

/// The smallest of `sizes` that holds a batch, or the size of the batch if there is none.
fn padded(batch: usize, sizes: &[usize]) -> usize {
    sizes.iter().copied().find(|&size| size >= batch).unwrap_or(batch)
}

/// The batch sizes that networks are prepared for: the powers of two below `largest`, and `largest`.
pub fn batch_sizes(largest: usize) -> impl Iterator<Item = usize> {
    let powers = (0..usize::BITS).map(|bit| 1 << bit);
    powers.take_while(move |&size| size < largest).chain([largest])
}

impl Buffers {
    fn new(session: &Session, batch: usize, resolution: usize) -> ort::Result<Self> {
        let tensor =
            |channels| Tensor::<f32>::new(&Allocator::default(), [batch, channels, resolution, resolution, resolution]);
        let mut input = tensor(1)?;
        input.extract_tensor_mut().1.fill(0.0);
        let mut outputs = [tensor(OUTPUTS[0].1)?, tensor(OUTPUTS[1].1)?, tensor(OUTPUTS[2].1)?];
        let mut binding = session.create_binding()?;
        for ((name, _), tensor) in OUTPUTS.iter().zip(&mut outputs) {
            binding.bind_output(*name, tensor)?;
        }
        Ok(Self { binding, input, outputs })
    }
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

    #[test]
    fn batch_sizes_are_powers_of_two_and_the_largest() {
        let sizes = |largest| batch_sizes(largest).collect::<Vec<_>>();
        assert_eq!(sizes(1), [1]);
        assert_eq!(sizes(2), [1, 2]);
        assert_eq!(sizes(6), [1, 2, 4, 6]);
        assert_eq!(sizes(8), [1, 2, 4, 8]);
        assert_eq!([1, 2, 3, 5, 6].map(|batch| padded(batch, &sizes(6))), [1, 2, 4, 6, 6]);
        assert_eq!(padded(5, &[]), 5, "a provider that needs no padding");
    }
}
