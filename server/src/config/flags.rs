use std::fs;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::builder::{PathBufValueParser, RangedI64ValueParser, TypedValueParser};
use clap::{Parser, ValueEnum, value_parser};
use grasp_models::{Choice, MAX_MODEL_BYTES, Precision, Provider, StoreError};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::ParseError;

use crate::transport::address::Address;
use crate::transport::tokens::Tokens;

/// Detects 6-DoF grasps in depth images, point clouds and TSDF volumes, over gRPC.
///
/// Each flag can also be set by an environment variable. ORT_DYLIB_PATH is the path of ONNX Runtime's shared library;
/// without it graspd takes that of its Python environment, the downloaded one, or that of the system.
#[derive(Parser)]
#[command(name = "graspd", version, max_term_width = 100, allow_negative_numbers = true)]
pub(super) struct Flags {
    /// Model folder. All .onnx files in it are served. Default: the models that come with graspd.
    #[arg(
        long,
        env = "GRASPD_MODELS",
        value_name = "DIR",
        value_parser = PathBufValueParser::new().try_map(model_folder),
    )]
    pub models: Option<PathBuf>,

    /// Maximum size of a model file, bytes. Larger files, and files that are not regular, are not opened.
    #[arg(long, env = "GRASPD_MAX_MODEL_BYTES", value_name = "N", default_value_t = MAX_MODEL_BYTES)]
    pub max_model_bytes: u64,

    /// Model for requests that name no model, if it accepts their resolution. If not set, the file `default` in the
    /// model folder names it; without that file it is the first network by name.
    #[arg(long, env = "GRASPD_DEFAULT_MODEL", value_name = "NAME")]
    pub default_model: Option<String>,

    /// Address of the gRPC listener: an IP address with a port, or unix:PATH. Port 0 selects a free port, which is
    /// printed to stdout.
    #[arg(long, env = "GRASPD_LISTEN", value_name = "ADDR", default_value = "127.0.0.1:50051")]
    pub listen: Address,

    /// Address of the HTTP listener: /metrics (Prometheus), /healthz, /readyz and the web page at /.
    #[arg(long, env = "GRASPD_HTTP", value_name = "ADDR", default_value = "127.0.0.1:9090")]
    pub http: SocketAddr,

    /// Names by which the HTTP listener is reached, comma-separated. Requests to other names are refused, unless the
    /// name is an IP address or has no dot, so that no page of another site can read the responses in a browser.
    #[arg(long, env = "GRASPD_HTTP_HOST", value_name = "NAMES", value_delimiter = ',')]
    pub http_host: Vec<String>,

    /// Sessions per model. Each session processes one batch at a time. Default: two with the provider openvino, one with
    /// others.
    #[arg(long, env = "GRASPD_WORKERS", value_name = "N", value_parser = count())]
    pub workers: Option<u16>,

    /// Threads per session. Default: the CPUs available to the process.
    #[arg(long, env = "GRASPD_THREADS", value_name = "N", value_parser = count())]
    pub threads: Option<u16>,

    /// Execution provider of ONNX Runtime: cpu, openvino, cuda, tensorrt or auto. auto selects the fastest provider
    /// that is available and whose outputs match those of cpu in fp32. A named provider that is not available is an
    /// error.
    #[arg(long, env = "GRASPD_PROVIDER", value_name = "NAME", default_value = "auto")]
    pub provider: Choice<Provider>,

    /// Numeric precision: fp32, bf16, fp16, int8 or auto. auto selects the fastest. A named precision that is not
    /// available is an error.
    #[arg(long, env = "GRASPD_PRECISION", value_name = "NAME", default_value = "auto")]
    pub precision: Choice<Precision>,

    /// Launch the kernels of an inference one by one with the provider cuda, instead of together as a CUDA graph.
    #[arg(long, env = "GRASPD_NO_CUDA_GRAPHS")]
    pub no_cuda_graphs: bool,

    /// Queue length per model, requests; one whose workspace has several cubes counts once per cube. If the queue is full,
    /// requests are refused immediately.
    #[arg(long, env = "GRASPD_QUEUE", value_name = "N", default_value = "32", value_parser = count())]
    pub queue: u16,

    /// Time after which an inference counts as hanging, seconds: its requests fail, and its session is lost until it
    /// ends. If all sessions of a model hang, the server is neither ready nor healthy. 0 disables the check.
    #[arg(
        long,
        env = "GRASPD_INFERENCE_TIMEOUT",
        value_name = "SECONDS",
        default_value = "30",
        value_parser = seconds,
    )]
    pub inference_timeout: Duration,

    /// Maximum batch size, volumes. Values above 1 raise the throughput on a GPU. On a CPU they only raise the latency.
    #[arg(long, env = "GRASPD_MAX_BATCH", value_name = "N", default_value = "1", value_parser = count())]
    pub max_batch: u16,

    /// Maximum time that a volume waits for a batch to fill, milliseconds; at most half of the time until its deadline.
    /// 0 disables waiting.
    #[arg(
        long,
        env = "GRASPD_BATCH_DELAY",
        value_name = "MS",
        default_value = "0",
        value_parser = milliseconds,
    )]
    pub batch_delay: Duration,

    /// Interval at which the model folder is polled for changes, seconds. Changed models are loaded and warmed up in
    /// the background, then replace the old ones. 0 disables polling. SIGHUP always reloads the folder.
    #[arg(
        long,
        env = "GRASPD_WATCH",
        value_name = "SECONDS",
        default_value = "2",
        value_parser = seconds,
    )]
    pub watch: Duration,

    /// Time after which a reload is reported as failed and no longer delays the next one, seconds.
    #[arg(
        long,
        env = "GRASPD_RELOAD_TIMEOUT",
        value_name = "SECONDS",
        default_value = "60",
        value_parser = positive_seconds,
    )]
    pub reload_timeout: Duration,

    /// Clients may load and unload models, with the requests RepositoryModelLoad and RepositoryModelUnload of the Open
    /// Inference Protocol.
    #[arg(long, env = "GRASPD_ALLOW_MODEL_CONTROL")]
    pub allow_model_control: bool,

    /// Address of the REST listener, for clients without gRPC: grasps in depth images as JSON, and the Open Inference
    /// Protocol, with the limits, the tokens and the TLS files of the gRPC listener. If not set, there is none.
    #[arg(long, env = "GRASPD_REST", value_name = "ADDR")]
    pub rest: Option<SocketAddr>,

    /// Certificate chain of the gRPC and REST listeners, PEM. Enables TLS; plaintext connections are then refused.
    #[arg(
        long,
        requires = "tls_key",
        env = "GRASPD_TLS_CERT",
        value_name = "FILE",
        value_parser = PathBufValueParser::new().try_map(Pem::read),
    )]
    pub tls_cert: Option<Pem>,

    /// Private key of the certificate, PEM.
    #[arg(
        long,
        requires = "tls_cert",
        env = "GRASPD_TLS_KEY",
        value_name = "FILE",
        value_parser = PathBufValueParser::new().try_map(Pem::read),
    )]
    pub tls_key: Option<Pem>,

    /// CA certificates, PEM. Clients must present a certificate that one of them has signed (mutual TLS).
    #[arg(
        long,
        requires = "tls_cert",
        env = "GRASPD_TLS_CLIENT_CA",
        value_name = "FILE",
        value_parser = PathBufValueParser::new().try_map(Pem::read),
    )]
    pub tls_client_ca: Option<Pem>,

    /// File of access tokens, one per line. Requests must have the header `authorization: Bearer TOKEN` with one of
    /// them. SIGHUP reloads the file. Health checks need no token.
    #[arg(
        long,
        env = "GRASPD_TOKEN_FILE",
        value_name = "FILE",
        value_parser = PathBufValueParser::new().try_map(tokens),
    )]
    pub token_file: Option<Arc<Tokens>>,

    /// Maximum number of open connections. Further connections are refused.
    #[arg(long, env = "GRASPD_MAX_CONNECTIONS", value_name = "N", default_value = "16384")]
    pub max_connections: NonZeroUsize,

    /// Time after which a gRPC connection accepts no further calls and is closed when the open ones end, seconds.
    /// Clients connect again, so that they find the replicas that were added since. 0 disables the limit.
    #[arg(
        long,
        env = "GRASPD_MAX_CONNECTION_AGE",
        value_name = "SECONDS",
        default_value = "0",
        value_parser = seconds,
    )]
    pub max_connection_age: Duration,

    /// Maximum number of volumes that open TrackGrasps streams keep: each has one, or one for each cube of its
    /// workspace. Further ones are refused.
    #[arg(long, env = "GRASPD_MAX_TRACKED", value_name = "N", default_value = "256", value_parser = count())]
    pub max_tracked: u16,

    /// Time without a request after which a TrackGrasps stream ends and its volume is dropped, seconds.
    #[arg(
        long,
        env = "GRASPD_TRACK_TIMEOUT",
        value_name = "SECONDS",
        default_value = "60",
        value_parser = positive_seconds,
    )]
    pub track_timeout: Duration,

    /// Number of latest requests shown on the web page of the HTTP listener, with their scenes. 0 disables the page.
    /// Default: 20, or 0 with --token-file, because the page needs no token.
    #[arg(long, env = "GRASPD_RECENT", value_name = "N")]
    pub recent: Option<usize>,

    /// Maximum pause within a message, seconds. After it the request is refused. Also the maximum pause of a client
    /// that reads a large response; after it the rest is dropped.
    #[arg(
        long,
        env = "GRASPD_STALL_TIMEOUT",
        value_name = "SECONDS",
        default_value = "10",
        value_parser = positive_seconds,
    )]
    pub stall_timeout: Duration,

    /// Maximum message size, bytes.
    #[arg(long, env = "GRASPD_MAX_MESSAGE_BYTES", value_name = "N", default_value = "16777216")]
    pub max_message_bytes: NonZeroUsize,

    /// Maximum number of received bytes of messages that are not complete yet, on all connections together. Messages
    /// beyond it are refused. A client address may use half of what the others leave.
    #[arg(long, env = "GRASPD_MAX_RECEIVING_BYTES", value_name = "N", default_value = "268435456")]
    pub max_receiving_bytes: NonZeroUsize,

    /// Folder into which requests for grasps and scores are recorded with their answers, one file each, for `grasp
    /// replay`. TrackGrasps is not recorded. If not set, nothing is recorded.
    #[arg(long, env = "GRASPD_RECORD", value_name = "DIR")]
    pub record: Option<PathBuf>,

    /// Maximum size of all recordings, bytes. The oldest are deleted.
    #[arg(long, env = "GRASPD_RECORD_BYTES", value_name = "N", default_value = "1073741824", requires = "record")]
    pub record_bytes: u64,

    /// Time that accepted requests have to finish after SIGTERM, seconds.
    #[arg(
        long,
        env = "GRASPD_DRAIN_TIMEOUT",
        value_name = "SECONDS",
        default_value = "20",
        value_parser = seconds,
    )]
    pub drain_timeout: Duration,

    /// OpenTelemetry collector that receives a trace of each request, over OTLP/gRPC without TLS, such as
    /// http://127.0.0.1:4317. Requests with a W3C `traceparent` header join that trace. If not set, tracing is
    /// disabled.
    #[arg(long, env = "GRASPD_OTLP", value_name = "URL")]
    pub otlp: Option<String>,

    /// Log filter: a level, or directives of Rust's `tracing` such as `warn,graspd=debug`. The log goes to stderr.
    #[arg(long, env = "GRASPD_LOG", value_name = "FILTER", default_value = LOG, value_parser = log_filter)]
    pub log: String,

    /// Log format: text or json.
    #[arg(long, value_enum, env = "GRASPD_LOG_FORMAT", value_name = "FORMAT", default_value = "text")]
    pub log_format: LogFormat,
}

/// Default log filter. HTTP/2 reports malformed headers, which end a call before graspd sees it, at the level `debug`.
const LOG: &str = "info,h2::server=debug";

/// Format of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    Text,
    Json,
}

/// A folder that can be read. Its files are read after the other flags.
fn model_folder(folder: PathBuf) -> Result<PathBuf, StoreError> {
    match fs::read_dir(&folder) {
        Ok(_) => Ok(folder),
        Err(source) => Err(StoreError::Io { path: folder, source }),
    }
}

/// The content of a PEM file.
#[derive(Clone)]
pub(super) struct Pem(pub Vec<u8>);

impl Pem {
    fn read(file: PathBuf) -> std::io::Result<Self> {
        fs::read(file).map(Self)
    }
}

/// A number of threads, sessions, volumes or queued requests.
fn count() -> RangedI64ValueParser<u16> {
    value_parser!(u16).range(1..=1024)
}

fn tokens(file: PathBuf) -> Result<Arc<Tokens>, String> {
    // clap prints the outermost error only.
    Tokens::read(file).map(Arc::new).map_err(|error| format!("{error:#}"))
}

fn log_filter(text: &str) -> Result<String, ParseError> {
    EnvFilter::try_new(text).map(|_| text.to_owned())
}

fn seconds(text: &str) -> Result<Duration, &'static str> {
    let seconds = text.parse().ok().filter(|seconds: &f64| *seconds <= LONGEST);
    seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok()).ok_or("must be from 0 to 1,000,000")
}

/// Adding a much longer duration to an `Instant` would overflow.
const LONGEST: f64 = 1e6;

fn positive_seconds(text: &str) -> Result<Duration, &'static str> {
    match seconds(text) {
        Ok(Duration::ZERO) => Err("must be greater than 0"),
        seconds => seconds,
    }
}

fn milliseconds(text: &str) -> Result<Duration, &'static str> {
    seconds(text).map(|milliseconds| milliseconds / 1000)
}
