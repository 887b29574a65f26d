//! Sessions with their buffers, each for one batch size or for all.

use std::collections::{BTreeMap, btree_map};

use ort::memory::Allocator;
use ort::session::{IoBinding, Session};
use ort::value::Tensor;

use super::backend::{Backend, Provider};
use super::model_file::ModelFile;
use super::{INPUT, LoadReason, OUTPUTS};

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
