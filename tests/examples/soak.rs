//! Checks that throughput, latency and memory of the server are stable under overload and over time.
//!
//! `make soak`, or `cargo run --release -p grasp-tests --example soak [MINUTES]` with `ORT_DYLIB_PATH` set. First a
//! minute of Poisson arrivals at four times the capacity, then another with deadlines, then `MINUTES` (20 by default) at
//! 80 % of it. With two or more processors, the callers have one of their own, so that they take no time from the server. Each minute's
//! line includes the share of processor time that other machines on the host used. The last line is one JSON object.

use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

use anyhow::ensure;
use grasp_client::{Arrivals, DataType, LocalServer, Report, Until, load};
use grasp_proto::encode;
use grasp_proto::pb::DetectGraspsRequest;
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use grasp_tests::{Stolen, blobs, graspd};
use nalgebra::Isometry3;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde_json::json;
use tonic::Code;
use tonic::transport::Channel;

const ZOO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo");
const MINUTE: Duration = Duration::from_mins(1);
/// Duration of the measurement of the capacity.
const CAPACITY: Duration = Duration::from_secs(15);
/// Concurrent callers in that measurement.
const CALLERS: usize = 4;
/// Rate of the overload, as a multiple of the capacity.
const OVERLOAD: f64 = 4.0;
/// Deadline of the calls in the second minute, in inferences.
const DEADLINE: f64 = 6.0;
/// Rate of the soak, as a share of the capacity.
const SOAK: f64 = 0.8;

#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    ensure!(!cfg!(debug_assertions), "a debug build cannot be measured: build it with --release");
    let minutes: u32 = std::env::args().nth(1).map_or(Ok(20), |minutes| minutes.parse())?;
    let (ours, servers) = processors()?;
    // A process inherits the CPU affinity of its parent.
    sched_setaffinity(None, &servers)?;
    let server = LocalServer::spawn(graspd(), ["--models", ZOO, "--log", "error"])?;
    sched_setaffinity(None, &ours)?;
    println!("the server has {} processors, its callers {}", servers.count(), ours.count());
    let volume = blobs(grasp::RESOLUTION, Isometry3::identity(), &[[10, 20, 15], [30, 12, 25]]);
    let volume = Some(encode(&volume, DataType::F32, ""));
    let caller = Caller {
        client: GraspServiceClient::connect(format!("http://{}", server.grpc())).await?,
        request: DetectGraspsRequest { volume, ..DetectGraspsRequest::default() },
    };
    caller.load(Arrivals::Callers(1), Duration::from_secs(2), None).await;
    let capacity = caller.load(Arrivals::Callers(CALLERS), CAPACITY, None).await.throughput();
    println!("capacity: {capacity:.1} answers a second to {CALLERS} callers, in {CAPACITY:?}");

    let before = Use::new(&server)?;
    let report = caller.load(Arrivals::Rate(OVERLOAD * capacity), MINUTE, None).await;
    let after = Use::new(&server)?;
    let only_overload = report.refused.keys().all(|&code| code == i32::from(Code::ResourceExhausted));
    ensure!(only_overload, "refusals with other codes than RESOURCE_EXHAUSTED: {:?}", report.refused.keys());
    let refused = report.refused.values().next().map_or(&[][..], Vec::as_slice);
    let goodput = report.throughput() / capacity;
    let [refusal_p50, refusal_p99] = [0.5, 0.99].map(|share| Report::quantile(refused, share).as_secs_f64() * 1e3);
    println!(
        "{OVERLOAD} × that for {MINUTE:?}: {} answered, {:.1} % of capacity; {} refused, in {refusal_p50:.2} ms (p50), \
         {refusal_p99:.2} ms (p99); memory {:.1} MB before, {:.1} MB after",
        report.answered.len(),
        100.0 * goodput,
        refused.len(),
        before.megabytes,
        after.megabytes
    );

    let deadline = Duration::from_secs_f64(DEADLINE / capacity);
    let report = caller.load(Arrivals::Rate(OVERLOAD * capacity), MINUTE, Some(deadline)).await;
    let known = [Code::ResourceExhausted, Code::DeadlineExceeded].map(i32::from);
    let only_known = report.refused.keys().all(|code| known.contains(code));
    ensure!(only_known, "other codes than RESOURCE_EXHAUSTED and DEADLINE_EXCEEDED: {:?}", report.refused.keys());
    let late = report.refused.get(&known[1]).map_or(0, Vec::len);
    let deadline_goodput = report.throughput() / capacity;
    println!(
        "the same with deadlines of {deadline:.0?}: {} answered, {:.1} % of capacity; {} refused, {late} late; memory \
         {:.1} MB after",
        report.answered.len(),
        100.0 * deadline_goodput,
        report.refusals() - late,
        Use::new(&server)?.megabytes
    );

    println!(
        "\n{:.1} a second for {minutes} minutes\nminute   answered  refused  p50 ms  p99 ms      MB  files  stolen %",
        SOAK * capacity
    );
    let (mut course, mut refusals) = (Vec::new(), 0);
    let started = Stolen::so_far();
    for minute in 1..=minutes {
        let stolen = Stolen::so_far();
        let report = caller.load(Arrivals::Rate(SOAK * capacity), MINUTE, None).await;
        refusals += report.refusals();
        let [p50, p99] = [0.5, 0.99].map(|share| Report::quantile(&report.answered, share).as_secs_f64() * 1e3);
        let used = Use::new(&server)?;
        println!(
            "{minute:6} {:10} {:8} {p50:7.2} {p99:7.2} {:7.1} {:6} {:9.1}",
            report.answered.len(),
            report.refusals(),
            used.megabytes,
            used.files,
            stolen.percent_until(Stolen::so_far())
        );
        course.push((p99, used));
    }
    let (Some((first_p99, first)), Some((last_p99, last))) = (course.first(), course.last()) else { return Ok(()) };
    let figures = json!({
        "capacity_per_s": capacity,
        "goodput_ratio": goodput,
        "deadline_goodput_ratio": deadline_goodput,
        "refusal_p99_ms": refusal_p99,
        "overload_memory_growth": after.megabytes / before.megabytes - 1.0,
        "soak_refusals": refusals,
        "p99_last_to_first": last_p99 / first_p99,
        "memory_growth": last.megabytes / first.megabytes - 1.0,
        "files_first": first.files,
        "files_last": last.files,
        "stolen_percent": started.percent_until(Stolen::so_far()),
    });
    println!("{figures}");
    Ok(())
}

/// The last processor for the callers, and the others for the server. A single processor is shared.
fn processors() -> io::Result<(CpuSet, CpuSet)> {
    let mut servers = sched_getaffinity(None)?;
    let last = (0..CpuSet::MAX_CPU).rev().find(|&processor| servers.is_set(processor));
    let mut ours = CpuSet::new();
    if let Some(last) = last.filter(|_| servers.count() > 1) {
        ours.set(last);
        servers.unset(last);
    } else {
        ours = servers;
    }
    Ok((ours, servers))
}

/// A client with a request that is encoded once.
struct Caller {
    client: GraspServiceClient<Channel>,
    request: DetectGraspsRequest,
}

impl Caller {
    /// A load whose calls have this deadline.
    async fn load(&self, arrivals: Arrivals, duration: Duration, deadline: Option<Duration>) -> Report {
        let (client, request) = (self.client.clone(), self.request.clone());
        load(arrivals, Until::Elapsed(duration), move |_| {
            let (mut client, request) = (client.clone(), request.clone());
            async move {
                let mut request = tonic::Request::new(request);
                if let Some(deadline) = deadline {
                    request.set_timeout(deadline);
                }
                client.detect_grasps(request).await.map(drop).map_err(|status| match status.code() {
                    // What the client's own timer reports, if the server's status has not arrived yet.
                    Code::Cancelled => Code::DeadlineExceeded,
                    code => code,
                })
            }
        })
        .await
    }
}

/// Resources that a process uses.
struct Use {
    megabytes: f64,
    files: usize,
}

impl Use {
    fn new(server: &LocalServer) -> anyhow::Result<Self> {
        let process = format!("/proc/{}", server.id());
        let files = fs::read_dir(Path::new(&process).join("fd"))?.count();
        Ok(Self { megabytes: grasp_tests::resident_bytes(server.id()) as f64 / 1e6, files })
    }
}
