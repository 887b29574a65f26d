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

/// Everything that can be set, checked.
pub(crate) struct Config {
    pub store: Store,
    /// Of the store's files, from before they were read.
    pub stamps: Stamps,
    pub default_model: Option<String>,
    pub listen: SocketAddr,
    pub http: SocketAddr,
    /// Sessions of each model.
    pub workers: usize,
    /// Threads of each session.
    pub threads: usize,
    /// What runs the models; the machine's choice where there is none.
    pub provider: Option<Provider>,
    /// In which numbers.
    pub precision: Option<Precision>,
    /// Threads that move messages.
    pub io_threads: usize,
    /// Requests of each model that may wait.
    pub queue: usize,
    /// How many volumes a session takes at once.
    pub batching: Batching,
    /// How often it is looked whether the models have changed.
    pub watch: Option<Duration>,
    /// The server's certificate, and whose clients it takes.
    pub tls: Option<ServerTlsConfig>,
    pub tokens: Option<Arc<Tokens>>,
    pub max_connections: usize,
    pub limits: Limits,
    /// Volumes that are kept from view to view.
    pub max_tracked: usize,
    /// For how long, without a view.
    pub track_timeout: Duration,
    /// Requests that the page shows; none where there is no page.
    pub recent: usize,
    pub drain_timeout: Duration,
    /// Where traces go.
    pub otlp: Option<String>,
    pub log: String,
    pub log_format: LogFormat,
}

/// Requests that the page shows, unless told otherwise: their volumes are 5 MB.
const RECENT: usize = 20;

/// How the log is written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum LogFormat {
    Text,
    Json,
}

/// Answers volumes with 6-DoF grasps over gRPC.
///
/// Every flag can be given by the environment too. ORT_DYLIB_PATH names ONNX Runtime's shared library.
//
// Values are read as text and checked together, so that one run reports every mistake.
#[derive(Parser)]
#[command(name = "graspd", version, max_term_width = 100)]
struct Flags {
    /// Folder whose .onnx files are served.
    #[arg(long, env = "GRASPD_MODELS", value_name = "DIR")]
    models: Option<PathBuf>,

    /// Model that answers requests which name none, if their volume fits it. By default the one that the file `default` in
    /// the folder of models names, else the first by name.
    #[arg(long, env = "GRASPD_DEFAULT_MODEL", value_name = "NAME")]
    default_model: Option<String>,

    /// Address of the gRPC listener. Port 0 takes a free one; stdout says which.
    #[arg(long, env = "GRASPD_LISTEN", value_name = "ADDR", default_value = "127.0.0.1:50051")]
    listen: String,

    /// Address of the HTTP listener: /metrics for Prometheus, /healthz, /readyz.
    #[arg(long, env = "GRASPD_HTTP", value_name = "ADDR", default_value = "127.0.0.1:9090")]
    http: String,

    /// Sessions of each model: requests that it answers at the same time.
    #[arg(long, env = "GRASPD_WORKERS", value_name = "N", default_value = "1")]
    workers: String,

    /// Threads of each session. By default the CPUs that this process may use, divided by --workers.
    #[arg(long, env = "GRASPD_THREADS", value_name = "N")]
    threads: Option<String>,

    /// What runs the models: cpu, openvino, cuda or tensorrt, or it is an error. auto takes the fastest that this machine
    /// and this ONNX Runtime have, and that gives the answers that cpu gives.
    #[arg(long, env = "GRASPD_PROVIDER", value_name = "NAME", default_value = "auto")]
    provider: String,

    /// The numbers they are computed in: fp32, bf16, fp16 or int8, or it is an error. auto takes the fastest.
    #[arg(long, env = "GRASPD_PRECISION", value_name = "NAME", default_value = "auto")]
    precision: String,

    /// Requests of each model that may wait for a session. Further ones are refused at once.
    #[arg(long, env = "GRASPD_QUEUE", value_name = "N", default_value = "32")]
    queue: String,

    /// Volumes that a session takes at once, if so many wait. More than 1 serves more volumes on a card; on a CPU it only
    /// makes each wait for the others.
    #[arg(long, env = "GRASPD_MAX_BATCH", value_name = "N", default_value = "1")]
    max_batch: String,

    /// How long a session that could take more volumes waits for them, counted from the first, milliseconds. 0 takes what
    /// is there.
    #[arg(long, env = "GRASPD_BATCH_DELAY", value_name = "MS", default_value = "0", allow_negative_numbers = true)]
    batch_delay: String,

    /// How often it is looked whether files of the folder have changed, seconds: what is new is loaded and warmed up
    /// beside what is served, then served instead. With 0 nobody looks; SIGHUP loads anew in any case.
    #[arg(long, env = "GRASPD_WATCH", value_name = "SECONDS", default_value = "2", allow_negative_numbers = true)]
    watch: String,

    /// Certificate that the gRPC listener shows, with those between it and its CA, PEM. With it TLS is spoken, alone.
    #[arg(long, env = "GRASPD_TLS_CERT", value_name = "FILE")]
    tls_cert: Option<PathBuf>,

    /// The certificate's private key, PEM.
    #[arg(long, env = "GRASPD_TLS_KEY", value_name = "FILE")]
    tls_key: Option<PathBuf>,

    /// Take only clients that show a certificate of one of these CAs, PEM.
    #[arg(long, env = "GRASPD_TLS_CLIENT_CA", value_name = "FILE")]
    tls_client_ca: Option<PathBuf>,

    /// Take only requests that bring one of the tokens in this file, one in a line, as `authorization: Bearer TOKEN`.
    /// SIGHUP reads it anew. Health is told without.
    #[arg(long, env = "GRASPD_TOKEN_FILE", value_name = "FILE")]
    token_file: Option<PathBuf>,

    /// Connections that may be open at a time. Further ones are closed at once.
    #[arg(long, env = "GRASPD_MAX_CONNECTIONS", value_name = "N", default_value = "16384")]
    max_connections: String,

    /// Volumes that are kept from view to view, one for each call of TrackGrasps. Further calls are refused.
    #[arg(long, env = "GRASPD_MAX_TRACKED", value_name = "N", default_value = "64")]
    max_tracked: String,

    /// How long a volume is kept without a request, seconds. Then the call ends.
    #[arg(
        long,
        env = "GRASPD_TRACK_TIMEOUT",
        value_name = "SECONDS",
        default_value = "60",
        allow_negative_numbers = true
    )]
    track_timeout: String,

    /// The latest requests that are kept to be looked at, with what was seen, on the page of the HTTP listener. 0 for no
    /// page, which is also the default with --token-file: whoever reaches that listener sees it.
    #[arg(long, env = "GRASPD_RECENT", value_name = "N")]
    recent: Option<String>,

    /// How long a message may stand still in the middle, seconds.
    #[arg(
        long,
        env = "GRASPD_STALL_TIMEOUT",
        value_name = "SECONDS",
        default_value = "10",
        allow_negative_numbers = true
    )]
    stall_timeout: String,

    /// Largest message that is taken, bytes.
    #[arg(long, env = "GRASPD_MAX_MESSAGE_BYTES", value_name = "N", default_value = "16777216")]
    max_message_bytes: String,

    /// After SIGTERM, how long requests that were taken may still run, seconds.
    #[arg(
        long,
        env = "GRASPD_DRAIN_TIMEOUT",
        value_name = "SECONDS",
        default_value = "20",
        allow_negative_numbers = true
    )]
    drain_timeout: String,

    /// Collector of OpenTelemetry that gets a trace of each request, over gRPC without TLS, such as http://127.0.0.1:4317.
    /// A request that brings a W3C traceparent is a part of its caller's trace. By default nobody gets any.
    #[arg(long, env = "GRASPD_OTLP", value_name = "URL")]
    otlp: Option<String>,

    /// What is logged to stderr: a level, or tracing's directives such as `warn,graspd=debug`.
    #[arg(long, env = "GRASPD_LOG", value_name = "FILTER", default_value = "info")]
    log: String,

    /// How the log is written: text or json.
    #[arg(long, env = "GRASPD_LOG_FORMAT", value_name = "FORMAT", default_value = "text")]
    log_format: String,
}

/// Every mistake in the configuration.
#[derive(Debug, Default)]
pub(crate) struct ConfigErrors(Vec<String>);

impl Config {
    /// From the command line and the environment. `--help` and unknown flags end the process, as clap does.
    pub fn from_args() -> Result<Self, ConfigErrors> {
        Self::new(Flags::parse())
    }

    fn new(flags: Flags) -> Result<Self, ConfigErrors> {
        const ADDRESS: &str = "an address and a port, such as 127.0.0.1:50051";
        const COUNT: &str = "a whole number from 1 to 1024";
        const BYTES: &str = "a whole number of bytes above 0";
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
            .parse("batch-delay", &flags.batch_delay, "a number of milliseconds from 0 to a million")
            .map(|Seconds(milliseconds)| milliseconds / 1000);
        let watch = errors.seconds("watch", &flags.watch);
        let max_message_bytes = errors.parse("max-message-bytes", &flags.max_message_bytes, BYTES);
        let max_connections =
            errors.parse::<NonZeroUsize>("max-connections", &flags.max_connections, "a whole number above 0");
        let max_tracked = errors.parse("max-tracked", &flags.max_tracked, COUNT).map(|Count(volumes)| volumes);
        let track_timeout = errors.seconds("track-timeout", &flags.track_timeout);
        let recent = match &flags.recent {
            Some(recent) => errors.parse("recent", recent, "a whole number, 0 or more"),
            None => Some(if flags.token_file.is_some() { 0 } else { RECENT }),
        };
        let stall = errors.seconds("stall-timeout", &flags.stall_timeout);
        if stall == Some(Duration::ZERO) {
            errors.add("stall-timeout", "is 0, nobody could say a word; it must be above");
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
                errors.add("models", "is missing: name the folder that holds the .onnx files");
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
                // A request costs them a tenth of a millisecond: more than four would only take CPUs from the networks.
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

    /// No TLS, or all that it needs.
    fn tls(&mut self, cert: Option<&Path>, key: Option<&Path>, ca: Option<&Path>) -> Option<Option<ServerTlsConfig>> {
        let (cert, key) = match (cert, key, ca) {
            (None, None, None) => return Some(None),
            (Some(cert), Some(key), _) => (cert, key),
            (None, ..) => return self.refuse("tls-cert", "is missing, --tls-key and --tls-client-ca need it"),
            (_, None, _) => return self.refuse("tls-key", "is missing, --tls-cert needs it"),
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
        value.parse().map_err(|_| self.add(flag, format_args!("is `{value}`, it must be {expected}"))).ok()
    }

    fn seconds(&mut self, flag: &str, value: &str) -> Option<Duration> {
        self.parse(flag, value, "a number of seconds from 0 to a million").map(|Seconds(duration)| duration)
    }
}

impl Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "graspd: {} in the configuration:", if self.0.len() == 1 { "a mistake" } else { "mistakes" })?;
        self.0.iter().try_for_each(|error| writeln!(f, "  {error}"))?;
        writeln!(f, "`graspd --help` says what each flag means.")
    }
}

/// Of threads, or of requests that wait: a thousand volumes are more than anyone waits for.
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
        // Longer ones could not be added to a moment.
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
