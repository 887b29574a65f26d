//! From the command line to the end of the drain.

use std::io::Write;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tracing::{error, info, warn};

use crate::config::Config;
use crate::http::HttpState;
use crate::readiness::Readiness;
use crate::rpc::call::Calls;
use crate::rpc::grasp_service::GraspRpc;
use crate::rpc::inference_service::InferenceRpc;
use crate::serving::engine::SessionThreads;
use crate::serving::registry::ModelRegistry;
use crate::serving::reload::ModelFolder;
use crate::serving::tracking::TrackedVolumes;
use crate::signals::{Signals, hangup};
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::RecentRequests;
use crate::telemetry::subscriber::{self, Log, Traces};
use crate::transport::listener::{self, GrpcConfig};

/// Runs graspd as its command line says, until it is told to stop.
#[must_use]
pub fn run() -> ExitCode {
    let config = match Config::from_args() {
        Ok(config) => config,
        Err(errors) => {
            eprint!("{errors}");
            return ExitCode::from(2);
        }
    };
    let started = runtime(&config).and_then(|runtime| Ok((subscriber::init(&config, &runtime)?, runtime)));
    // The log outlives all that logs.
    let ((log, traces), runtime) = match started {
        Ok(started) => started,
        Err(error) => {
            eprintln!("graspd: {error:#}");
            return ExitCode::FAILURE;
        }
    };
    match serve_until_stopped(&config, runtime, &log, &traces) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            error!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

/// How long those are waited for who are still computing when the process ends.
const PATIENCE: Duration = Duration::from_secs(2);

/// The threads that move messages.
fn runtime(config: &Config) -> anyhow::Result<Runtime> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let builder = builder.worker_threads(config.io_threads).thread_name("grpc").enable_all();
    builder.build().context("cannot start the runtime's threads")
}

/// From the configuration to the last session dropped.
fn serve_until_stopped(config: &Config, runtime: Runtime, log: &Log, traces: &Traces) -> anyhow::Result<()> {
    let connections = allow_connections(config.max_connections);
    let onnxruntime = grasp_models::init()?;
    info!(version = onnxruntime.version, library = %onnxruntime.library.display(), "ONNX Runtime");

    let metrics = Arc::new(Metrics::new(log.dropped.clone()));
    let sessions = Arc::new(SessionThreads::default());
    let served = runtime.block_on(serve(config, connections, &metrics, &sessions));
    traces.finish();
    // With the runtime the last way to reach the sessions goes.
    runtime.shutdown_timeout(PATIENCE);
    // No session should still be inside ONNX Runtime when the process ends.
    sessions.join(PATIENCE);
    served
}

/// From binding the listeners to the end of the drain.
async fn serve(
    config: &Config,
    connections: usize,
    metrics: &Arc<Metrics>,
    sessions: &Arc<SessionThreads>,
) -> anyhow::Result<()> {
    let mut signals = Signals::new().context("cannot handle signals")?;
    let hangup = hangup().context("cannot handle signals")?;
    let grpc = bind(config.listen, "--listen").await?;
    let http = bind(config.http, "--http").await?;
    announce(&format!("grpc listening on {}", grpc.local_addr()?));
    announce(&format!("http listening on {}", http.local_addr()?));

    let readiness = Readiness::starting();
    let state = readiness.subscribe();
    let models = Arc::new(ModelRegistry::default());
    let recent = Arc::new(RecentRequests::new(config.recent));
    let pages = HttpState { metrics: Arc::clone(metrics), models: Arc::clone(&models), recent: Arc::clone(&recent) };
    let http = tokio::spawn(crate::http::serve(http, pages, state.clone()));
    let Config { tls, tokens, limits, max_tracked, track_timeout, queue, .. } = config;
    let calls = Calls::new(Arc::clone(metrics), recent, state.clone());
    let inference = InferenceRpc::new(Arc::clone(&models), calls.clone());
    let kept = TrackedVolumes::new(*max_tracked, *track_timeout, metrics.tracked());
    let service = GraspRpc::new(Arc::clone(&models), calls, kept, *queue);
    if let Some(tokens) = tokens {
        tokio::spawn(Arc::clone(tokens).watch(self::hangup().context("cannot handle signals")?));
    }
    let entrance = GrpcConfig { tls: tls.clone(), tokens: tokens.clone(), connections, limits: *limits };
    let mut grpc =
        tokio::spawn(listener::serve(grpc, entrance, service, inference, Arc::clone(metrics), state.clone()));

    let folder = ModelFolder::new(config, models, Arc::clone(sessions), Arc::clone(metrics));
    let entries = config.store.entries().to_vec();
    let mut loading = tokio::task::spawn_blocking(move || folder.load(&entries, &state).map(|()| folder));
    let stopped = tokio::select! {
        loaded = &mut loading => {
            tokio::spawn(loaded.context("loading the models panicked")??.watch(hangup, config.watch));
            false
        }
        () = signals.next() => true,
    };
    if !stopped {
        readiness.ready();
        announce("ready");
        tokio::select! {
            () = signals.next() => {}
            ended = &mut grpc => return ended?.context("the gRPC listener failed"),
        }
    }

    info!(timeout = ?config.drain_timeout, "draining");
    readiness.drain();
    tokio::select! {
        ended = &mut grpc => { ended??; info!("drained") }
        () = tokio::time::sleep(config.drain_timeout) => warn!("still busy after the drain timeout, leaving"),
        () = signals.next() => warn!("told twice, leaving"),
    }
    http.abort();
    Ok(())
}

async fn bind(address: SocketAddr, flag: &str) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address).await.with_context(|| format!("cannot listen on {flag} {address}"))
}

/// Raises the limit of open files as far as this process may: many systems give 1024 to who does not ask for more. Returns
/// how many connections may be open then.
fn allow_connections(connections: usize) -> usize {
    // Models, listeners and logs are files, too.
    const OTHERS: u64 = 64;
    let limit = getrlimit(Resource::Nofile);
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }) {
        warn!(%error, "the limit of open files stays as it is");
    }
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let most = usize::try_from(files.saturating_sub(OTHERS)).unwrap_or(usize::MAX).max(1);
    if most < connections {
        warn!(files, connections, most, "fewer files may be open than connections are allowed (--max-connections)");
    }
    connections.min(most)
}

/// Tells whoever started this process; it need not be listening.
fn announce(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}
