//! What gRPC costs: the time of a call over loopback beyond the network itself.
//!
//! `ORT_DYLIB_PATH=… cargo run --release -p grasp-tests --example hop [calls]`
//!
//! Three rows, one caller at a time, the same 40³ volume: `session.run` alone, the same with decoding (what the server
//! must do in any case), and the whole call. The network is the identity, which leaves the hop as large as it can look.

use std::time::{Duration, Instant};

use grasp::decode;
use grasp_client::{Client, DataType, Latency, Options};
use grasp_models::{Network, Options as Threads};
use grasp_tests::{Server, TestModel, blobs};
use nalgebra::Isometry3;

const RESOLUTION: usize = 40;
const WARM_UP: usize = 200;

#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    let calls = std::env::args().nth(1).map_or(Ok(10_000), |calls| calls.parse())?;
    let model = TestModel::new("mirror").resolution(RESOLUTION);
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[10, 20, 15], [30, 12, 25]]);

    let cpus = std::thread::available_parallelism()?;
    let profile = if cfg!(debug_assertions) { "dev" } else { "release" };
    println!(
        "{calls} calls each, {cpus} CPUs, 1 thread per session, {profile} profile, identity network of 40³ voxels\n"
    );
    println!("{:32} {:>9} {:>9} {:>9} {:>9}", "microseconds", "p50", "p90", "p99", "mean");

    let folder = tempfile::tempdir()?;
    model.write(folder.path());
    let mut network =
        Network::load(&folder.path().join("mirror-1.onnx"), &Threads { threads: 1, ..Threads::default() })?;
    let params = network.metadata().decode_params();
    network.fill(&[&volume])?;
    let mut run = Vec::new();
    let mut decoded = Vec::new();
    for _ in 0..WARM_UP + calls {
        let start = Instant::now();
        let output = network.run(1)?;
        run.push(start.elapsed());
        decode(&volume, &output.maps(0), &params)?;
        decoded.push(start.elapsed());
    }
    row("session.run", run);
    row("session.run + decode", decoded);

    let server = Server::run(&[model], &["--log", "warn"]);
    let client = server.client().await;
    for (name, dtype) in [("f32", DataType::F32), ("f16", DataType::F16), ("u8", DataType::U8)] {
        measure(&client, &volume, name, dtype, calls).await?;
    }
    Ok(())
}

/// Whole calls, and of each what is neither inference nor decoding.
async fn measure(
    client: &Client,
    volume: &grasp::Volume,
    name: &str,
    dtype: DataType,
    calls: usize,
) -> anyhow::Result<()> {
    let mut whole = Vec::new();
    let mut hop = Vec::new();
    let mut queue = Vec::new();
    let mut preprocessing = Vec::new();
    for _ in 0..WARM_UP + calls {
        let start = Instant::now();
        let detection = client.detect(volume, Options { dtype, ..Options::default() }).await?;
        let elapsed = start.elapsed();
        let Latency { inference, postprocessing, .. } = detection.latency;
        whole.push(elapsed);
        hop.push(elapsed.saturating_sub(Duration::from_secs_f64(inference + postprocessing)));
        queue.push(Duration::from_secs_f64(detection.latency.queue));
        preprocessing.push(Duration::from_secs_f64(detection.latency.preprocessing));
    }
    row(&format!("gRPC call, {name}"), whole);
    row("  of it outside the session", hop);
    row("  of that checking and widening", preprocessing);
    row("  of that in the queue", queue);
    Ok(())
}

fn row(name: &str, times: Vec<Duration>) {
    let mut times = times[WARM_UP..].to_vec();
    times.sort();
    let at = |percent: usize| times[(times.len() - 1) * percent / 100].as_secs_f64() * 1e6;
    let mean = times.iter().sum::<Duration>().as_secs_f64() / times.len() as f64 * 1e6;
    println!("{name:32} {:9.1} {:9.1} {:9.1} {mean:9.1}", at(50), at(90), at(99));
}
