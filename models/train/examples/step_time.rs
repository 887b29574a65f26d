//! Measures one training step of a network for each combination of precision and memory layout.
//!
//! `cargo run --release -p grasp-train --example step_time -- NETWORK BATCH THREADS`

use std::time::Instant;

use grasp::VoxelOrigin;
use grasp_data::Trial;
use grasp_models::build;
use grasp_train::{Adam, ExecutionOptions, Executor, LossWeights, QualityTarget, Targets};
use nalgebra::{Point3, UnitQuaternion};
use tch::{Device, Kind, Tensor};

const STEPS: usize = 8;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [network, batch, threads] = arguments.as_slice() else {
        anyhow::bail!("usage: step_time NETWORK BATCH THREADS")
    };
    let batch: usize = batch.parse()?;
    tch::set_num_threads(threads.parse()?);
    tch::manual_seed(0);
    let device = Device::cuda_if_available();

    let volumes = Tensor::rand([batch as i64, 1, 40, 40, 40], (Kind::Float, device));
    let mut targets = Targets::default();
    for index in 0..batch {
        for label in 0..24 {
            let position = Point3::from([5, 7, 11].map(|step| f64::from(label * step % 36 + 2)));
            let rotation = UnitQuaternion::identity();
            let success = label % 2 == 0;
            let share = if success { 1.0 } else { 0.0 };
            let label = Trial { position, rotation, width: 5.0, success, yaws: 0, share, clearance: 0.0 };
            targets.push(index, &label, 40, VoxelOrigin::Corner, QualityTarget::Label);
        }
    }

    for bf16 in [false, true] {
        for channels_last in [false, true] {
            let executor = Executor::new(build(network, 0)?, ExecutionOptions { device, bf16, channels_last })?;
            let mut adam = Adam::new(executor.parameters(), 0.0);
            let mut times: Vec<f64> = Vec::new();
            for _ in 0..STEPS {
                let start = Instant::now();
                let loss = targets.loss(&executor.forward_at(&volumes, targets.voxels())?, &LossWeights::default())?;
                loss.mean.backward();
                adam.step(executor.parameters(), 1e-4);
                times.push(start.elapsed().as_secs_f64());
            }
            times.sort_by(f64::total_cmp);
            let per_volume = times[STEPS / 2] * 1e3 / batch as f64;
            println!(
                "{network}, batch {batch}, bf16 {bf16}, channels last {channels_last}: {per_volume:.1} ms a volume"
            );
        }
    }
    Ok(())
}
