use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp::Priority;
use grasp_engine::{ModelLabels, ModelObserver, Observer, Refusal, Reload, StageTimings};
use grasp_proto::pb::geometry_warning::Code as WarningCode;
use prometheus::core::Collector;
#[cfg(target_os = "linux")]
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    Histogram, HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry,
    TEXT_FORMAT, TextEncoder,
};
use tonic::Code;
use tracing_appender::non_blocking::ErrorCounter;

use crate::readiness::State;
use crate::transport::connections::ConnectionLimit;
use crate::transport::receive_budget::ReceiveBudget;

/// Seconds: from the fastest stages to a full queue of a large network on a slow CPU.
const BUCKETS: [f64; 33] = [
    50e-6, 75e-6, 100e-6, 150e-6, 200e-6, 300e-6, 500e-6, 750e-6, 1e-3, 1.5e-3, 2e-3, 3e-3, 5e-3, 7.5e-3, 10e-3, 15e-3,
    20e-3, 30e-3, 50e-3, 75e-3, 100e-3, 150e-3, 200e-3, 300e-3, 500e-3, 750e-3, 1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0,
];

/// Volumes per batch.
const BATCHES: [f64; 9] = [1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 32.0, 64.0];

const VALID: &str = "the metric names below are valid and distinct";

/// The Prometheus metrics. The label `model` is `name version`, and empty for requests that were refused before a model
/// was selected.
pub(crate) struct Metrics {
    registry: Registry,
    stages: HistogramVec,
    requests: IntCounterVec,
    grasps: IntCounterVec,
    warnings: IntCounterVec,
    refused: IntCounterVec,
    queued: IntCounterVec,
    waiting: IntGaugeVec,
    batches: HistogramVec,
    models: IntGaugeVec,
    reloads: IntCounterVec,
    rejected: IntGauge,
    connections: IntGaugeVec,
    receiving: IntGauge,
    receiving_limit: IntGauge,
    connections_limit: IntGaugeVec,
    connections_refused: IntCounterVec,
    certificate: IntGauge,
    ready: IntGauge,
    tracked: IntGauge,
    hanging: IntGaugeVec,
    recordings: IntCounterVec,
    /// The models that are no longer served, and since when.
    retired: Mutex<Vec<(String, Instant)>>,
    dropped_lines: IntCounter,
    /// The log's counter of dropped lines, and how many of them `dropped_lines` includes.
    dropped: (ErrorCounter, AtomicU64),
}

/// Time after which the series of a model that is no longer served are removed. Until then Prometheus reads their last
/// values, also with a long scrape interval.
const RETENTION: Duration = Duration::from_mins(10);

/// The metrics of a model's queue.
struct QueueMetrics {
    /// Queued requests.
    waiting: IntGauge,
    /// Volumes per batch.
    batch: Histogram,
    /// The queue was full; the reply would have been too late; another request took its place.
    refused: [IntCounter; 3],
    /// Accepted scenes, by [`Priority`].
    queued: [IntCounter; 2],
    /// Sessions whose inference does not end.
    hanging: IntGauge,
}

impl ModelObserver for QueueMetrics {
    fn waiting(&self, more: i64) {
        self.waiting.add(more);
    }

    fn accepted(&self, priority: Priority, scenes: usize) {
        self.queued[priority as usize].inc_by(scenes as u64);
    }

    fn refused(&self, reason: Refusal) {
        self.refused[reason as usize].inc();
    }

    fn batch(&self, scenes: usize) {
        self.batch.observe(scenes as f64);
    }

    fn hanging(&self, more: i64) {
        self.hanging.add(more);
    }
}

impl Observer for Metrics {
    fn model(&self, label: &str) -> Arc<dyn ModelObserver> {
        self.retired().retain(|(retired, _)| retired != label);
        for (stage, _) in StageTimings::default().stages() {
            self.stages.with_label_values(&[label, stage]);
        }
        for code in [Code::Ok, Code::Internal, Code::ResourceExhausted, Code::DeadlineExceeded, Code::Cancelled] {
            self.requests.with_label_values(&[label, code_name(code)]);
        }
        for code in 1.. {
            let Ok(code) = WarningCode::try_from(code) else { break };
            self.warnings.with_label_values(&[label, warning_name(code)]);
        }
        Arc::new(QueueMetrics {
            // In the order of the enumerations.
            queued: ["NORMAL", "BATCH"].map(|priority| self.queued.with_label_values(&[label, priority])),
            refused: ["full", "deadline", "displaced"].map(|reason| self.refused.with_label_values(&[label, reason])),
            waiting: self.waiting.with_label_values(&[label]),
            batch: self.batches.with_label_values(&[label]),
            hanging: self.hanging.with_label_values(&[label]),
        })
    }

    fn replaced(&self, before: &[ModelLabels], now: &[ModelLabels]) {
        for labels in now {
            self.models.with_label_values(&values(labels)).set(1);
        }
        let mut retired = self.retired();
        for labels in before.iter().filter(|labels| !now.contains(labels)) {
            // Fails only if the series does not exist.
            let _ = self.models.remove_label_values(&values(labels));
            // A file with the same name and version continues the series.
            if !now.iter().any(|other| other.model == labels.model) {
                retired.push((labels.model.clone(), Instant::now()));
            }
        }
    }

    fn reloaded(&self, outcome: Reload) {
        let name = match outcome {
            Reload::Read { rejected: 0 } => "ok",
            Reload::Read { .. } | Reload::Failed => "failed",
            Reload::Superseded => "superseded",
        };
        self.reloads.with_label_values(&[name]).inc();
        if let Reload::Read { rejected } = outcome {
            self.rejected.set(rejected as i64);
        }
    }
}

/// The labels of `graspd_model_info`.
fn values(ModelLabels { model, provider, precision, sha256 }: &ModelLabels) -> [&str; 4] {
    [model, provider, precision, sha256]
}

impl Metrics {
    /// Content type of [`render`](Self::render).
    pub const CONTENT_TYPE: &str = TEXT_FORMAT;

    /// `dropped` counts the lines that the log has lost, `suppressed` those beyond its rate.
    pub fn new(dropped: ErrorCounter, suppressed: IntCounter) -> Self {
        let registry = Registry::new();
        let counter = |name, help| register(&registry, IntCounter::new(name, help));
        let gauge = |name, help| register(&registry, IntGauge::new(name, help));
        let counters = |name, help, labels| register(&registry, IntCounterVec::new(Opts::new(name, help), labels));
        let gauges = |name, help, labels| register(&registry, IntGaugeVec::new(Opts::new(name, help), labels));
        let histograms = |name, help, labels, buckets: &[f64]| {
            register(&registry, HistogramVec::new(HistogramOpts::new(name, help).buckets(buckets.to_vec()), labels))
        };
        // CPU time, memory and open files of the process.
        #[cfg(target_os = "linux")]
        registry.register(Box::new(ProcessCollector::for_self())).expect(VALID);
        registry.register(Box::new(suppressed)).expect(VALID);
        let metrics = Self {
            stages: histograms(
                "graspd_stage_duration_seconds",
                "Duration of each stage of a request.",
                &["model", "stage"],
                &BUCKETS,
            ),
            requests: counters("graspd_requests_total", "Requests by gRPC status code.", &["model", "code"]),
            grasps: counters("graspd_grasps_total", "Grasps returned to clients.", &["model"]),
            warnings: counters(
                "graspd_warnings_total",
                "Signs that the geometry of a request is wrong, by the code of the warning.",
                &["model", "code"],
            ),
            refused: counters(
                "graspd_refusals_total",
                "Requests refused by a queue: it was full, the reply would have been too late, or another caller's \
                 request displaced it.",
                &["model", "reason"],
            ),
            queued: counters(
                "graspd_queued_total",
                "Scenes that a queue has accepted, by the priority of the request.",
                &["model", "priority"],
            ),
            waiting: gauges(
                "graspd_queue_requests",
                "Queued requests; a request whose workspace has several cubes counts once per cube.",
                &["model"],
            ),
            batches: histograms("graspd_batch_size", "Volumes per batch.", &["model"], &BATCHES),
            models: gauges(
                "graspd_model_info",
                "1 for each served model, with its provider, precision and file hash.",
                &["model", "provider", "precision", "sha256"],
            ),
            reloads: counters(
                "graspd_reloads_total",
                "Reloads of the model folder: ok; failed if any file could not be loaded, or in time; superseded by a later one.",
                &["outcome"],
            ),
            rejected: gauge("graspd_rejected_files", "Model files that could not be loaded at the last reload."),
            connections: gauges("graspd_connections", "Open connections.", &["listener"]),
            receiving: gauge("graspd_receiving_bytes", "Received bytes of messages that are not complete yet."),
            receiving_limit: gauge("graspd_receiving_limit_bytes", "Maximum of graspd_receiving_bytes."),
            connections_limit: gauges("graspd_connections_limit", "Maximum number of open connections.", &["listener"]),
            connections_refused: counters(
                "graspd_connections_refused_total",
                "Connections refused because the limit was reached.",
                &["listener"],
            ),
            certificate: gauge(
                "graspd_certificate_expiry_seconds",
                "When the certificate of --tls-cert expires, seconds since 1970; 0 without TLS.",
            ),
            ready: gauge("graspd_ready", "1 while the server accepts requests, 0 during startup and shutdown."),
            tracked: gauge(
                "graspd_tracked_volumes",
                "Volumes that open TrackGrasps streams keep, one for each cube of their workspaces.",
            ),
            hanging: gauges(
                "graspd_hanging_sessions",
                "Sessions whose inference takes longer than --inference-timeout.",
                &["model"],
            ),
            recordings: counters(
                "graspd_recordings_total",
                "Recorded requests (--record): written; dropped because the disk is too slow; failed.",
                &["outcome"],
            ),
            retired: Mutex::default(),
            dropped_lines: counter(
                "graspd_log_lines_dropped_total",
                "Log lines dropped because stderr was not read fast enough.",
            ),
            dropped: (dropped, AtomicU64::new(0)),
            registry,
        };
        // Series start at 0, so that `increase()` includes the first event.
        for outcome in ["ok", "failed", "superseded"] {
            metrics.reloads.with_label_values(&[outcome]);
        }
        metrics
    }

    /// Records a request that succeeded.
    pub fn succeeded(&self, model: &str, timings: &StageTimings, grasps: usize) {
        for (stage, seconds) in timings.stages() {
            self.stages.with_label_values(&[model, stage]).observe(seconds);
        }
        self.grasps.with_label_values(&[model]).inc_by(grasps as u64);
        self.ended(model, Code::Ok);
    }

    /// Counts a request that ended with this status.
    pub fn ended(&self, model: &str, code: Code) {
        self.requests.with_label_values(&[model, code_name(code)]).inc();
    }

    /// Counts a warning in a response.
    pub fn warned(&self, model: &str, code: WarningCode) {
        self.warnings.with_label_values(&[model, warning_name(code)]).inc();
    }

    /// Removes the series of the models that have not been served for [`RETENTION`].
    fn remove_retired(&self, now: Instant) {
        let expired: Vec<String> = self
            .retired()
            .extract_if(.., |(_, since)| now.duration_since(*since) >= RETENTION)
            .map(|(model, _)| model)
            .collect();
        if expired.is_empty() {
            return;
        }
        let Self { stages, requests, grasps, warnings, refused, queued, waiting, batches, hanging, .. } = self;
        for model in &expired {
            for counters in [requests, grasps, warnings, refused, queued] {
                remove(counters, model, |labels| counters.remove(labels));
            }
            for gauges in [waiting, hanging] {
                remove(gauges, model, |labels| gauges.remove(labels));
            }
            for histograms in [stages, batches] {
                remove(histograms, model, |labels| histograms.remove(labels));
            }
        }
    }

    fn retired(&self) -> MutexGuard<'_, Vec<(String, Instant)>> {
        self.retired.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A limit on the open connections of a listener (`grpc`, `http` or `rest`), with its metrics.
    pub fn connections(&self, listener: &str, limit: usize) -> ConnectionLimit {
        self.connections_limit.with_label_values(&[listener]).set(i64::try_from(limit).unwrap_or(i64::MAX));
        let open = self.connections.with_label_values(&[listener]);
        ConnectionLimit::new(limit, open, self.connections_refused.with_label_values(&[listener]))
    }

    /// A budget of `capacity` bytes for messages that are being received, with its metrics.
    pub fn receiving(&self, capacity: usize) -> Arc<ReceiveBudget> {
        self.receiving_limit.set(i64::try_from(capacity).unwrap_or(i64::MAX));
        ReceiveBudget::new(capacity, self.receiving.clone())
    }

    /// Records when the server's certificate expires, seconds since 1970.
    pub fn certificate(&self, expiry: i64) {
        self.certificate.set(expiry);
    }

    /// The counter of recorded requests by outcome.
    pub fn recordings(&self) -> IntCounterVec {
        self.recordings.clone()
    }

    /// The gauge of the volumes that open TrackGrasps streams keep.
    pub fn tracked(&self) -> IntGauge {
        self.tracked.clone()
    }

    /// The metrics in Prometheus' text format.
    pub fn render(&self, state: State) -> String {
        self.ready.set((state == State::Ready).into());
        self.remove_retired(Instant::now());
        let (lines, counted) = &self.dropped;
        let lines = lines.dropped_lines() as u64;
        // `fetch_max` keeps concurrent scrapes from counting the same lines twice.
        self.dropped_lines.inc_by(lines.saturating_sub(counted.fetch_max(lines, Ordering::Relaxed)));
        TextEncoder::new().encode_to_string(&self.registry.gather()).expect("the encoder writes to memory")
    }
}

/// Adds a metric to the registry.
fn register<M: Collector + Clone + 'static>(registry: &Registry, metric: prometheus::Result<M>) -> M {
    let metric = metric.expect(VALID);
    registry.register(Box::new(metric.clone())).expect(VALID);
    metric
}

/// Removes the series of a model from a metric.
fn remove(metric: &dyn Collector, model: &str, series: impl Fn(&HashMap<&str, &str>) -> prometheus::Result<()>) {
    let families = metric.collect();
    for series_of in families.iter().flat_map(|family| family.get_metric()) {
        let labels: HashMap<&str, &str> =
            series_of.get_label().iter().map(|label| (label.name(), label.value())).collect();
        if labels.get("model") == Some(&model) {
            // Fails only if another scrape has removed it.
            let _ = series(&labels);
        }
    }
}

/// The name of a warning's code without its prefix, for example `TABLE_TILTED`.
fn warning_name(code: WarningCode) -> &'static str {
    code.as_str_name().trim_start_matches("CODE_")
}

/// The name of a status code in the gRPC specification, for the codes that this server returns.
pub(crate) fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::NotFound => "NOT_FOUND",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::Unauthenticated => "UNAUTHENTICATED",
        Code::Unavailable => "UNAVAILABLE",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::Internal => "INTERNAL",
        _ => "UNKNOWN",
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    fn metrics() -> Metrics {
        let (log, _guard) = tracing_appender::non_blocking(io::sink());
        Metrics::new(log.error_counter(), IntCounter::new("suppressed", "Lines.").unwrap())
    }

    #[test]
    fn the_series_of_a_model_that_is_no_longer_served_are_removed_after_a_while() {
        let metrics = metrics();
        let labels = |model: &str| {
            let [provider, precision, sha256] = ["cpu", "fp32", "0"].map(str::to_owned);
            ModelLabels { model: model.to_owned(), provider, precision, sha256 }
        };
        let served = [labels("a 1"), labels("b 1")];
        for ModelLabels { model, .. } in &served {
            metrics.model(model);
            metrics.succeeded(model, &StageTimings::default(), 3);
        }
        metrics.replaced(&[], &served);
        let mentions = |model: &str| {
            metrics.render(State::Ready).lines().filter(|line| line.contains(&format!("model=\"{model}\""))).count()
        };
        let (a, b) = (mentions("a 1"), mentions("b 1"));
        assert!(a > 30 && a == b, "{a} {b}");
        metrics.replaced(&served, &served[1..]);
        let soon = Instant::now() + RETENTION / 2;
        metrics.remove_retired(soon);
        assert_eq!(mentions("a 1"), a - 1, "only its graspd_model_info is gone");
        metrics.remove_retired(soon + RETENTION);
        assert_eq!((mentions("a 1"), mentions("b 1")), (0, b));

        // A model that returns in time keeps its series.
        metrics.replaced(&served[1..], &[]);
        metrics.model("b 1");
        metrics.remove_retired(soon + RETENTION);
        assert_eq!(mentions("b 1"), b - 1);
    }
}
