//! Sessions with their buffers, each for one batch size or for all.

use std::collections::{BTreeMap, btree_map};

use ort::memory::{AllocationDevice, Allocator, AllocatorType, MemoryInfo, MemoryType};
use ort::session::{IoBinding, RunOptions, Session};
use ort::value::Tensor;

use super::backend::{Backend, Provider};
use super::model_file::ModelFile;
use super::{INPUT, LoadReason, OUTPUTS};

/// A session with its buffers.
pub(super) struct BatchSession {
    session: Session,
    uses_cuda_graphs: bool,
    /// The fixed batch size; smaller batches are padded. `None` for any size.
    size: Option<usize>,
    /// Buffers by batch size: the powers of two, and one other size. They need less than three times the memory of the
    /// largest batch.
    buffers: BTreeMap<usize, Buffers>,
}

/// Input and outputs of one batch size in the memory of the host. ONNX Runtime reads and writes them in place, or copies
/// them if it runs a CUDA graph.
struct Buffers {
    binding: IoBinding,
    input: Tensor<f32>,
    outputs: OutputTensors,
    graph: Option<CudaGraph>,
}

/// The buffers of a CUDA graph in the memory of the GPU. The graph has their addresses, so that they stay bound.
struct CudaGraph {
    input: Tensor<f32>,
    outputs: OutputTensors,
    options: RunOptions,
}

/// In the order of [`OUTPUTS`].
pub(super) type OutputTensors = [Tensor<f32>; 3];

impl BatchSession {
    /// The sessions for batches of up to `max_batch`, smallest first. One session serves all sizes if the provider
    /// supports changing shapes; otherwise there is one per size of [`batch_sizes`].
    ///
    /// OpenVINO fuses the operators after the heads only for a known shape, which halves the time of VGN's network in
    /// bf16. TensorRT would build a new engine for each size. CUDA prepares its convolutions again whenever the size
    /// changes: with one session for all sizes, 64 callers waited for up to 0.8 s.
    pub fn all(model: &ModelFile, backend: Backend, max_batch: usize) -> Result<Vec<Self>, LoadReason> {
        let fixed = backend.provider != Provider::Cpu && model.batch.is_some();
        let sizes = if fixed { batch_sizes(max_batch).map(Some).collect() } else { vec![None] };
        let session = |size| {
            let session = model.open(backend, size)?;
            Ok(Self { session, uses_cuda_graphs: backend.cuda_graph, size, buffers: BTreeMap::new() })
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
        match &mut buffers.graph {
            None => {
                // Bound again for each run, because on some devices binding copies the input.
                buffers.binding.bind_input(INPUT, &buffers.input)?;
                session.run_binding(&buffers.binding)?;
            }
            Some(graph) => {
                // The first runs record the graph, the later ones replay it.
                buffers.input.copy_into(&mut graph.input)?;
                session.run_binding_with_options(&buffers.binding, &graph.options)?;
                for (output, copy) in graph.outputs.iter().zip(&mut buffers.outputs) {
                    output.copy_into(copy)?;
                }
            }
        }
        Ok(&buffers.outputs)
    }

    fn session_and_buffers(&mut self, batch: usize, resolution: usize) -> ort::Result<(&mut Session, &mut Buffers)> {
        let size = self.size.unwrap_or(batch);
        // A recorded graph has the addresses of its buffers.
        let may_forget = !self.uses_cuda_graphs && !size.is_power_of_two();
        if may_forget && !self.buffers.contains_key(&size) {
            self.buffers.retain(|size, _| size.is_power_of_two());
        }
        let buffers = match self.buffers.entry(size) {
            btree_map::Entry::Occupied(entry) => entry.into_mut(),
            btree_map::Entry::Vacant(entry) => entry.insert(if self.uses_cuda_graphs {
                Buffers::with_cuda_graph(&self.session, size, resolution)?
            } else {
                Buffers::new(&self.session, size, resolution)?
            }),
        };
        Ok((&mut self.session, buffers))
    }
}

/// The batch sizes that networks are prepared for: the powers of two below `largest`, and `largest`.
pub fn batch_sizes(largest: usize) -> impl Iterator<Item = usize> {
    let powers = (0..usize::BITS).map(|bit| 1 << bit);
    powers.take_while(move |&size| size < largest).chain([largest])
}

impl Buffers {
    fn new(session: &Session, batch: usize, resolution: usize) -> ort::Result<Self> {
        let (input, mut outputs) = tensors(&Allocator::default(), batch, resolution)?;
        let binding = bound(session, &mut outputs)?;
        Ok(Self { binding, input: zeroed(input), outputs, graph: None })
    }

    fn with_cuda_graph(session: &Session, batch: usize, resolution: usize) -> ort::Result<Self> {
        // Not in pinned memory: ort's copies take it for memory of the GPU, and fail.
        let (input, outputs) = tensors(&Allocator::default(), batch, resolution)?;
        let memory = MemoryInfo::new(AllocationDevice::CUDA, 0, AllocatorType::Device, MemoryType::Default)?;
        let device = Allocator::new(session, memory)?;
        let (device_input, mut device_outputs) = tensors(&device, batch, resolution)?;
        let mut binding = bound(session, &mut device_outputs)?;
        binding.bind_input(INPUT, &device_input)?;
        let mut options = RunOptions::new()?;
        // One graph for each batch size.
        options.set("gpu_graph_id", batch.to_string())?;
        let graph = CudaGraph { input: device_input, outputs: device_outputs, options };
        Ok(Self { binding, input: zeroed(input), outputs, graph: Some(graph) })
    }
}

fn tensors(allocator: &Allocator, batch: usize, resolution: usize) -> ort::Result<(Tensor<f32>, OutputTensors)> {
    let tensor = |channels| Tensor::<f32>::new(allocator, [batch, channels, resolution, resolution, resolution]);
    Ok((tensor(1)?, [tensor(OUTPUTS[0].1)?, tensor(OUTPUTS[1].1)?, tensor(OUTPUTS[2].1)?]))
}

fn zeroed(mut input: Tensor<f32>) -> Tensor<f32> {
    input.extract_tensor_mut().1.fill(0.0);
    input
}

fn bound(session: &Session, outputs: &mut OutputTensors) -> ort::Result<IoBinding> {
    let mut binding = session.create_binding()?;
    for ((name, _), tensor) in OUTPUTS.iter().zip(outputs) {
        binding.bind_output(*name, tensor)?;
    }
    Ok(binding)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batch_sizes_are_powers_of_two_and_the_largest() {
        let sizes = |largest| batch_sizes(largest).collect::<Vec<_>>();
        assert_eq!(sizes(1), [1]);
        assert_eq!(sizes(2), [1, 2]);
        assert_eq!(sizes(6), [1, 2, 4, 6]);
        assert_eq!(sizes(8), [1, 2, 4, 8]);
    }
}
