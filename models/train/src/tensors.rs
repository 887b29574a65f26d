//! Conversions between the tensors of ONNX and of libtorch.

use grasp_models::onnx::{TensorError, TensorProto};
use tch::{Device, Tensor, no_grad};

/// The values of a tensor, row-major.
pub(crate) fn values_of(tensor: &Tensor) -> Vec<f32> {
    let tensor = no_grad(|| tensor.to_device(Device::Cpu).contiguous());
    let mut values = vec![0.0; tensor.numel()];
    let count = values.len();
    tensor.copy_data(&mut values, count);
    values
}

pub(crate) fn tensor_of(tensor: &TensorProto) -> Result<Tensor, TensorError> {
    let flat =
        if tensor.is_float() { Tensor::from_slice(&tensor.to_f32()?) } else { Tensor::from_slice(&tensor.to_i64()?) };
    Ok(flat.reshape(&tensor.dims))
}

/// A constant tensor. Integers are shapes and sizes, which are read on the CPU.
pub(crate) fn constant(tensor: &TensorProto, device: Device) -> Result<Tensor, TensorError> {
    let device = if tensor.is_float() { device } else { Device::Cpu };
    Ok(tensor_of(tensor)?.to_device(device))
}
