//! Startup, serving and shutdown of the process.

use std::io::Write;
use std::net::SocketAddr;
use std::num::NonZero;
use std::process::ExitCode;
use std::sync::Arc;
use std::thread::{self, available_parallelism};
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use grasp_engine::{
    FairSemaphore, Loads, ModelControl, ModelFolder, ModelRegistry, ModelSettings, Observer, SessionThreads,
};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};

use crate::api::call::Calls;
use crate::api::grasp::GraspApi;
use crate::api::inference::InferenceApi;
use crate::api::rest::{self, Rest};
use crate::config::Config;
use crate::http::HttpState;
use crate::open_streams::OpenStreams;
use crate::readiness::Readiness;
use crate::signals::{Signals, hangup};
use crate::telemetry::metrics::Metrics;
use crate::telemetry::recent::RecentRequests;
use crate::telemetry::recorder::Recorder;
use crate::telemetry::subscriber::{self, Log, Traces};
use crate::tracked_volumes::TrackedVolumes;
use crate::transport::address::{Address, Listener};
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
    let metrics = Arc::new(Metrics::new(log.dropped.clone(), log.suppressed.clone()));
    warn_about(config, &metrics);
    let onnxruntime = grasp_models::init()?;
    info!(version = onnxruntime.version, library = %onnxruntime.library.display(), "ONNX Runtime loaded");
    let (recorder, recording) = match &config.record {
        Some((folder, capacity)) => {
            let (recorder, thread) = Recorder::start(folder, *capacity, metrics.recordings())?;
            (recorder, Some(thread))
        }
        None => (Recorder::none(), None),
    };
    let threads = Arc::new(SessionThreads::default());
    let process = Process {
        config,
        connections: allow_connections(config.max_connections, 1 + u64::from(config.rest.is_some())),
        metrics,
        models: Arc::default(),
        threads: Arc::clone(&threads),
        readiness: Readiness::starting(),
        stopping: CancellationToken::new(),
    };
    let served = runtime.block_on(process.run(signals, recorder));
    let until = Instant::now() + SHUTDOWN_TIMEOUT;
    traces.finish();
    // Dropping the runtime's tasks drops the models, which ends the sessions.
    runtime.shutdown_timeout(until.saturating_duration_since(Instant::now()));
    // ONNX Runtime may crash if the process exits during an inference.
    threads.join(until);
    if let Some(recording) = recording {
        while !recording.is_finished() && Instant::now() < until {
            thread::sleep(Duration::from_millis(1));
        }
    }
    served
}

/// Warns about settings that work, but not as the operator may expect.
fn warn_about(config: &Config, metrics: &Metrics) {
    for name in Config::unknown_variables() {
        warn!(name, "unknown environment variable; see `graspd --help` for the known ones");
    }
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
}

/// The bound listeners.
struct Listeners {
    grpc: Listener,
    http: TcpListener,
    rest: Option<TcpListener>,
}

impl Listeners {
    /// Binds them and announces their addresses.
    async fn bind(config: &Config) -> anyhow::Result<Self> {
        let grpc =
            config.listen.bind().await.with_context(|| format!("cannot listen on --listen {}", config.listen))?;
        let http = async |flag: &str, address: SocketAddr| {
            TcpListener::bind(address).await.with_context(|| format!("cannot listen on {flag} {address}"))
        };
        let rest = match config.rest {
            Some(address) => Some(http("--rest", address).await?),
            None => None,
        };
        let http = http("--http", config.http).await?;
        announce(&format!("grpc listening on {}", grpc.address));
        announce(&format!("http listening on {}", http.local_addr()?));
        if let Some(rest) = &rest {
            announce(&format!("rest listening on {}", rest.local_addr()?));
        }
        Ok(Self { grpc, http, rest })
    }
}

/// What the process holds from its start to its end.
struct Process<'a> {
    config: &'a Config,
    /// Maximum number of connections of a listener.
    connections: usize,
    metrics: Arc<Metrics>,
    models: Arc<ModelRegistry>,
    threads: Arc<SessionThreads>,
    readiness: Readiness,
    /// Cancelled when no further model is to be loaded.
    stopping: CancellationToken,
}

/// The tasks that serve the listeners.
struct Serving {
    grpc: JoinHandle<anyhow::Result<()>>,
    http: JoinHandle<()>,
    rest: Option<JoinHandle<()>>,
}

impl Process<'_> {
    /// Serves until a signal arrives, then drains.
    async fn run(self, mut signals: Signals, recorder: Recorder) -> anyhow::Result<()> {
        let reload = hangup().context("cannot install a signal handler")?;
        let listeners = Listeners::bind(self.config).await?;
        let observer = Arc::clone(&self.metrics) as Arc<dyn Observer>;
        let (models, threads) = (Arc::clone(&self.models), Arc::clone(&self.threads));
        let folder = self.config.folder.clone();
        let (folder, control) = ModelFolder::new(folder, models, threads, observer, self.stopping.clone());
        let loads = folder.loads();
        let mut serving = self.serve(listeners, control, recorder)?;
        let (watch, mut healthy) = self.watch();
        let entries = self.config.store.entries().to_vec();
        let mut loading = tokio::task::spawn_blocking(move || folder.load(&entries).map(|()| folder));
        let loaded = tokio::select! {
            loaded = &mut loading => Some(loaded),
            () = signals.next() => None,
        };
        if let Some(folder) = loaded {
            let folder = folder.context("the thread that loads the models panicked")??;
            tokio::spawn(folder.watch(reload, self.config.watch));
            self.readiness.serving(true);
            announce("ready");
            loop {
                tokio::select! {
                    () = signals.next() => break,
                    ended = &mut serving.grpc => return ended?.context("the gRPC listener failed"),
                    Ok(()) = healthy.changed() => self.readiness.serving(*healthy.borrow_and_update()),
                }
            }
        }
        self.drain(serving, loads, signals).await?;
        watch.abort();
        Ok(())
    }

    /// Starts to serve all listeners. Until the models are loaded, requests are refused.
    fn serve(&self, listeners: Listeners, control: ModelControl, recorder: Recorder) -> anyhow::Result<Serving> {
        let Self { config, metrics, models, readiness, .. } = self;
        let state = readiness.subscribe();
        let recent = Arc::new(RecentRequests::new(config.recent));
        let budget = metrics.receiving(config.max_receiving_bytes);
        let http_config = |name: &str, connections: usize, tls: Option<TlsAcceptor>| HttpConfig {
            limit: metrics.connections(name, connections),
            tls,
            budget: Arc::clone(&budget),
        };
        let pages = HttpState::new(Arc::clone(metrics), Arc::clone(models), Arc::clone(&recent));
        let of_pages = http_config("http", crate::http::CONNECTIONS, None);
        let hosts = config.http_hosts.clone();
        let http = tokio::spawn(crate::http::serve(listeners.http, hosts, pages, of_pages, state.clone()));

        let ModelSettings { options, capacity, batching } = config.folder.models;
        let calls = Calls::new(Arc::clone(metrics), recent, state.clone(), config.tokens.clone());
        // Requests that are converted and fused, one for each CPU; as many as in the queue of a model may wait.
        let conversions = FairSemaphore::new(processors(), capacity);
        let inference = InferenceApi::new(Arc::clone(models), calls.clone(), control, conversions.clone());
        let tracked_volumes = TrackedVolumes::new(config.max_tracked, config.track_timeout, metrics.tracked());
        let grasps = GraspApi {
            models: Arc::clone(models),
            calls,
            tracked_volumes: Arc::new(tracked_volumes),
            recorder,
            streams: OpenStreams::default(),
            stall: config.limits.stall,
            // A stream keeps the sessions busy, of which a model has at most two by default, but never fills a queue.
            read_ahead: (options.sessions.unwrap_or(2) * batching.max).min(capacity / 2).max(1),
            conversions,
        };
        let rest = listeners.rest.map(|listener| {
            let rest = Rest {
                grasps: grasps.clone(),
                inference: inference.clone(),
                tokens: config.tokens.clone(),
                limits: config.limits,
                metrics: Arc::clone(metrics),
                conversions: Arc::new(Semaphore::new(processors())),
                waiting: Arc::new(Semaphore::new(capacity)),
            };
            let tls = config.tls.as_ref().map(|tls| tls.http.clone());
            let of_rest = http_config("rest", self.connections, tls);
            tokio::spawn(rest::serve(listener, rest, of_rest, state.clone()))
        });
        if let Some(tokens) = &config.tokens {
            tokio::spawn(Arc::clone(tokens).watch(hangup().context("cannot install a signal handler")?));
        }
        let grpc_config = GrpcConfig {
            tls: config.tls.clone(),
            tokens: config.tokens.clone(),
            connections: self.connections,
            connection_age: config.max_connection_age,
            budget,
            limits: config.limits,
        };
        let grpc = listener::serve(listeners.grpc, grpc_config, grasps, inference, Arc::clone(metrics), state);
        Ok(Serving { grpc: tokio::spawn(grpc), http, rest })
    }

    /// Watches the sessions. The receiver holds whether each model has a healthy one.
    fn watch(&self) -> (JoinHandle<()>, watch::Receiver<bool>) {
        let (sender, healthy) = watch::channel(true);
        let models = Arc::clone(&self.models);
        let are_healthy = move || models.now().iter().all(|model| model.is_healthy());
        let threads = Arc::clone(&self.threads);
        (tokio::spawn(threads.watch(are_healthy, self.config.inference_timeout, sender)), healthy)
    }

    /// Finishes the accepted requests, at most until the drain timeout or a second signal.
    async fn drain(self, serving: Serving, loads: Loads, mut signals: Signals) -> anyhow::Result<()> {
        info!(timeout = ?self.config.drain_timeout, "draining");
        self.stopping.cancel();
        self.readiness.drain();
        let Serving { grpc, http, rest } = serving;
        let drained = async {
            let ended = grpc.await;
            if let Some(rest) = rest {
                let _ = rest.await;
            }
            // ONNX Runtime may crash if the process exits while a model is loaded. No further models are loaded.
            let _ = tokio::task::spawn_blocking(move || loads.wait()).await;
            ended
        };
        tokio::select! {
            ended = drained => { ended??; info!("drained") }
            () = tokio::time::sleep(self.config.drain_timeout) => {
                warn!("drain timeout: exiting with unfinished requests");
            }
            () = signals.next() => warn!("second signal: exiting immediately"),
        }
        http.abort();
        Ok(())
    }
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
