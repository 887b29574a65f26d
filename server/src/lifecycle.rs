//! Startup, serving and shutdown of the process.

use std::io::Write;
use std::net::SocketAddr;
use std::num::NonZero;
use std::process::ExitCode;
use std::sync::Arc;
use std::thread::{self, available_parallelism};
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, watch};
use tracing::{error, info, warn};

use crate::config::Config;
use crate::http::HttpState;
use crate::readiness::Readiness;
use crate::rest::Rest;
use crate::rpc::call::Calls;
use crate::rpc::grasp_service::GraspRpc;
use crate::rpc::inference_service::InferenceRpc;
use crate::serving::registry::ModelRegistry;
use crate::serving::reload::ModelFolder;
use crate::serving::session_threads::SessionThreads;
use crate::serving::tracking::TrackedVolumes;
use crate::serving::turns::Turns;
use crate::signals::{Signals, hangup};
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::RecentRequests;
use crate::telemetry::recorder::Recorder;
use crate::telemetry::subscriber::{self, Log, Traces};
use crate::transport::address::Address;
use crate::transport::http_connections::HttpConfig;
use crate::transport::listener::{self, GrpcConfig};

/// Runs graspd with the configuration of the command line and the environment, until SIGTERM or SIGINT.
#[must_use]
pub fn run() -> ExitCode {
    // First, so that a signal at any later moment ends the process in the same way.
    let started = runtime().and_then(|runtime| {
        let _entered = runtime.enter();
        Ok((Signals::new().context("cannot install a signal handler")?, runtime))
    });
    let (signals, runtime) = match started {
        Ok(started) => started,
        Err(error) => return failed_to_start(&error),
    };
    let config = match Config::from_args() {
        Ok(config) => config,
        Err(errors) => {
            eprint!("{errors}");
            return ExitCode::from(2);
        }
    };
    // The log must outlive everything that writes to it.
    let (log, traces) = match subscriber::init(&config, &runtime) {
        Ok(started) => started,
        Err(error) => return failed_to_start(&error),
    };
    match serve_until_stopped(&config, runtime, signals, &log, &traces) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            error!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

/// An error before the log exists.
fn failed_to_start(error: &anyhow::Error) -> ExitCode {
    eprintln!("graspd: {error:#}");
    ExitCode::FAILURE
}

/// The CPUs available to the process.
fn processors() -> usize {
    available_parallelism().map_or(1, NonZero::get)
}

/// How long the shutdown waits for everything that is still running.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(2);

fn runtime() -> anyhow::Result<Runtime> {
    // A request takes 0.1 ms of their time. More than four would only take CPUs from the networks.
    let threads = processors().min(4);
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let builder = builder.worker_threads(threads).thread_name("grpc").enable_all();
    builder.build().context("cannot start the threads of the async runtime")
}

/// Starts the runtime's tasks, serves, and joins the session threads.
fn serve_until_stopped(
    config: &Config,
    runtime: Runtime,
    signals: Signals,
    log: &Log,
    traces: &Traces,
) -> anyhow::Result<()> {
    let listeners = 1 + u64::from(config.rest.is_some());
    let connections = allow_connections(config.max_connections, listeners);
    for name in Config::unknown_variables() {
        warn!(name, "unknown environment variable; see `graspd --help` for the known ones");
    }
    let metrics = Arc::new(Metrics::new(log.dropped.clone(), log.suppressed.clone()));
    if let Some(tls) = &config.tls {
        tls.warn_of_expiry(SystemTime::now());
        metrics.certificate(tls.expiry);
    }
    let is_remote = |address: SocketAddr| !address.ip().is_loopback();
    let is_reachable =
        matches!(config.listen, Address::Tcp(address) if is_remote(address)) || config.rest.is_some_and(is_remote);
    if config.tokens.is_some() && config.tls.is_none() && is_reachable {
        warn!("clients send their tokens in plain text, because --token-file is set without --tls-cert");
    }
    let onnxruntime = grasp_models::init()?;
    info!(version = onnxruntime.version, library = %onnxruntime.library.display(), "ONNX Runtime loaded");
    let sessions = Arc::new(SessionThreads::default());
    let (recorder, recording) = match &config.record {
        Some((folder, capacity)) => {
            let (recorder, thread) = Recorder::start(folder, *capacity, metrics.recordings())?;
            (recorder, Some(thread))
        }
        None => (Recorder::none(), None),
    };
    let served = runtime.block_on(serve(config, signals, connections, &metrics, &sessions, recorder));
    let until = Instant::now() + SHUTDOWN_TIMEOUT;
    traces.finish();
    // Dropping the runtime's tasks drops the engines, which ends the sessions.
    runtime.shutdown_timeout(until.saturating_duration_since(Instant::now()));
    // ONNX Runtime may crash if the process exits during an inference.
    sessions.join(until);
    if let Some(recording) = recording {
        while !recording.is_finished() && Instant::now() < until {
            thread::sleep(Duration::from_millis(1));
        }
    }
    served
}

/// Binds the listeners, loads the models, serves, and drains.
async fn serve(
    config: &Config,
    mut signals: Signals,
    connections: usize,
    metrics: &Arc<Metrics>,
    sessions: &Arc<SessionThreads>,
    recorder: Recorder,
) -> anyhow::Result<()> {
    let hangup = hangup().context("cannot install a signal handler")?;
    let grpc = config.listen.bind().await.with_context(|| format!("cannot listen on --listen {}", config.listen))?;
    let http =
        TcpListener::bind(config.http).await.with_context(|| format!("cannot listen on --http {}", config.http))?;
    let rest = match config.rest {
        None => None,
        Some(address) => {
            Some(TcpListener::bind(address).await.with_context(|| format!("cannot listen on --rest {address}"))?)
        }
    };
    announce(&format!("grpc listening on {}", grpc.address));
    announce(&format!("http listening on {}", http.local_addr()?));
    if let Some(rest) = &rest {
        announce(&format!("rest listening on {}", rest.local_addr()?));
    }

    let readiness = Readiness::starting();
    let state = readiness.subscribe();
    let models = Arc::new(ModelRegistry::default());
    let recent = Arc::new(RecentRequests::new(config.recent));
    let pages = HttpState::new(Arc::clone(metrics), Arc::clone(&models), Arc::clone(&recent));
    let Config { tls, tokens, limits, max_tracked, track_timeout, queue, .. } = config;
    let budget = metrics.receiving(config.max_receiving_bytes);
    let limit = metrics.connections("http", crate::http::CONNECTIONS);
    let http_config = HttpConfig { limit, tls: None, budget: Arc::clone(&budget) };
    let http = tokio::spawn(crate::http::serve(http, config.http_hosts.clone(), pages, http_config, state.clone()));
    let calls = Calls::new(Arc::clone(metrics), recent, state.clone(), tokens.clone());
    let (folder, control) =
        ModelFolder::new(config, Arc::clone(&models), Arc::clone(sessions), Arc::clone(metrics), state.clone());
    let loads = folder.loads();
    // Requests that are converted and fused, one for each CPU; as many as in the queue of a model may wait.
    let turns = Turns::new(processors(), *queue);
    let (requests, counted) = (calls.clone(), Arc::clone(metrics));
    let inference = InferenceRpc::new(Arc::clone(&models), requests, counted, control, Arc::clone(&turns));
    let tracked_volumes = TrackedVolumes::new(*max_tracked, *track_timeout, metrics.tracked());
    let at_once = config.workers * config.batching.max;
    let service = GraspRpc::new(Arc::clone(&models), calls, tracked_volumes, recorder, turns, *queue, at_once);
    let rest = rest.map(|listener| {
        let (tokens, limits, metrics) = (tokens.clone(), *limits, Arc::clone(metrics));
        let limit = metrics.connections("rest", connections);
        let conversions = Arc::new(Semaphore::new(processors()));
        let rest = Rest { inference: inference.clone(), tokens, limits, metrics, conversions };
        let tls = tls.as_ref().map(|tls| tls.http.clone());
        let config = HttpConfig { limit, tls, budget: Arc::clone(&budget) };
        tokio::spawn(crate::rest::serve(listener, rest, config, state.clone()))
    });
    if let Some(tokens) = tokens {
        tokio::spawn(Arc::clone(tokens).watch(self::hangup().context("cannot install a signal handler")?));
    }
    let grpc_config = GrpcConfig {
        tls: tls.clone(),
        tokens: tokens.clone(),
        connections,
        connection_age: config.max_connection_age,
        budget,
        limits: *limits,
    };
    let mut grpc =
        tokio::spawn(listener::serve(grpc, grpc_config, service, inference, Arc::clone(metrics), state.clone()));

    let (is_able, mut able) = watch::channel(true);
    let watch = Arc::clone(sessions).watch(Arc::clone(&models), config.inference_timeout, is_able);
    let watch = tokio::spawn(watch);
    let entries = config.store.entries().to_vec();
    let mut loading = tokio::task::spawn_blocking(move || folder.load(&entries).map(|()| folder));
    let loaded = tokio::select! {
        loaded = &mut loading => Some(loaded),
        () = signals.next() => None,
    };
    if let Some(folder) = loaded {
        tokio::spawn(folder.context("the thread that loads the models panicked")??.watch(hangup, config.watch));
        readiness.serving(true);
        announce("ready");
        loop {
            tokio::select! {
                () = signals.next() => break,
                ended = &mut grpc => return ended?.context("the gRPC listener failed"),
                Ok(()) = able.changed() => readiness.serving(*able.borrow_and_update()),
            }
        }
    }

    info!(timeout = ?config.drain_timeout, "draining");
    readiness.drain();
    let drained = async {
        let ended = grpc.await;
        if let Some(rest) = rest {
            let _ = rest.await;
        }
        // ONNX Runtime may crash if the process exits while a model is loaded. The models after it are not loaded.
        let _ = tokio::task::spawn_blocking(move || loads.wait()).await;
        ended
    };
    tokio::select! {
        ended = drained => { ended??; info!("drained") }
        () = tokio::time::sleep(config.drain_timeout) => warn!("drain timeout: exiting with unfinished requests"),
        () = signals.next() => warn!("second signal: exiting immediately"),
    }
    http.abort();
    watch.abort();
    Ok(())
}

/// Raises the soft limit of open files, often 1024, to the hard limit. Returns the connection limit of each of the
/// `listeners`: `connections`, or less if the limit of open files is too low.
fn allow_connections(connections: usize, listeners: u64) -> usize {
    // Files that are not gRPC connections: models, listeners, the log, HTTP connections.
    const OTHERS: u64 = 64 + crate::http::CONNECTIONS as u64;
    let limit = getrlimit(Resource::Nofile);
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }) {
        warn!(%error, "cannot raise the limit of open files");
    }
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let possible = usize::try_from(files.saturating_sub(OTHERS) / listeners).unwrap_or(usize::MAX).max(1);
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
