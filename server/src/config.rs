mod errors;
mod flags;

use std::ffi::OsStr;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::CommandFactory;
use grasp_engine::{Batching, Fingerprints, FolderSettings, ModelSettings, fingerprints};
use grasp_models::{Choice, Options, Store, own_models};

use crate::transport::address::Address;
use crate::transport::request_body::Limits;
use crate::transport::tls::Tls;
use crate::transport::tokens::Tokens;
use errors::ConfigErrors;
use flags::Flags;
pub(crate) use flags::LogFormat;

/// The validated configuration.
pub(crate) struct Config {
    pub store: Store,
    /// The model folder.
    pub folder: FolderSettings,
    pub listen: Address,
    pub http: SocketAddr,
    /// Address of the REST listener; None without one.
    pub rest: Option<SocketAddr>,
    /// Further names of the HTTP listener.
    pub http_hosts: Vec<String>,
    /// Time after which an inference counts as hanging; None disables the check.
    pub inference_timeout: Option<Duration>,
    /// Interval at which the model folder is polled; None disables polling.
    pub watch: Option<Duration>,
    /// The server's certificate, and the CA of client certificates.
    pub tls: Option<Tls>,
    pub tokens: Option<Arc<Tokens>>,
    pub max_connections: usize,
    /// Time after which a gRPC connection accepts no further calls; None without a limit.
    pub max_connection_age: Option<Duration>,
    pub limits: Limits,
    /// Maximum size of all messages that are being received together, bytes.
    pub max_receiving_bytes: usize,
    /// Maximum number of volumes that open TrackGrasps streams keep.
    pub max_tracked: usize,
    /// Time without a request after which a TrackGrasps stream ends.
    pub track_timeout: Duration,
    /// Requests that the page shows; 0 disables the page.
    pub recent: usize,
    /// Folder of the recordings, and their maximum size, bytes; None without recording.
    pub record: Option<(PathBuf, u64)>,
    pub drain_timeout: Duration,
    /// URL of the OpenTelemetry collector.
    pub otlp: Option<String>,
    pub log: String,
    pub log_format: LogFormat,
}

/// Default of `--recent`; the volumes of that many requests take 5 MB.
const RECENT: usize = 20;

impl Config {
    /// Environment variables that are named like those of flags but belong to none. Those that Kubernetes sets for a
    /// service named `graspd` are left out.
    pub fn unknown_variables() -> Vec<String> {
        let known: Vec<_> =
            Flags::command().get_arguments().filter_map(|flag| flag.get_env()).map(OsStr::to_owned).collect();
        let names = std::env::vars_os().map(|(name, _)| name).filter(|name| !known.contains(name));
        let mut unknown: Vec<String> = names.filter_map(|name| name.into_string().ok()).collect();
        // `SERVER` and `TLS_CA` were variables of the client.
        let others = ["SERVICE_", "PORT", "SERVER", "TLS_CA"];
        let is_ours = |rest: &str| !others.iter().any(|other| rest.starts_with(other));
        unknown.retain(|name| name.strip_prefix("GRASPD_").is_some_and(is_ours));
        unknown.sort();
        unknown
    }

    /// Reads the command line and the environment. The process ends on `--help` and on unknown flags.
    pub fn from_args() -> Result<Self, ConfigErrors> {
        let flags: Flags = ConfigErrors::parse()?;
        let mut errors = ConfigErrors::default();
        let (receiving, message) = (flags.max_receiving_bytes.get(), flags.max_message_bytes.get());
        if receiving / 2 < message {
            let least = message.saturating_mul(2);
            errors.add::<Flags>(
                "max_receiving_bytes",
                format_args!("is `{receiving}`: must be at least twice --max-message-bytes, {least}"),
            );
        }
        if flags.max_batch > flags.queue {
            let needed = format_args!("is `{}`: must be at most --queue, {}", flags.max_batch, flags.queue);
            errors.add::<Flags>("max_batch", needed);
        }
        let Some(models) = flags.models.clone().or_else(own_models) else {
            errors.add::<Flags>(
                "models",
                "is missing, and no models come with this program: give a folder of .onnx files",
            );
            return Err(errors);
        };
        let fingerprints = fingerprints(&models);
        let store = Store::open_limited(&models, flags.max_model_bytes);
        let store = store.inspect_err(|error| {
            errors.add::<Flags>("models", format_args!("is `{}`: {error}", models.display()));
        });
        // clap requires the certificate and the key to be given together.
        let tls = flags.tls_cert.as_ref().zip(flags.tls_key.as_ref()).map(|(cert, key)| {
            let ca = flags.tls_client_ca.as_ref().map(|ca| &*ca.0);
            Tls::new(&cert.0, &key.0, ca).map_err(|error| {
                errors.add::<Flags>("tls_cert", format_args!("and the other TLS files cannot be used: {error:#}"));
            })
        });
        match (store, tls.transpose()) {
            (Ok(store), Ok(tls)) if errors.is_empty() => Ok(Self::new(flags, store, fingerprints, tls)),
            _ => Err(errors),
        }
    }

    fn new(flags: Flags, store: Store, fingerprints: Fingerprints, tls: Option<Tls>) -> Self {
        let Choice(provider) = flags.provider;
        let Choice(precision) = flags.precision;
        let batching = Batching { max: flags.max_batch.into(), delay: flags.batch_delay };
        let options = Options {
            sessions: flags.workers.map(usize::from),
            threads: flags.threads.map(usize::from),
            provider,
            precision,
            max_batch: batching.max,
            cuda_graphs: !flags.no_cuda_graphs,
        };
        let folder = FolderSettings {
            directory: store.directory().to_owned(),
            fingerprints,
            default_model: flags.default_model,
            max_bytes: flags.max_model_bytes,
            timeout: flags.reload_timeout,
            is_controlled: flags.allow_model_control,
            models: ModelSettings { options, capacity: flags.queue.into(), batching },
        };
        Self {
            store,
            folder,
            listen: flags.listen,
            http: flags.http,
            rest: flags.rest,
            http_hosts: flags.http_host,
            inference_timeout: Some(flags.inference_timeout).filter(|timeout| !timeout.is_zero()),
            watch: Some(flags.watch).filter(|interval| !interval.is_zero()),
            tls,
            max_connections: flags.max_connections.get(),
            max_connection_age: Some(flags.max_connection_age).filter(|age| !age.is_zero()),
            limits: Limits { message_bytes: flags.max_message_bytes.get(), stall: flags.stall_timeout },
            max_receiving_bytes: flags.max_receiving_bytes.get(),
            max_tracked: flags.max_tracked.into(),
            track_timeout: flags.track_timeout,
            recent: flags.recent.unwrap_or(if flags.token_file.is_some() { 0 } else { RECENT }),
            tokens: flags.token_file,
            record: flags.record.map(|folder| (folder, flags.record_bytes)),
            drain_timeout: flags.drain_timeout,
            otlp: flags.otlp,
            log: flags.log,
            log_format: flags.log_format,
        }
    }
}
