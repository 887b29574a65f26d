//! Latency and throughput of the server on a GPU, for batches of several sizes, beside the session without a server.
//!
//! `make bench-gpu`, or `gpu GRASPD SCENE SECONDS FILE MODEL…` with `ORT_DYLIB_PATH` set: the server's program, a volume
//! of `grasp-sim label --format processed` (.npz), the duration of each measurement, a file for all results as JSON, and
//! the files of the networks. `GRASPD_PROVIDER` names the execution provider, `cuda` by default. The program does not
//! need cargo, so that it can be copied to another machine.

#[path = "serve/findings.rs"]
mod findings;
#[path = "serve/volume_file.rs"]
mod volume_file;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use grasp::Volume;
use grasp_client::{Arrivals, Client, LocalServer, Options, Report, Until, load};
use grasp_models::{Network, Options as Running, Precision, Provider, init};
use tonic::Code;

use crate::findings::{Aim, Findings, Table, milliseconds};

/// Batch sizes; for the server the number of callers.
const BATCHES: [usize; 4] = [1, 4, 16, 64];
/// Runs and calls before each measurement.
const WARM_UP: usize = 20;
const AIMS: [(&str, Aim); 4] = [
    ("transformer_fp16_graph_1_callers_p50_ms", Aim::AtMost(3.0)),
    ("transformer_fp16_graph_64_callers_answers_per_second", Aim::AtLeast(1000.0)),
    ("transformer_fp16_graph_64_callers_p99_ms", Aim::AtMost(100.0)),
    ("vgn_fp32_graph_1_callers_p50_ms", Aim::AtMost(1.3)),
];

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    // Why a backend was rejected.
    tracing_subscriber::fmt().with_max_level(tracing_subscriber::filter::LevelFilter::WARN).init();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [graspd, scene, seconds, file, models @ ..] = arguments.as_slice() else {
        anyhow::bail!("usage: gpu GRASPD SCENE SECONDS FILE MODEL…")
    };
    let bench = Bench {
        graspd: PathBuf::from(graspd),
        scene: Arc::new(volume_file::read(Path::new(scene))?),
        provider: std::env::var("GRASPD_PROVIDER").map_or(Ok(Provider::Cuda), |name| name.parse())?,
        duration: Duration::from_secs_f64(seconds.parse()?),
    };
    let mut findings = Findings::new(conditions()?);
    for model in models.iter().map(Path::new) {
        for precision in [Precision::Fp16, Precision::Fp32] {
            for cuda_graphs in [true, false] {
                // A backend that is not available is a result.
                if let Err(error) = bench.measure(model, precision, cuda_graphs, &mut findings).await {
                    println!("\n{}, {precision}, CUDA graphs {cuda_graphs}: {error:#}", model.display());
                }
            }
        }
    }
    findings.compare(&AIMS);
    fs::write(file, format!("{:#}\n", findings.json())).with_context(|| format!("cannot write {file}"))?;
    println!("{}", findings.figures());
    Ok(())
}

struct Bench {
    graspd: PathBuf,
    scene: Arc<Volume>,
    provider: Provider,
    duration: Duration,
}

impl Bench {
    async fn measure(
        &self,
        model: &Path,
        precision: Precision,
        cuda_graphs: bool,
        findings: &mut Findings,
    ) -> anyhow::Result<()> {
        let name = model.file_stem().unwrap_or_default().to_string_lossy();
        let largest = BATCHES.into_iter().max().unwrap_or(1);
        let (provider, precision) = (Some(self.provider), Some(precision));
        let started = Instant::now();
        let running = Running { provider, precision, max_batch: largest, cuda_graphs, ..Running::default() };
        let mut network = Network::load(model, &running)?;
        let loaded = started.elapsed();
        ensure!(network.backend().cuda_graph == cuda_graphs, "CUDA graphs were rejected, see the log");
        let (backend, served) = (network.backend(), network.metadata().name.clone());
        let mut bare = Vec::new();
        for batch in BATCHES {
            bare.push(self.session(&mut network, batch)?);
        }
        drop(network);

        let folder = tempfile::tempdir()?;
        fs::copy(model, folder.path().join(format!("{name}.onnx")))?;
        let provider = self.provider.name();
        let precision = backend.precision.name();
        let largest = largest.to_string();
        let flags = ["--provider", provider, "--precision", precision, "--max-batch", &largest, "--queue", "256"];
        let flags = flags.into_iter().chain((!cuda_graphs).then_some("--no-cuda-graphs"));
        let models = ["--log".as_ref(), "warn".as_ref(), "--models".as_ref(), folder.path().as_os_str()];
        let server = LocalServer::spawn(&self.graspd, models.into_iter().chain(flags.map(AsRef::as_ref)))?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let listed =
            client.list_models().await?.into_iter().find(|listed| listed.name == served).context("the model")?;
        ensure!(
            (listed.provider.as_str(), listed.precision.as_str()) == (provider, precision),
            "the server runs {} {}",
            listed.provider,
            listed.precision
        );

        let title = format!("{name}, {backend}, loaded in {:.1} s, {:?} each", loaded.as_secs_f64(), self.duration);
        let columns =
            ["run p50 ms", "run p99 ms", "volumes/s", "gRPC p50 ms", "gRPC p99 ms", "answers/s", "ratio of rates"];
        let mut table = Table::new(&title, &columns);
        let kind = name.split('-').next().unwrap_or_default();
        for (batch, runs) in BATCHES.into_iter().zip(&bare) {
            let report = self.calls(&client, batch).await?;
            let [run_p50, run_p99] = quantiles(&runs.times);
            let [p50, p99] = quantiles(&report.answered);
            let (rate, answers) = (runs.volumes_per_second, report.throughput());
            table.row(&format!("{batch}"), [run_p50, run_p99, rate, p50, p99, answers, answers / rate]);
            let graph = if cuda_graphs { "graph" } else { "plain" };
            for (what, value) in [("p50_ms", p50), ("p99_ms", p99), ("answers_per_second", answers)] {
                findings.figure(&format!("{kind}_{precision}_{graph}_{batch}_callers_{what}"), value);
            }
        }
        findings.table(table);
        Ok(())
    }

    /// Runs of the session in this process.
    fn session(&self, network: &mut Network, batch: usize) -> anyhow::Result<Runs> {
        network.fill(&vec![&*self.scene; batch])?;
        for _ in 0..WARM_UP {
            network.run(batch)?;
        }
        let (started, mut times) = (Instant::now(), Vec::new());
        while started.elapsed() < self.duration {
            let run = Instant::now();
            network.run(batch)?;
            times.push(run.elapsed());
        }
        let volumes_per_second = (batch * times.len()) as f64 / started.elapsed().as_secs_f64();
        times.sort_unstable();
        Ok(Runs { times, volumes_per_second })
    }

    /// Calls of the server by this many callers, each with one request in flight. None may be refused.
    async fn calls(&self, client: &Client, callers: usize) -> anyhow::Result<Report> {
        let run = |until| {
            let (client, scene) = (client.clone(), Arc::clone(&self.scene));
            load(Arrivals::Callers(callers), until, move |_| {
                let (client, scene) = (client.clone(), Arc::clone(&scene));
                async move {
                    let detection = client.detect(&scene, Options::default()).await;
                    detection.map(drop).map_err(|error| error.code().unwrap_or(Code::Unknown))
                }
            })
        };
        run(Until::Calls(callers * WARM_UP)).await;
        let report = run(Until::Elapsed(self.duration)).await;
        ensure!(report.refusals() == 0, "graspd refused {} calls: {:?}", report.refusals(), report.refused.keys());
        Ok(report)
    }
}

struct Runs {
    /// Sorted.
    times: Vec<Duration>,
    volumes_per_second: f64,
}

fn quantiles(sorted: &[Duration]) -> [f64; 2] {
    [0.5, 0.99].map(|share| milliseconds(Report::quantile(sorted, share)))
}

/// The card, the CPU and ONNX Runtime.
fn conditions() -> anyhow::Result<String> {
    let query = ["--query-gpu=name,driver_version", "--format=csv,noheader"];
    let card = Command::new("nvidia-smi").args(query).output();
    let card =
        card.map_or_else(|_| "no card".to_owned(), |output| String::from_utf8_lossy(&output.stdout).trim().into());
    let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpu.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or("\t: an unknown CPU");
    let cores = std::thread::available_parallelism()?;
    let seconds = std::time::SystemTime::UNIX_EPOCH.elapsed()?.as_secs();
    Ok(format!(
        "{card}; {} × {cores}, callers on the same CPUs; ONNX Runtime {}; Unix time {seconds}",
        cpu.trim_start_matches(['\t', ':', ' ']),
        init()?.version
    ))
}
