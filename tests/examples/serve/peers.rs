//! Other programs that run the same network: a server in Python, Triton, libtorch's eager mode, OpenVINO's runtime.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use grasp::{RESOLUTION, Volume};
use grasp_client::{Arrivals, Client, Options, Report, Until, load};
use grasp_models::{Backend, Precision};
use grasp_proto::oip;
use grasp_proto::oip::grpc_inference_service_client::GrpcInferenceServiceClient;
use grasp_proto::oip::model_infer_request::InferInputTensor;
use rustix::process::{Pid, Signal, kill_process};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use tonic::Code;
use tonic::transport::Channel;

use crate::relative;

/// Flow-control window, bytes. Triton's replies contain the maps, 1.5 MB.
const WINDOW: u32 = 4 << 20;

/// Another server of the same network.
pub(crate) struct Peer {
    process: Child,
    address: SocketAddr,
    protocol: Protocol,
}

#[derive(Clone, Copy)]
enum Protocol {
    Grasps,
    OpenInference,
}

#[derive(Deserialize)]
pub(crate) struct Eager {
    pub p50_ms: f64,
    pub published_p50_ms: f64,
}

#[derive(Deserialize)]
pub(crate) struct Latency {
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub version: String,
}

/// Latency of libtorch's eager mode in fp32, if GRASP_TRAIN is set.
pub(crate) fn eager(model: &Path, threads: usize) -> anyhow::Result<Option<Eager>> {
    let Some(train) = std::env::var_os("GRASP_TRAIN") else { return Ok(None) };
    let threads = threads.to_string();
    let mut command = Command::new(train);
    command.args(["time", "--calls", "30", "--threads", &threads, "--model"]).arg(model);
    printed(&mut command).map(Some)
}

/// Latency of OpenVINO's own runtime, if GRASPD_PEERS is set.
pub(crate) fn openvino(
    model: &Path,
    threads: usize,
    precision: Precision,
    calls: usize,
) -> anyhow::Result<Option<Latency>> {
    let Some(mut command) = python("openvino_latency") else { return Ok(None) };
    if !matches!(precision, Precision::Fp32 | Precision::Bf16) {
        return Ok(None);
    }
    command.args(["--precision", precision.name(), "--threads", &threads.to_string(), "--calls", &calls.to_string()]);
    printed(command.arg("--model").arg(model)).map(Some)
}

fn python(script: &str) -> Option<Command> {
    let mut command = Command::new(std::env::var_os("GRASPD_PEERS")?);
    command.arg(relative(&format!("peers/{script}.py"))).env("GRASPD_PROTO", relative("../proto/proto"));
    Some(command)
}

/// The JSON that a program prints.
fn printed<T: DeserializeOwned>(command: &mut Command) -> anyhow::Result<T> {
    let output = command.stderr(Stdio::inherit()).output().with_context(|| format!("cannot run {command:?}"))?;
    ensure!(output.status.success(), "{command:?} ended with {}", output.status);
    serde_json::from_slice(&output.stdout).with_context(|| format!("the output of {command:?} is not valid JSON"))
}

impl Peer {
    /// Starts a server if GRASPD_PEERS is set, and waits until it is ready.
    pub fn run(name: &str, model: &Path, threads: usize, backend: Backend) -> anyhow::Result<Option<Self>> {
        let Some(mut command) = python(name) else { return Ok(None) };
        let Backend { provider, precision, .. } = backend;
        command.args([
            "--provider",
            provider.name(),
            "--precision",
            precision.name(),
            "--threads",
            &threads.to_string(),
        ]);
        command.arg("--model").arg(model).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut process = command.spawn().with_context(|| format!("cannot run {command:?}"))?;
        let stdout = BufReader::new(process.stdout.take().context("stdout is piped")?);
        let protocol = if name == "triton" { Protocol::OpenInference } else { Protocol::Grasps };
        let mut peer = Self { process, address: SocketAddr::from(([127, 0, 0, 1], 0)), protocol };
        for line in stdout.lines() {
            let line = line?;
            if let Some(address) = line.strip_prefix("grpc listening on ") {
                peer.address = address.parse()?;
            } else if line == "ready" {
                return Ok(Some(peer));
            }
        }
        bail!("{name} ended before it was ready");
    }

    pub async fn load(&self, scene: &Volume, callers: usize, until: Until) -> anyhow::Result<Report> {
        let arrivals = Arrivals::Callers(callers);
        // Warm-up, which is not measured.
        let warm_up = Until::Elapsed(Duration::from_secs(1));
        match self.protocol {
            Protocol::Grasps => {
                let client = Client::connect(self.address.to_string()).await?;
                let scene = Arc::new(scene.clone());
                let call = move |_| {
                    let (client, scene) = (client.clone(), Arc::clone(&scene));
                    async move {
                        let detection = client.detect(&scene, Options::default()).await;
                        detection.map(drop).map_err(|error| error.code().unwrap_or(Code::Unknown))
                    }
                };
                load(arrivals, warm_up, call.clone()).await;
                Ok(load(arrivals, until, call).await)
            }
            Protocol::OpenInference => {
                let endpoint = Channel::from_shared(format!("http://{}", self.address))?;
                let endpoint = endpoint.initial_stream_window_size(WINDOW).initial_connection_window_size(4 * WINDOW);
                let client = GrpcInferenceServiceClient::new(endpoint.connect().await?);
                let client = client.max_decoding_message_size(WINDOW as usize);
                let request = infer(scene);
                let call = move |_| {
                    let (mut client, request) = (client.clone(), request.clone());
                    async move { client.model_infer(request).await.map(drop).map_err(|status| status.code()) }
                };
                load(arrivals, warm_up, call.clone()).await;
                Ok(load(arrivals, until, call).await)
            }
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // SIGTERM, because after SIGKILL the children of the process would stay.
        let _ = kill_process(Pid::from_child(&self.process), Signal::TERM);
        let _ = self.process.wait();
    }
}

fn infer(scene: &Volume) -> oip::ModelInferRequest {
    let edge = RESOLUTION as i64;
    let input = InferInputTensor {
        name: "tsdf".to_owned(),
        datatype: "FP32".to_owned(),
        shape: vec![1, 1, edge, edge, edge],
        ..InferInputTensor::default()
    };
    let bytes: Vec<u8> = scene.values().iter().flat_map(|value| value.to_le_bytes()).collect();
    oip::ModelInferRequest {
        model_name: "grasp".to_owned(),
        inputs: vec![input],
        raw_input_contents: vec![bytes.into()],
        ..oip::ModelInferRequest::default()
    }
}
