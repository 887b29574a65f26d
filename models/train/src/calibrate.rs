//! Ranges of a network's activations, measured on volumes.

use std::collections::HashMap;

use anyhow::Result;
use grasp_data::Dataset;
use grasp_models::onnx::ModelProto;
use grasp_models::{Range, quantized_activations};
use grasp_train::{Execution, Executor};
use tch::{Device, Tensor, no_grad};

/// The range of each activation for 8 bits: the means over the volumes of its smallest and its greatest value. The
/// range over all volumes would be dominated by outliers and coarser for the other volumes.
pub(crate) fn ranges(
    model: &ModelProto,
    data: &Dataset,
    scenes: impl ExactSizeIterator<Item = usize>,
) -> Result<HashMap<String, Range>> {
    let names = quantized_activations(model);
    let execution = Execution { device: Device::Cpu, bf16: false, channels_last: false };
    let executor = Executor::new(model.clone(), execution)?.as_written();
    let (n, share) = (data.resolution() as i64, 1.0 / scenes.len() as f32);
    let mut ranges = vec![Range { low: 0.0, high: 0.0 }; names.len()];
    for scene in scenes {
        let values: Vec<f32> = data.volume(scene, 0).iter().map(|&byte| grasp_data::value(byte)).collect();
        let volume = Tensor::from_slice(&values).reshape([1, 1, n, n, n]);
        let activations = no_grad(|| executor.inside(&volume, &names))?;
        for (range, activation) in ranges.iter_mut().zip(activations) {
            range.low += share * f32::try_from(activation.min())?;
            range.high += share * f32::try_from(activation.max())?;
        }
    }
    Ok(names.into_iter().zip(ranges).collect())
}
