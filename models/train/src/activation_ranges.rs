//! Ranges of a network's activations, measured on volumes.

use std::collections::HashMap;

use anyhow::Result;
use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use grasp_models::{ActivationRange, quantized_activations};
use grasp_train::{ExecutionOptions, Executor};
use tch::{Device, Tensor, no_grad};

/// The range of each activation for the quantisation to 8 bits: the mean over the volumes of its smallest and of its
/// largest value. The range over all volumes depends on outliers, and its steps are larger for the other volumes.
pub(crate) fn activation_ranges(
    model: &ModelProto,
    data: &Dataset,
    scenes: impl ExactSizeIterator<Item = usize>,
) -> Result<HashMap<String, ActivationRange>> {
    let names = quantized_activations(model);
    let execution = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: false };
    let executor = Executor::new(model.clone(), execution)?.without_optimizations();
    let (n, share) = (data.resolution() as i64, 1.0 / scenes.len() as f32);
    let mut ranges = vec![ActivationRange { low: 0.0, high: 0.0 }; names.len()];
    for scene in scenes {
        let values: Vec<f32> = data.volume(scene, 0).iter().map(|&byte| grasp_data::value(byte)).collect();
        let volume = Tensor::from_slice(&values).reshape([1, 1, n, n, n]);
        let activations = no_grad(|| executor.intermediate_values(&volume, &names))?;
        for (range, activation) in ranges.iter_mut().zip(activations) {
            range.low += share * f32::try_from(activation.min())?;
            range.high += share * f32::try_from(activation.max())?;
        }
    }
    Ok(names.into_iter().zip(ranges).collect())
}
