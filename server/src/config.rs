use std::fmt::{self, Display};
use std::fs;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::Duration;

use clap::Parser;
use grasp_models::{Choice, Precision, Provider, Store};
use tonic::transport::{Certificate, Identity, ServerTlsConfig};
use tracing_subscriber::EnvFilter;

use crate::serving::queue::Batching;
use crate::serving::reload::{Stamps, stamps};
use crate::transport::request_body::Limits;
use crate::transport::tokens::Tokens;

/// The validated configuration.
pub(crate) struct Config {
    pub store: Store,
    /// Taken before the store's files were read.
    pub stamps: Stamps,
    pub default_model: Option<String>,
    pub listen: SocketAddr,
    pub http: SocketAddr,
    /// Sessions per model.
    pub workers: usize,
    /// Threads per session.
    pub threads: usize,
    /// Execution provider; None selects the fastest that the machine supports.
    pub provider: Option<Provider>,
    /// Numeric precision; None selects the fastest.
    pub precision: Option<Precision>,
    /// Threads of the async runtime.
    pub io_threads: usize,
    /// Queued requests per model.
    pub queue: usize,
    pub batching: Batching,
    /// Interval at which the model folder is polled; None disables polling.
    pub watch: Option<Duration>,
    /// The server's certificate, and the CA of client certificates.
    pub tls: Option<ServerTlsConfig>,
    pub tokens: Option<Arc<Tokens>>,
    pub max_connections: usize,
    pub limits: Limits,
    /// Concurrent TrackGrasps streams, each with one volume.
    pub max_tracked: usize,
    /// Time without a request after which a TrackGrasps stream ends.
    pub track_timeout: Duration,
    /// Requests that the page shows; 0 disables the page.
    pub recent: usize,
    pub drain_timeout: Duration,
    /// URL of the OpenTelemetry collector.
    pub otlp: Option<String>,
    pub log: String,
    pub log_format: LogFormat,
}

/// Default of `--recent`; the volumes of that many requests take 5 MB.
const RECENT: usize = 20;

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum LogFormat {
    Text,
    Json,
}

/// Detects 6-DoF grasps in depth images, point clouds and TSDF volumes, over gRPC.
///
/// Each flag can also be set by an environment variable. ORT_DYLIB_PATH is the path of ONNX Runtime's shared library.
//
// Flags are parsed as text and validated together, so that one run reports every invalid value.
#[derive(Parser)]
#[command(name = "graspd", version, max_term_width = 100)]
struct Flags {
    /// Model folder. All .onnx files in it are served.
    #[arg(long, env = "GRASPD_MODELS", value_name = "DIR")]
    models: Option<PathBuf>,

    /// Model for requests that name no model, if it accepts their resolution. If not set, the file `default` in the
    /// model folder names it; without that file it is the first network by name.
    #[arg(long, env = "GRASPD_DEFAULT_MODEL", value_name = "NAME")]
    default_model: Option<String>,

    /// Address of the gRPC listener. Port 0 selects a free port, which is printed to stdout.
    #[arg(long, env = "GRASPD_LISTEN", value_name = "ADDR", default_value = "127.0.0.1:50051")]
    listen: String,

    /// Address of the HTTP listener: /metrics (Prometheus), /healthz, /readyz and the web page at /.
    #[arg(long, env = "GRASPD_HTTP", value_name = "ADDR", default_value = "127.0.0.1:9090")]
    http: String,

    /// Sessions per model. Each session processes one batch at a time.
    #[arg(long, env = "GRASPD_WORKERS", value_name = "N", default_value = "1")]
    workers: String,

    /// Threads per session. Default: the CPUs available to the process divided by --workers.
    #[arg(long, env = "GRASPD_THREADS", value_name = "N")]
    threads: Option<String>,

    /// Execution provider of ONNX Runtime: cpu, openvino, cuda, tensorrt or auto. auto selects the fastest provider
    /// that is available and whose outputs match those of cpu in fp32. A named provider that is not available is an
    /// error.
    #[arg(long, env = "GRASPD_PROVIDER", value_name = "NAME", default_value = "auto")]
    provider: String,

    /// Numeric precision: fp32, bf16, fp16, int8 or auto. auto selects the fastest. A named precision that is not
    /// available is an error.
    #[arg(long, env = "GRASPD_PRECISION", value_name = "NAME", default_value = "auto")]
    precision: String,

    /// Queue length per model, requests. If the queue is full, requests are refused immediately.
    #[arg(long, env = "GRASPD_QUEUE", value_name = "N", default_value = "32")]
    queue: String,

    /// Maximum batch size, volumes. Values above 1 raise the throughput on a GPU. On a CPU they only raise the latency.
    #[arg(long, env = "GRASPD_MAX_BATCH", value_name = "N", default_value = "1")]
    max_batch: String,

    /// Maximum time that a session waits for a batch to fill, from the arrival of its first volume, milliseconds. 0
    /// disables waiting.
    #[arg(long, env = "GRASPD_BATCH_DELAY", value_name = "MS", default_value = "0", allow_negative_numbers = true)]
    batch_delay: String,

    /// Interval at which the model folder is polled for changes, seconds. Changed models are loaded and warmed up in
    /// the background, then replace the old ones. 0 disables polling. SIGHUP always reloads the folder.
    #[arg(long, env = "GRASPD_WATCH", value_name = "SECONDS", default_value = "2", allow_negative_numbers = true)]
    watch: String,

    /// Certificate chain of the gRPC listener, PEM. Enables TLS; plaintext connections are then refused.
    #[arg(long, env = "GRASPD_TLS_CERT", value_name = "FILE")]
    tls_cert: Option<PathBuf>,

    /// Private key of the certificate, PEM.
    #[arg(long, env = "GRASPD_TLS_KEY", value_name = "FILE")]
    tls_key: Option<PathBuf>,

    /// CA certificates, PEM. Clients must present a certificate that one of them has signed (mutual TLS).
    #[arg(long, env = "GRASPD_TLS_CLIENT_CA", value_name = "FILE")]
    tls_client_ca: Option<PathBuf>,

    /// File of access tokens, one per line. Requests must have the header `authorization: Bearer TOKEN` with one of
    /// them. SIGHUP reloads the file. Health checks need no token.
    #[arg(long, env = "GRASPD_TOKEN_FILE", value_name = "FILE")]
    token_file: Option<PathBuf>,

    /// Maximum number of open connections. Further connections are closed immediately.
    #[arg(long, env = "GRASPD_MAX_CONNECTIONS", value_name = "N", default_value = "16384")]
    max_connections: String,

    /// Maximum number of concurrent TrackGrasps streams, each with one volume. Further streams are refused.
    #[arg(long, env = "GRASPD_MAX_TRACKED", value_name = "N", default_value = "64")]
    max_tracked: String,

    /// Time without a request after which a TrackGrasps stream ends and its volume is dropped, seconds.
    #[arg(
        long,
        env = "GRASPD_TRACK_TIMEOUT",
        value_name = "SECONDS",
        default_value = "60",
        allow_negative_numbers = true
    )]
    track_timeout: String,

    /// Number of latest requests shown on the web page of the HTTP listener, with their scenes. 0 disables the page.
    /// Default: 20, or 0 with --token-file, because the page needs no token.
    #[arg(long, env = "GRASPD_RECENT", value_name = "N")]
    recent: Option<String>,

    /// Maximum pause within a message, seconds. After it the request is refused.
    #[arg(
        long,
        env = "GRASPD_STALL_TIMEOUT",
        value_name = "SECONDS",
        default_value = "10",
        allow_negative_numbers = true
    )]
    stall_timeout: String,

    /// Maximum message size, bytes.
    #[arg(long, env = "GRASPD_MAX_MESSAGE_BYTES", value_name = "N", default_value = "16777216")]
    max_message_bytes: String,

    /// Time that accepted requests have to finish after SIGTERM, seconds.
    #[arg(
        long,
        env = "GRASPD_DRAIN_TIMEOUT",
        value_name = "SECONDS",
        default_value = "20",
        allow_negative_numbers = true
    )]
    drain_timeout: String,

    /// OpenTelemetry collector that receives a trace of each request, over OTLP/gRPC without TLS, such as
    /// http://127.0.0.1:4317. Requests with a W3C `traceparent` header join that trace. If not set, tracing is
    /// disabled.
    #[arg(long, env = "GRASPD_OTLP", value_name = "URL")]
    otlp: Option<String>,

    /// Log filter: a level, or directives of Rust's `tracing` such as `warn,graspd=debug`. The log goes to stderr.
    #[arg(long, env = "GRASPD_LOG", value_name = "FILTER", default_value = "info")]
    log: String,

    /// Log format: text or json.
    #[arg(long, env = "GRASPD_LOG_FORMAT", value_name = "FORMAT", default_value = "text")]
    log_format: String,
}

/// All errors of a configuration.
#[derive(Debug, Default)]
pub(crate) struct ConfigErrors(Vec<String>);

impl Config {
    /// Reads the command line and the environment. clap ends the process on `--help` and on unknown flags.
    pub fn from_args() -> Result<Self, ConfigErrors> {
        Self::new(Flags::parse())
    }

    fn new(flags: Flags) -> Result<Self, ConfigErrors> {
        const ADDRESS: &str = "an IP address and a port, such as 127.0.0.1:50051";
        const COUNT: &str = "a whole number from 1 to 1024";
        const BYTES: &str = "a whole number of bytes greater than 0";
        let cpus = available_parallelism().map_or(1, NonZeroUsize::get);
        let mut errors = ConfigErrors::default();

        let listen = errors.parse("listen", &flags.listen, ADDRESS);
        let http = errors.parse("http", &flags.http, ADDRESS);
        let workers = errors.parse("workers", &flags.workers, COUNT).map(|Count(workers)| workers);
        let threads = match &flags.threads {
            Some(threads) => errors.parse("threads", threads, COUNT).map(|Count(threads)| threads),
            None => workers.map(|workers| (cpus / workers).max(1)),
        };
        let provider = errors.parse("provider", &flags.provider, "auto, cpu, openvino, cuda or tensorrt");
        let precision = errors.parse("precision", &flags.precision, "auto, fp32, bf16, fp16 or int8");
        let queue = errors.parse("queue", &flags.queue, COUNT).map(|Count(queue)| queue);
        let max_batch = errors.parse("max-batch", &flags.max_batch, COUNT).map(|Count(volumes)| volumes);
        let batch_delay = errors
            .parse("batch-delay", &flags.batch_delay, "a number of milliseconds from 0 to 1,000,000")
            .map(|Seconds(milliseconds)| milliseconds / 1000);
        let watch = errors.seconds("watch", &flags.watch);
        let max_message_bytes = errors.parse("max-message-bytes", &flags.max_message_bytes, BYTES);
        let max_connections =
            errors.parse::<NonZeroUsize>("max-connections", &flags.max_connections, "a whole number greater than 0");
        let max_tracked = errors.parse("max-tracked", &flags.max_tracked, COUNT).map(|Count(volumes)| volumes);
        let track_timeout = errors.seconds("track-timeout", &flags.track_timeout);
        let recent = match &flags.recent {
            Some(recent) => errors.parse("recent", recent, "a whole number, 0 or more"),
            None => Some(if flags.token_file.is_some() { 0 } else { RECENT }),
        };
        let stall = errors.seconds("stall-timeout", &flags.stall_timeout);
        if stall == Some(Duration::ZERO) {
            errors.add("stall-timeout", "is 0, must be greater than 0");
        }
        let tls = errors.tls(flags.tls_cert.as_deref(), flags.tls_key.as_deref(), flags.tls_client_ca.as_deref());
        let tokens = flags.token_file.map(Tokens::read).transpose();
        let tokens = tokens.map_err(|error| errors.add("token-file", format_args!("{error:#}"))).ok();
        let drain_timeout = errors.seconds("drain-timeout", &flags.drain_timeout);
        let log_format = errors.parse("log-format", &flags.log_format, "text or json");
        if let Err(error) = EnvFilter::try_new(&flags.log) {
            errors.add("log", format_args!("is `{}`: {error}", flags.log));
        }
        let stamps = flags.models.as_deref().map(stamps);
        let store = match flags.models {
            Some(models) => Store::open(&models).map_err(|error| errors.add("models", error)).ok(),
            None => {
                errors.add("models", "is missing: set it to the folder that contains the .onnx files");
                None
            }
        };
        if let (Some(store), Some(name)) = (&store, &flags.default_model)
            && let Err(error) = store.get(name, None)
        {
            errors.add("default-model", error);
        }

        let config = || {
            Some(Self {
                store: store?,
                stamps: stamps?,
                default_model: flags.default_model,
                listen: listen?,
                http: http?,
                workers: workers?,
                threads: threads?,
                provider: provider.map(|Choice(provider)| provider)?,
                precision: precision.map(|Choice(precision)| precision)?,
                // A request takes 0.1 ms of their time. More than four would only take CPUs from the networks.
                io_threads: cpus.min(4),
                queue: queue?,
                batching: Batching { max: max_batch?, delay: batch_delay? },
                watch: watch.map(|every| Some(every).filter(|every| !every.is_zero()))?,
                tls: tls?,
                tokens: tokens?.map(Arc::new),
                max_connections: max_connections.map(NonZeroUsize::get)?,
                limits: Limits { message_bytes: max_message_bytes.map(NonZeroUsize::get)?, stall: stall? },
                max_tracked: max_tracked?,
                track_timeout: track_timeout?,
                recent: recent?,
                drain_timeout: drain_timeout?,
                otlp: flags.otlp,
                log: flags.log,
                log_format: log_format?,
            })
        };
        config().filter(|_| errors.0.is_empty()).ok_or(errors)
    }
}

impl ConfigErrors {
    fn add(&mut self, flag: &str, error: impl Display) {
        let variable = flag.to_uppercase().replace('-', "_");
        self.0.push(format!("--{flag} (GRASPD_{variable}) {error}"));
    }

    fn refuse<T>(&mut self, flag: &str, error: &str) -> Option<T> {
        self.add(flag, error);
        None
    }

    /// The TLS configuration from its files; None without TLS, an error if a file is missing or unreadable.
    fn tls(&mut self, cert: Option<&Path>, key: Option<&Path>, ca: Option<&Path>) -> Option<Option<ServerTlsConfig>> {
        let (cert, key) = match (cert, key, ca) {
            (None, None, None) => return Some(None),
            (Some(cert), Some(key), _) => (cert, key),
            (None, ..) => return self.refuse("tls-cert", "is missing, --tls-key and --tls-client-ca require it"),
            (_, None, _) => return self.refuse("tls-key", "is missing, --tls-cert requires it"),
        };
        let cert = self.read("tls-cert", cert);
        let key = self.read("tls-key", key);
        let ca = ca.map(|ca| self.read("tls-client-ca", ca));
        let mut tls = ServerTlsConfig::new().identity(Identity::from_pem(cert?, key?));
        if let Some(ca) = ca {
            tls = tls.client_ca_root(Certificate::from_pem(ca?));
        }
        Some(Some(tls))
    }

    fn read(&mut self, flag: &str, file: &Path) -> Option<Vec<u8>> {
        fs::read(file).map_err(|error| self.add(flag, format_args!("{}: {error}", file.display()))).ok()
    }

    fn parse<T: FromStr>(&mut self, flag: &str, value: &str, expected: &str) -> Option<T> {
        value.parse().map_err(|_| self.add(flag, format_args!("is `{value}`, must be {expected}"))).ok()
    }

    fn seconds(&mut self, flag: &str, value: &str) -> Option<Duration> {
        self.parse(flag, value, "a number of seconds from 0 to 1,000,000").map(|Seconds(duration)| duration)
    }
}

impl Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "graspd: invalid configuration:")?;
        self.0.iter().try_for_each(|error| writeln!(f, "  {error}"))?;
        writeln!(f, "See `graspd --help` for all flags.")
    }
}

/// A number of threads, sessions, volumes or queued requests, from 1 to 1024.
struct Count(usize);

impl FromStr for Count {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        text.parse().ok().filter(|count| (1..=1024).contains(count)).map(Self).ok_or(())
    }
}

struct Seconds(Duration);

impl FromStr for Seconds {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let seconds: f64 = text.parse().map_err(drop)?;
        // Adding a much longer duration to an `Instant` would overflow.
        if seconds > 1e6 {
            return Err(());
        }
        Duration::try_from_secs_f64(seconds).map(Self).map_err(drop)
    }
}

impl FromStr for LogFormat {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err(()),
        }
    }
}
