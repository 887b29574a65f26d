use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::Args;
use grasp_models::onnx::ModelProto;
use grasp_models::{Metadata, with_full_weights, with_published_heads};
use grasp_train::{ExecutionOptions, Executor};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

/// Untimed volumes before the timed ones.
const WARM_UP: usize = 3;

/// Median latency of libtorch for one volume in fp32, operator by operator, as in PyTorch's eager mode.
#[derive(Args)]
pub(crate) struct EagerLatency {
    /// Model file.
    #[arg(long)]
    model: PathBuf,
    /// Number of timed volumes.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    calls: u32,
    /// Threads of libtorch.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    threads: u16,
}

/// The printed report.
#[derive(Serialize)]
struct LatencyReport {
    calls: u32,
    threads: u16,
    /// Median for the graph of the file.
    p50_ms: f64,
    /// Median with a separate convolution for each of the three heads, as in VGN and the paper.
    published_p50_ms: f64,
}

impl EagerLatency {
    pub fn run(&self) -> Result<()> {
        tch::set_num_threads(self.threads.into());
        let model = ModelProto::read(&self.model)?;
        let published =
            with_published_heads(&with_full_weights(&model)?).context("--model must be a network of `grasp-train`")?;
        let edge = Metadata::from_model(&model, &self.model)?.resolution as i64;
        let published_p50_ms = self.median(published, edge)?;
        let p50_ms = self.median(model, edge)?;
        let report = LatencyReport { calls: self.calls, threads: self.threads, p50_ms, published_p50_ms };
        println!("{}", serde_json::to_string(&report)?);
        Ok(())
    }

    /// Median latency for a volume of `edge`³ voxels, milliseconds.
    fn median(&self, model: ModelProto, edge: i64) -> Result<f64> {
        let execution = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: false };
        let executor = Executor::new(model, execution)?.without_optimizations();
        let volume = Tensor::rand([1, 1, edge, edge, edge], (Kind::Float, Device::Cpu));
        let mut times = Vec::new();
        let _no_gradients = tch::no_grad_guard();
        for _ in 0..WARM_UP + self.calls as usize {
            let started = Instant::now();
            executor.forward(&volume)?;
            times.push(started.elapsed());
        }
        let times = &mut times[WARM_UP..];
        times.sort_unstable();
        Ok(times.get(times.len() / 2).map_or(0.0, Duration::as_secs_f64) * 1e3)
    }
}
