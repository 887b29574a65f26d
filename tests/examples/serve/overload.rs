//! More requests than the server can answer: with deadlines, in a burst, and from unequal callers.

use std::fs;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};
use grasp_client::{Access, Arrivals, Client, DetectOptions, Options, Report, Retry, Until};
use tonic::Code;

use crate::findings::{Findings, Table, milliseconds};
use crate::{Bench, run_load};

/// Arrivals relative to the capacity.
const OVERLOAD: f64 = 3.0;

/// Deadlines, in inferences: shorter than the wait in a full queue.
const DEADLINE: f64 = 6.0;

/// Concurrent calls that are all retried as recommended.
const BURST: usize = 100;

/// Pause between two refused requests.
const PAUSE: Duration = Duration::from_millis(5);

impl Bench {
    /// The share of the capacity that remains under overload, and how it is shared.
    pub async fn overload(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let mut table = Table::new(
            &format!("{OVERLOAD} times the capacity, {:?} each", 2 * self.seconds),
            &["capacity /s", "arrivals /s", "answers /s", "of capacity", "refused", "late"],
        );
        for network in ["vgn", "transformer"] {
            let server = self.serve(network, &[])?;
            let client = Client::connect(server.grpc().to_string()).await?;
            let until = Until::Elapsed(2 * self.seconds);
            let callers = Arrivals::Callers(8);
            let capacity =
                run_load(&client, &self.scene, callers, until.clone(), Options::default()).await.throughput();
            for timeout in [None, Some(Duration::from_secs_f64(DEADLINE / capacity))] {
                let options = Options { timeout, ..Options::default() };
                let arrivals = Arrivals::Rate(OVERLOAD * capacity);
                let report = run_load(&client, &self.scene, arrivals, until.clone(), options).await;
                let goodput = report.throughput();
                let kind =
                    timeout.map_or("without deadlines".to_owned(), |timeout| format!("deadlines of {timeout:.0?}"));
                let late = report.refused.get(&(Code::DeadlineExceeded as i32)).map_or(0, Vec::len);
                table.row(
                    &format!("{network}, {kind}"),
                    [
                        capacity,
                        OVERLOAD * capacity,
                        goodput,
                        goodput / capacity,
                        (report.refusals() - late) as f64,
                        late as f64,
                    ],
                );
                let kind = if timeout.is_some() { "deadline" } else { "overload" };
                findings.figure(&format!("{network}_{kind}_goodput"), goodput / capacity);
            }
        }
        findings.table(table);
        Ok(())
    }

    /// Requests that need no inference, while others keep all processors busy.
    pub async fn beside_inferences(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let server = self.serve("vgn", &[])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let (scene, address) = (Arc::clone(&self.scene), server.grpc().to_string());
        let until = Until::Elapsed(2 * self.seconds);
        // On a thread of its own: otherwise the refusals would wait for the other calls in this process.
        let load = std::thread::spawn(move || -> anyhow::Result<f64> {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
            runtime.block_on(async {
                let client = Client::connect(address).await?;
                Ok(run_load(&client, &scene, Arrivals::Callers(8), until, Options::default()).await.throughput())
            })
        });
        let detect = DetectOptions { model: "missing".to_owned(), ..DetectOptions::default() };
        let options = Options { detect, ..Options::default() };
        let mut times = Vec::new();
        while !load.is_finished() {
            let started = Instant::now();
            let refused = client.detect(&self.scene, options.clone()).await;
            times.push(started.elapsed());
            ensure!(refused.is_err(), "the model `missing` is served");
            tokio::time::sleep(PAUSE).await;
        }
        times.sort_unstable();
        let [p50, p99] = [0.5, 0.99].map(|share| milliseconds(Report::quantile(&times, share)));
        let columns = ["calls", "p50 ms", "p99 ms", "inferences/s"];
        let mut table = Table::new("vgn, refusals beside eight callers", &columns);
        let throughput = load.join().map_err(|_| anyhow!("the load panicked"))??;
        table.row("a model that does not exist", [times.len() as f64, p50, p99, throughput]);
        findings.figure("refusal_p50_ms", p50);
        findings.figure("refusal_p99_ms", p99);
        findings.figure("refusal_inferences", throughput);
        findings.table(table);
        Ok(())
    }

    /// Calls that start together and follow the hints of their refusals.
    pub async fn burst(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let mut table = Table::new(&format!("vgn, a burst of {BURST} calls"), &["answered"]);
        let server = self.serve("vgn", &[])?;
        let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
        let client = Client::connect_with(server.grpc().to_string(), access).await?;
        let report =
            run_load(&client, &self.scene, Arrivals::Callers(BURST), Until::Calls(BURST), Options::default()).await;
        table.row("with recommended retries", [report.answered.len() as f64]);
        findings.figure("burst_answered", report.answered.len() as f64);
        findings.table(table);
        Ok(())
    }

    /// A caller with 64 open calls beside one with a single call.
    pub async fn fairness(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let tokens = self.models("vgn").join("tokens");
        fs::write(&tokens, "many\nsingle\n")?;
        let server = self.serve("vgn", &["--token-file", tokens.to_str().context("a temporary path is UTF-8")?])?;
        let client = async |token: &str| -> anyhow::Result<Client> {
            let access = Access { token: Some(token.parse().map_err(anyhow::Error::msg)?), ..Access::default() };
            Ok(Client::connect_with(server.grpc().to_string(), access).await?)
        };
        let (many, single) = (client("many").await?, client("single").await?);
        let scene = Arc::clone(&self.scene);
        let until = || Until::Elapsed(self.seconds);
        let of_many = until();
        let flood =
            tokio::spawn(
                async move { run_load(&many, &scene, Arrivals::Callers(64), of_many, Options::default()).await },
            );
        let report = run_load(&single, &self.scene, Arrivals::Callers(1), until(), Options::default()).await;
        let others = flood.await?;
        let mut table = Table::new("vgn, two callers", &["calls", "answers/s", "refused"]);
        table.row("64 open calls", [64.0, others.throughput(), others.refusals() as f64]);
        table.row("one open call", [1.0, report.throughput(), report.refusals() as f64]);
        findings.figure("single_caller_share", report.throughput() / (report.throughput() + others.throughput()));
        findings.figure("single_caller_refused", report.refusals() as f64);
        findings.table(table);
        Ok(())
    }
}
