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
use prometheus::IntCounter;
use tokio::runtime::Runtime;
use tonic::metadata::MetadataMap;
use tracing::{Span, warn};
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::filter::{FilterExt, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::config::{Config, LogFormat};
use crate::telemetry::log_rate::LogRate;
use grasp_engine::StageTimings;

/// Service name in traces.
const NAME: &str = env!("CARGO_PKG_NAME");

/// Name of the span of a request, the only span that is exported from `tracing`.
pub(crate) const REQUEST: &str = "detect";

/// Maximum time that the last export may delay the exit.
const EXPORT: Duration = Duration::from_secs(1);

/// Log lines that are buffered; further lines are dropped and counted.
const LINES: usize = 8192;

/// The log writer. Dropping it flushes the buffered lines, for at most one second.
pub(crate) struct Log {
    _writer: WorkerGuard,
    /// Lines dropped because the buffer was full.
    pub dropped: ErrorCounter,
    /// Lines suppressed because one place in the code wrote too many.
    pub suppressed: IntCounter,
}

/// The exporter of spans; None without a collector.
pub(crate) struct Traces(Option<SdkTracerProvider>);

/// Sends the log to stderr (stdout is for the parent process) and the spans of requests to the OpenTelemetry collector,
/// if one is set. Spans are sent on the runtime's threads. The log has its own thread, because writing to a pipe that
/// is not read blocks.
pub(crate) fn init(config: &Config, runtime: &Runtime) -> anyhow::Result<(Log, Traces)> {
    let (writer, guard) = NonBlockingBuilder::default().buffered_lines_limit(LINES).thread_name("log").finish(stderr());
    let dropped = writer.error_counter();
    let log = tracing_subscriber::fmt::layer()
        .with_writer(writer)
        .with_ansi(stderr().is_terminal())
        // These errors are written to stderr by the logging thread itself, which would block on a full pipe.
        .log_internal_errors(false);
    let log = match config.log_format {
        LogFormat::Text => log.boxed(),
        LogFormat::Json => log.json().boxed(),
    };
    let provider = match &config.otlp {
        Some(url) => {
            Some(collector(url, runtime).with_context(|| format!("--otlp is `{url}`, cannot export traces to it"))?)
        }
        None => None,
    };
    let traces = provider.as_ref().map(|provider| {
        let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer(NAME));
        layer.with_filter(filter_fn(|metadata| metadata.is_span() && metadata.name() == REQUEST))
    });
    let suppressed = IntCounter::new(
        "graspd_log_lines_suppressed_total",
        "Log lines suppressed because one place in the code wrote too many in a second.",
    )?;
    let rate = LogRate::new(suppressed.clone());
    runtime.spawn(rate.clone().report());
    let log = log.with_filter(EnvFilter::new(&config.log).and(rate));
    tracing_subscriber::registry().with(log).with(traces).init();
    Ok((Log { _writer: guard, dropped, suppressed }, Traces(provider)))
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
    /// Sends the remaining spans.
    pub fn finish(&self) {
        if let Some(provider) = &self.0
            && let Err(error) = provider.shutdown_with_timeout(EXPORT)
        {
            warn!(%error, "cannot send the last spans to the collector (--otlp)");
        }
    }
}

/// The parent span in a request's headers (W3C Trace Context).
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
        // Binary headers are skipped: trace context is text.
        self.0
            .keys()
            .filter_map(|key| if let tonic::metadata::KeyRef::Ascii(key) = key { Some(key.as_str()) } else { None })
            .collect()
    }
}

/// Sets the parent of a span.
pub(crate) fn set_parent(span: &Span, parent: Option<Context>) {
    if let Some(parent) = parent {
        // Fails if tracing is disabled.
        let _ = span.set_parent(parent);
    }
}

/// Adds one child span per stage to the span of a request that ends now, in sequence.
pub(crate) fn stages(span: &Span, timings: &StageTimings) {
    let context = span.context();
    if !context.span().span_context().is_sampled() {
        return;
    }
    let tracer = global::tracer(NAME);
    let StageTimings { preprocessing, fusion, queue, inference, evaluation, postprocessing, total } = *timings;
    let stages: [(&str, Option<Duration>); 6] = [
        ("preprocessing", Some(preprocessing)),
        ("fusion", fusion),
        ("queue", Some(queue)),
        ("inference", Some(inference)),
        ("evaluation", evaluation),
        ("postprocessing", Some(postprocessing)),
    ];
    let mut at = SystemTime::now() - total;
    for (stage, duration) in stages.into_iter().filter_map(|(stage, duration)| Some((stage, duration?))) {
        let builder = SpanBuilder::from_name(stage).with_start_time(at);
        at += duration;
        tracer.build_with_context(builder, &context).end_with_timestamp(at);
    }
}
