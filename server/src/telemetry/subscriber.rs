use std::io::{IsTerminal, stderr};
use std::time::{Duration, SystemTime};

use anyhow::Context as _;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::{Span as _, SpanBuilder, TraceContextExt, Tracer, TracerProvider};
use opentelemetry::{Context, global};
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tokio::runtime::Runtime;
use tonic::metadata::MetadataMap;
use tracing::{Span, warn};
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::config::{Config, LogFormat};
use crate::telemetry::timings::StageTimings;

/// The name under which traces know this server.
const NAME: &str = env!("CARGO_PKG_NAME");

/// The span of a request: the one that traces show.
pub(crate) const REQUEST: &str = "detect";

/// How many lines of the log may wait to be written.
const LINES: usize = 8192;

/// The log on its way to stderr. Dropping it writes what still waits, for a second at most.
pub(crate) struct Log {
    _writer: WorkerGuard,
    /// Lines that found no room, because whoever reads the log does not.
    pub dropped: ErrorCounter,
}

/// Where spans go besides the log.
pub(crate) struct Traces(Option<SdkTracerProvider>);

/// Sends the log to stderr, as stdout is for the process that started this one; and the spans of requests to a collector of
/// OpenTelemetry, where there is one. They travel on the runtime's threads; the log has one of its own, as a pipe that
/// nobody reads holds up who writes to it.
pub(crate) fn init(config: &Config, runtime: &Runtime) -> anyhow::Result<(Log, Traces)> {
    let (writer, guard) = NonBlockingBuilder::default().buffered_lines_limit(LINES).thread_name("log").finish(stderr());
    let dropped = writer.error_counter();
    let log = tracing_subscriber::fmt::layer()
        .with_writer(writer)
        .with_ansi(stderr().is_terminal())
        // They would be told on stderr by the thread that met them, which is to wait for nobody.
        .log_internal_errors(false);
    let log = match config.log_format {
        LogFormat::Text => log.boxed(),
        LogFormat::Json => log.json().boxed(),
    };
    let provider = match &config.otlp {
        Some(url) => Some(collector(url, runtime).with_context(|| format!("--otlp {url} cannot be used"))?),
        None => None,
    };
    let traces = provider.as_ref().map(|provider| {
        let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer(NAME));
        layer.with_filter(filter_fn(|metadata| metadata.is_span() && metadata.name() == REQUEST))
    });
    tracing_subscriber::registry().with(log.with_filter(EnvFilter::new(&config.log))).with(traces).init();
    Ok((Log { _writer: guard, dropped }, Traces(provider)))
}

fn collector(url: &str, runtime: &Runtime) -> anyhow::Result<SdkTracerProvider> {
    let _entered = runtime.enter();
    let exporter = SpanExporter::builder().with_tonic().with_endpoint(url).build()?;
    let resource = Resource::builder().with_service_name(NAME).build();
    let provider = SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build();
    global::set_tracer_provider(provider.clone());
    Ok(provider)
}

impl Traces {
    /// Sends what has not been sent yet.
    pub fn finish(&self) {
        if let Some(provider) = &self.0
            && let Err(error) = provider.shutdown()
        {
            warn!(%error, "the last spans were lost");
        }
    }
}

/// The span of which a request is a part, as its caller says (W3C Trace Context).
pub(crate) fn parent(metadata: &MetadataMap) -> Option<Context> {
    let context = TraceContextPropagator::new().extract(&Headers(metadata));
    context.has_active_span().then_some(context)
}

struct Headers<'a>(&'a MetadataMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        // Only binary headers are not text.
        self.0
            .keys()
            .filter_map(|key| if let tonic::metadata::KeyRef::Ascii(key) = key { Some(key.as_str()) } else { None })
            .collect()
    }
}

/// Makes a span a part of its caller's, where there is one and somebody looks.
pub(crate) fn adopt(span: &Span, parent: Option<Context>) {
    if let Some(parent) = parent {
        // It fails where nobody looks.
        let _ = span.set_parent(parent);
    }
}

/// Adds a span for each stage of a request that ends now to the request's own, one after the other.
pub(crate) fn stages(span: &Span, timings: &StageTimings) {
    let context = span.context();
    if !context.span().span_context().is_sampled() {
        return;
    }
    let tracer = global::tracer(NAME);
    let StageTimings { preprocessing, fusion, queue, inference, postprocessing, total } = *timings;
    let stages: [(&str, Option<Duration>); 5] = [
        ("preprocessing", Some(preprocessing)),
        ("fusion", fusion),
        ("queue", Some(queue)),
        ("inference", Some(inference)),
        ("postprocessing", Some(postprocessing)),
    ];
    let mut at = SystemTime::now() - total;
    for (stage, took) in stages.into_iter().filter_map(|(stage, took)| Some((stage, took?))) {
        let builder = SpanBuilder::from_name(stage).with_start_time(at);
        at += took;
        tracer.build_with_context(builder, &context).end_with_timestamp(at);
    }
}
