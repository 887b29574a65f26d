//! Latency and throughput of the server, compared in one run with its parts and with other servers.
//!
//! `make bench-serve`, or `cargo run --release -p grasp-tests --example serve [SECONDS [FILE [PART…]]]` with
//! `ORT_DYLIB_PATH` set. `SECONDS` is the duration of each load, 5 by default. All results are also written to `FILE`, as
//! JSON. The parts are `hop`, `vgn`, `transformer`, `throughput`, `depth`, `overload`, `callers`, `refusals`,
//! `streams` and `start`; all by default.
//! `GRASP_TRAIN` names grasp-train, for libtorch's eager mode; `GRASPD_PEERS` names a Python with the packages of
//! tests/peers, for the other servers. Without a variable its part is left out.
//!
//! The last line is one JSON object with the main figures. Run it on an idle machine. Durations depend on the machine:
//! compare ratios.

mod conditions;
mod depth;
mod findings;
mod overload;
mod peers;
mod streams;
mod volume_file;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use grasp::{Volume, decode};
use grasp_client::{Arrivals, Client, DataType, LocalServer, Options, Report, Until, load};
use grasp_models::{Architecture, Network, Options as Running};
use grasp_tests::{Stolen, TestModel, blobs, graspd, peak_bytes};
use nalgebra::Isometry3;
use tempfile::TempDir;
use tonic::Code;

use crate::findings::{Aim, Findings, Table, milliseconds};
use crate::peers::{Peer, eager, openvino};

/// Calls of the identity network, which measure the cost of gRPC.
const HOPS: usize = 10_000;
/// Calls before each measurement.
const WARM_UP: usize = 20;
/// The rows are measured alternately, in this many turns, so that a slow minute affects all of them.
const TURNS: usize = 5;
/// Numbers of concurrent callers.
const CALLERS: [usize; 3] = [1, 8, 32];
/// Batch sizes. The best throughput of these is the capacity of the machine.
const BATCHES: [usize; 4] = [1, 2, 4, 8];
/// Targets. Those with libtorch are shares of the latency of its eager mode in fp32.
const AIMS: [(&str, Aim); 14] = [
    ("hop_p50_ms", Aim::AtMost(0.6)),
    ("hop_p99_ms", Aim::AtMost(1.5)),
    ("vgn_vs_torch", Aim::AtMost(1.0 / 12.0)),
    ("transformer_vs_torch", Aim::AtMost(1.0 / 5.5)),
    ("openvino_ratio", Aim::AtMost(1.15)),
    ("throughput_ratio", Aim::AtLeast(0.8)),
    ("table_p50_ms", Aim::AtMost(100.0)),
    ("track_p99_ms", Aim::AtMost(33.0)),
    ("vgn_overload_goodput", Aim::AtLeast(0.9)),
    ("vgn_deadline_goodput", Aim::AtLeast(0.85)),
    ("transformer_overload_goodput", Aim::AtLeast(0.9)),
    ("transformer_deadline_goodput", Aim::AtLeast(0.85)),
    ("burst_answered", Aim::AtLeast(95.0)),
    ("stream_ratio", Aim::AtLeast(0.95)),
];

#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    let seconds = std::env::args().nth(1).map_or(Ok(5.0), |seconds| seconds.parse())?;
    let bench = Bench::new(Duration::from_secs_f64(seconds))?;
    let mut findings = Findings::new(conditions::describe(bench.threads)?);
    let started = Stolen::so_far();
    let parts: Vec<String> = std::env::args().skip(3).collect();
    let is_wanted = |part: &str| parts.is_empty() || parts.iter().any(|wanted| wanted == part);
    if is_wanted("hop") {
        bench.hop(&mut findings).await?;
    }
    for network in ["vgn", "transformer"] {
        if is_wanted(network) {
            bench.latency(network, &mut findings).await?;
        }
    }
    if is_wanted("throughput") {
        bench.throughput(&mut findings).await?;
    }
    if is_wanted("depth") {
        bench.depth(&mut findings).await?;
    }
    if is_wanted("overload") {
        bench.overload(&mut findings).await?;
    }
    if is_wanted("callers") {
        bench.burst(&mut findings).await?;
        bench.fairness(&mut findings).await?;
    }
    if is_wanted("refusals") {
        bench.beside_inferences(&mut findings).await?;
    }
    if is_wanted("streams") {
        bench.streams(&mut findings).await?;
    }
    if is_wanted("start") {
        bench.start_up(&mut findings)?;
    }
    findings.compare(&AIMS);
    let stolen = started.percent_until(Stolen::so_far());
    println!("\nOther machines on the host took {stolen:.1} % of the processors' time.");
    findings.figure("stolen_percent", stolen);
    if let Some(file) = std::env::args_os().nth(2) {
        std::fs::write(&file, format!("{:#}\n", findings.json()))
            .with_context(|| format!("cannot write {}", file.display()))?;
    }
    println!("{}", findings.figures());
    Ok(())
}

struct Bench {
    threads: usize,
    seconds: Duration,
    folder: TempDir,
    scene: Arc<Volume>,
}

impl Bench {
    /// Makes a scene and a folder for each network.
    fn new(seconds: Duration) -> anyhow::Result<Self> {
        let threads = std::thread::available_parallelism()?.get();
        let folder = tempfile::tempdir()?;
        let models = |name: &str| -> anyhow::Result<PathBuf> {
            let models = folder.path().join(name);
            std::fs::create_dir(&models)?;
            Ok(models)
        };
        TestModel::new("mirror").resolution(grasp::RESOLUTION).write(&models("mirror")?);
        std::fs::copy(conditions::ZOO, models("vgn")?.join("vgn.onnx"))
            .with_context(|| format!("cannot copy {}", conditions::ZOO))?;
        // Random weights: the latency does not depend on the weights.
        let transformer = Architecture::Transformer.build(grasp::RESOLUTION, 0)?;
        transformer.write(&models("transformer")?.join("transformer.onnx"))?;
        let scene = Arc::new(conditions::scene(folder.path())?);
        Ok(Self { threads, seconds, folder, scene })
    }

    fn models(&self, network: &str) -> PathBuf {
        self.folder.path().join(network)
    }

    fn file(&self, network: &str) -> PathBuf {
        let name = if network == "mirror" { "mirror-1" } else { network };
        self.models(network).join(format!("{name}.onnx"))
    }

    /// graspd with its defaults and these flags.
    fn serve(&self, network: &str, flags: &[&str]) -> anyhow::Result<LocalServer> {
        let models = self.models(network);
        let fixed = ["--log".as_ref(), "warn".as_ref(), "--models".as_ref(), models.as_os_str()];
        Ok(LocalServer::spawn(graspd(), fixed.into_iter().chain(flags.iter().map(AsRef::as_ref)))?)
    }

    /// The latency that gRPC adds, measured with the identity network.
    async fn hop(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let mut network = Network::load(&self.file("mirror"), &Running::default())?;
        let server = self.serve("mirror", &["--provider", "cpu", "--threads", "1"])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let mut table = Table::new(&format!("identity network, {HOPS} calls, one at a time"), &["p50 ms", "p99 ms"]);
        // Two blocks give two grasps. In a real scene the identity network would have hundreds.
        let volume = Arc::new(blobs(grasp::RESOLUTION, Isometry3::identity(), &[[10, 20, 15], [30, 12, 25]]));
        network.fill(&[&volume])?;
        let run = times(HOPS, || network.run(1).map(drop))?;
        table.row("session.run", [0.5, 0.99].map(|share| milliseconds(Report::quantile(&run, share))));
        for (name, dtype) in [("f32", DataType::F32), ("f16", DataType::F16), ("u8", DataType::U8)] {
            let options = Options { dtype, ..Options::default() };
            let calls = calls(&client, &volume, Arrivals::Callers(1), Until::Calls(HOPS), options).await?;
            let hop = [0.5, 0.99].map(|share| {
                milliseconds(Report::quantile(&calls, share)) - milliseconds(Report::quantile(&run, share))
            });
            table.row(&format!("gRPC overhead, {name}"), hop);
            if dtype == DataType::F32 {
                findings.figure("hop_p50_ms", hop[0]);
                findings.figure("hop_p99_ms", hop[1]);
            }
        }
        findings.table(table);
        Ok(())
    }

    /// Latency of single calls, measured in turns: the session alone, the parts in this process, and over gRPC.
    /// Then the latency of libtorch and OpenVINO.
    async fn latency(&self, name: &str, findings: &mut Findings) -> anyhow::Result<()> {
        let mut network = Network::load(&self.file(name), &Running::auto(self.threads))?;
        let server = self.serve(name, &[])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let (backend, params) = (network.backend(), network.metadata().decode_params());
        let [mut bare, mut decoding, mut service, mut grpc] = [const { Vec::new() }; 4];
        network.fill(&[&self.scene])?;
        let probe = times(WARM_UP, || network.run(1).map(drop))?;
        let typical = Report::quantile(&probe, 0.5);
        let count = (self.seconds.as_secs_f64() / typical.as_secs_f64()).ceil() as usize / TURNS + 1;
        for _ in 0..TURNS {
            bare.extend(times(count, || network.run(1).map(drop))?);
            let output = network.infer(&[&self.scene])?;
            decoding.extend(times(count, || decode(&self.scene, &output.maps(0), &params).map(drop))?);
            service.extend(times(count, || {
                let output = network.infer(&[&self.scene])?;
                decode(&self.scene, &output.maps(0), &params)?;
                anyhow::Ok(())
            })?);
            let until = Until::Calls(count);
            grpc.extend(calls(&client, &self.scene, Arrivals::Callers(1), until, Options::default()).await?);
        }
        drop((server, network));

        let title = format!("{name}, {backend}, {} calls, one at a time", count * TURNS);
        let mut table = Table::new(&title, &["p50 ms", "p99 ms", "gRPC's p50 to it"]);
        let mut p50 = 0.0;
        let rows = [("gRPC", grpc), ("infer + decode", service), ("session.run", bare), ("decode", decoding)];
        for (row, mut times) in rows {
            times.sort_unstable();
            let [median, p99] = [0.5, 0.99].map(|share| milliseconds(Report::quantile(&times, share)));
            if row == "gRPC" {
                p50 = median;
            }
            table.row(row, [median, p99, p50 / median]);
        }
        if let Some(eager) = eager(&self.file(name), self.threads)? {
            table.row("libtorch, eager, fp32", [eager.p50_ms, f64::NAN, p50 / eager.p50_ms]);
            table.row(
                "  with separate heads, as published",
                [eager.published_p50_ms, f64::NAN, p50 / eager.published_p50_ms],
            );
            findings.figure(&format!("{name}_vs_torch"), p50 / eager.published_p50_ms);
        }
        if let Some(latency) = openvino(&self.file(name), self.threads, backend.precision, count * TURNS)? {
            let row = format!("OpenVINO {} alone, {}", latency.version, backend.precision);
            table.row(&row, [latency.p50_ms, latency.p99_ms, p50 / latency.p50_ms]);
            if name == "vgn" {
                findings.figure("openvino_ratio", p50 / latency.p50_ms);
            }
        }
        findings.figure(&format!("{name}_p50_ms"), p50);
        findings.table(table);
        Ok(())
    }

    /// Throughput with concurrent callers, compared with batches without a server and with other servers; then Poisson
    /// arrivals.
    async fn throughput(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let max_batch = BATCHES.into_iter().max().unwrap_or(1);
        let running = Running { max_batch, ..Running::auto(self.threads) };
        let mut network = Network::load(&self.file("vgn"), &running)?;
        let backend = network.backend();
        let servers =
            [self.serve("vgn", &["--queue", "64"])?, self.serve("vgn", &["--queue", "64", "--workers", "1"])?];
        let mut served = Vec::new();
        for (name, server) in ["graspd", "graspd, one session"].into_iter().zip(&servers) {
            let client = Client::connect(server.grpc().to_string()).await?;
            served.extend(CALLERS.map(|callers| (name, client.clone(), callers, Report::default())));
        }
        let turn = self.seconds / TURNS as u32;
        let mut bare = BATCHES.map(|_| Report::default());
        for _ in 0..TURNS {
            for (batch, report) in BATCHES.into_iter().zip(&mut bare) {
                network.fill(&vec![&*self.scene; batch])?;
                times(WARM_UP / batch, || network.run(batch).map(drop))?;
                let started = Instant::now();
                while started.elapsed() < turn {
                    report.answered.extend(times(1, || network.run(batch).map(drop))?);
                }
                report.elapsed += started.elapsed();
            }
            for (_, client, callers, report) in &mut served {
                let (arrivals, until) = (Arrivals::Callers(*callers), Until::Elapsed(turn));
                report.append(run_load(client, &self.scene, arrivals, until, Options::default()).await);
            }
        }
        drop((network, servers));

        let mut table = Table::new(&format!("vgn, {backend}, session.run in batches"), &["volumes/s", "p50 ms"]);
        let (mut best, mut bare_p50) = (0.0_f64, 0.0);
        for (batch, mut report) in BATCHES.into_iter().zip(bare) {
            report.answered.sort_unstable();
            let (volumes, p50) =
                (batch as f64 * report.throughput(), milliseconds(Report::quantile(&report.answered, 0.5)));
            table.row(&format!("{batch}"), [volumes, p50]);
            best = best.max(volumes);
            if batch == 1 {
                bare_p50 = p50;
            }
        }
        findings.table(table);

        let mut table = Table::new(
            &format!("vgn, {backend}, many callers, {:?} each", self.seconds),
            &["callers", "answers/s", "p50 ms", "p99 ms"],
        );
        let mut add_row = |server: &str, callers: usize, report: &Report| {
            let [p50, p99] = [0.5, 0.99].map(|share| milliseconds(Report::quantile(&report.answered, share)));
            table.row(server, [callers as f64, report.throughput(), p50, p99]);
            report.throughput()
        };
        let mut at_eight = Vec::new();
        for (name, _, callers, report) in &served {
            let throughput = add_row(name, *callers, report);
            ensure!(report.refusals() == 0, "{name} refused calls: {:?}", report.refused.keys());
            if *callers == 8 {
                at_eight.push(throughput);
            }
        }
        let capacity = at_eight[0];
        findings.figure("throughput_ratio", capacity / best);
        findings.figure("one_session_throughput_ratio", at_eight[1] / best);
        for kind in ["plain_grpc", "triton"] {
            let Some(peer) = Peer::run(kind, &self.file("vgn"), self.threads, backend)? else { continue };
            for callers in CALLERS {
                let report = peer.load(&self.scene, callers, self.until()).await?;
                let throughput = add_row(kind, callers, &report);
                ensure!(report.refusals() == 0, "{kind} refused calls: {:?}", report.refused.keys());
                if callers == 8 {
                    findings.figure(&format!("{kind}_ratio"), capacity / throughput);
                }
            }
        }
        findings.table(table);
        self.poisson(capacity, bare_p50, findings).await
    }

    /// The highest rate of Poisson arrivals (open loop) at which the p99 latency is at most that of three inferences.
    async fn poisson(&self, capacity: f64, bare_p50: f64, findings: &mut Findings) -> anyhow::Result<()> {
        let server = self.serve("vgn", &[])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let mut table = Table::new(
            "vgn, Poisson arrivals (open loop)",
            &["a second", "of capacity", "p50 ms", "p99 ms", "p99 to bare"],
        );
        let (mut good, mut bad) = (0.0, 1.0);
        for _ in 0..6 {
            let share = f64::midpoint(good, bad);
            let rate = share * capacity;
            let until = Until::Elapsed(2 * self.seconds);
            let report = run_load(&client, &self.scene, Arrivals::Rate(rate), until, Options::default()).await;
            let [p50, p99] = [0.5, 0.99].map(|share| milliseconds(Report::quantile(&report.answered, share)));
            table.row("", [rate, share, p50, p99, p99 / bare_p50]);
            if report.refusals() == 0 && p99 <= 3.0 * bare_p50 { good = share } else { bad = share }
        }
        findings.table(table);
        findings.figure("poisson_rate", good * capacity);
        findings.figure("poisson_share", good);
        Ok(())
    }

    /// Time until graspd is ready, and its peak memory.
    fn start_up(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let mut table = Table::new("graspd's start and memory", &["s to ready", "MB at most"]);
        for network in ["vgn", "transformer"] {
            let started = Instant::now();
            let server = self.serve(network, &[])?;
            let ready = started.elapsed().as_secs_f64();
            let peak = peak_bytes(server.id()) as f64 / 1e6;
            table.row(network, [ready, peak]);
            findings.figure(&format!("{network}_ready_s"), ready);
            findings.figure(&format!("{network}_peak_mb"), peak);
        }
        findings.table(table);
        Ok(())
    }

    fn until(&self) -> Until {
        Until::Elapsed(self.seconds)
    }
}

/// The sorted latencies of calls, none of which may be refused.
async fn calls(
    client: &Client,
    volume: &Arc<Volume>,
    arrivals: Arrivals,
    until: Until,
    options: Options,
) -> anyhow::Result<Vec<Duration>> {
    let report = run_load(client, volume, arrivals, until, options).await;
    ensure!(report.refusals() == 0, "graspd refused {} calls: {:?}", report.refusals(), report.refused.keys());
    Ok(report.answered)
}

/// Runs a load after a few calls as warm-up.
async fn run_load(client: &Client, volume: &Arc<Volume>, arrivals: Arrivals, until: Until, options: Options) -> Report {
    for _ in 0..WARM_UP {
        // Errors are ignored here, because they are counted in the load below.
        let _ = client.detect(volume, options.clone()).await;
    }
    let (client, volume) = (client.clone(), Arc::clone(volume));
    load(arrivals, until, move |_| {
        let (client, volume, options) = (client.clone(), Arc::clone(&volume), options.clone());
        async move {
            let detection = client.detect(&volume, options).await;
            detection.map(drop).map_err(|error| error.code().unwrap_or(Code::Unknown))
        }
    })
    .await
}

/// The sorted durations of `count` runs of `work`.
fn times<E>(count: usize, mut work: impl FnMut() -> Result<(), E>) -> Result<Vec<Duration>, E> {
    let mut times = Vec::with_capacity(count);
    for _ in 0..count {
        let started = Instant::now();
        work()?;
        times.push(started.elapsed());
    }
    times.sort_unstable();
    Ok(times)
}

/// A path relative to the folder of this crate.
fn relative(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}
