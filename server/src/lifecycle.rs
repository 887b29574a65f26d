//! Startup, serving and shutdown of the process.

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

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

/// Runs graspd with the configuration of the command line and the environment, until SIGTERM or SIGINT.
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
    // The log must outlive everything that writes to it.
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

/// How long the shutdown waits for tasks and sessions that are still running.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(2);

fn runtime(config: &Config) -> anyhow::Result<Runtime> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let builder = builder.worker_threads(config.io_threads).thread_name("grpc").enable_all();
    builder.build().context("cannot start the threads of the async runtime")
}

/// Starts the runtime's tasks, serves, and joins the session threads.
fn serve_until_stopped(config: &Config, runtime: Runtime, log: &Log, traces: &Traces) -> anyhow::Result<()> {
    let connections = allow_connections(config.max_connections);
    for name in Config::unknown_variables() {
        warn!(name, "unknown environment variable; see `graspd --help` for the known ones");
    }
    let metrics = Arc::new(Metrics::new(log.dropped.clone()));
    if let Some(tls) = &config.tls {
        tls.warn_of_expiry(SystemTime::now());
        metrics.certificate(tls.expiry);
    }
    let onnxruntime = grasp_models::init()?;
    info!(version = onnxruntime.version, library = %onnxruntime.library.display(), "ONNX Runtime loaded");
    let sessions = Arc::new(SessionThreads::default());
    let served = runtime.block_on(serve(config, connections, &metrics, &sessions));
    traces.finish();
    // Dropping the runtime's tasks drops the engines, which ends the sessions.
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    // ONNX Runtime may crash if the process exits during an inference.
    sessions.join(SHUTDOWN_TIMEOUT);
    served
}

/// Binds the listeners, loads the models, serves, and drains.
async fn serve(
    config: &Config,
    connections: usize,
    metrics: &Arc<Metrics>,
    sessions: &Arc<SessionThreads>,
) -> anyhow::Result<()> {
    let mut signals = Signals::new().context("cannot install a signal handler")?;
    let hangup = hangup().context("cannot install a signal handler")?;
    let grpc = config.listen.bind().await.with_context(|| format!("cannot listen on --listen {}", config.listen))?;
    let http =
        TcpListener::bind(config.http).await.with_context(|| format!("cannot listen on --http {}", config.http))?;
    announce(&format!("grpc listening on {}", grpc.address));
    announce(&format!("http listening on {}", http.local_addr()?));

    let readiness = Readiness::starting();
    let state = readiness.subscribe();
    let models = Arc::new(ModelRegistry::default());
    let recent = Arc::new(RecentRequests::new(config.recent));
    let pages = HttpState { metrics: Arc::clone(metrics), models: Arc::clone(&models), recent: Arc::clone(&recent) };
    let http = tokio::spawn(crate::http::serve(http, config.http_hosts.clone(), pages, state.clone()));
    let Config { tls, tokens, limits, max_tracked, track_timeout, queue, .. } = config;
    let calls = Calls::new(Arc::clone(metrics), recent, state.clone());
    let inference = InferenceRpc::new(Arc::clone(&models), calls.clone());
    let tracked_volumes = TrackedVolumes::new(*max_tracked, *track_timeout, metrics.tracked());
    let service = GraspRpc::new(Arc::clone(&models), calls, tracked_volumes, *queue);
    if let Some(tokens) = tokens {
        tokio::spawn(Arc::clone(tokens).watch(self::hangup().context("cannot install a signal handler")?));
    }
    let grpc_config = GrpcConfig {
        tls: tls.clone(),
        tokens: tokens.clone(),
        connections,
        receiving_bytes: config.max_receiving_bytes,
        limits: *limits,
    };
    let mut grpc =
        tokio::spawn(listener::serve(grpc, grpc_config, service, inference, Arc::clone(metrics), state.clone()));

    let folder = ModelFolder::new(config, models, Arc::clone(sessions), Arc::clone(metrics));
    let entries = config.store.entries().to_vec();
    let mut loading = tokio::task::spawn_blocking(move || folder.load(&entries, &state).map(|()| folder));
    let stopped = tokio::select! {
        loaded = &mut loading => {
            tokio::spawn(loaded.context("the thread that loads the models panicked")??.watch(hangup, config.watch));
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
        () = tokio::time::sleep(config.drain_timeout) => warn!("drain timeout: exiting with unfinished requests"),
        () = signals.next() => warn!("second signal: exiting immediately"),
    }
    http.abort();
    Ok(())
}

/// Raises the soft limit of open files, often 1024, to the hard limit. Returns the connection limit: `connections`, or
/// less if the limit of open files is too low.
fn allow_connections(connections: usize) -> usize {
    // Files that are not gRPC connections: models, listeners, the log, HTTP connections.
    const OTHERS: u64 = 64 + crate::http::CONNECTIONS as u64;
    let limit = getrlimit(Resource::Nofile);
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }) {
        warn!(%error, "cannot raise the limit of open files");
    }
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let possible = usize::try_from(files.saturating_sub(OTHERS)).unwrap_or(usize::MAX).max(1);
    if possible < connections {
        warn!(
            open_files = files,
            max_connections = connections,
            limit = possible,
            "the limit of open files is too low for --max-connections; raise it (ulimit -n)"
        );
    }
    connections.min(possible)
}

/// Prints a line for the parent process. Errors are ignored: stdout may be closed.
fn announce(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}
