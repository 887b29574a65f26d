use tch::{Device, Tensor};

/// How the graph is executed. Only `bf16` changes the results, within its precision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ExecutionOptions {
    /// Device.
    pub device: Device,
    /// Convolutions, matrix products and the operators that keep the type of their input in bfloat16, as in PyTorch's
    /// autocast. Weights, sums, softmax, layer norms and outputs are f32.
    pub bf16: bool,
    /// Memory layout with the channels of a voxel adjacent.
    pub channels_last: bool,
}

impl ExecutionOptions {
    /// The weight in the memory layout of this execution.
    pub fn arrange(self, weight: &Tensor) -> Tensor {
        if self.channels_last && weight.dim() == 5 {
            weight.permute([0, 2, 3, 4, 1]).contiguous().permute([0, 4, 1, 2, 3])
        } else {
            weight.contiguous()
        }
    }
}
