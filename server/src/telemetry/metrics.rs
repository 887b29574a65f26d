use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use grasp_models::Backend;
#[cfg(target_os = "linux")]
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry, TEXT_FORMAT,
    TextEncoder,
};
use tonic::Code;
use tracing_appender::non_blocking::ErrorCounter;

use crate::readiness::State;
use crate::serving::engine::{Engine, Gauges};
use crate::telemetry::timings::StageTimings;
use crate::transport::connections::ConnectionLimit;

/// Seconds. Dense from a cached wake-up to a large network on a slow CPU, whose queue is full.
const BUCKETS: [f64; 33] = [
    50e-6, 75e-6, 100e-6, 150e-6, 200e-6, 300e-6, 500e-6, 750e-6, 1e-3, 1.5e-3, 2e-3, 3e-3, 5e-3, 7.5e-3, 10e-3, 15e-3,
    20e-3, 30e-3, 50e-3, 75e-3, 100e-3, 150e-3, 200e-3, 300e-3, 500e-3, 750e-3, 1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0,
];

/// Volumes.
const BATCHES: [f64; 9] = [1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 32.0, 64.0];

/// What Prometheus sees. A model is labelled `name version`; requests that reached no model have an empty label.
pub(crate) struct Metrics {
    registry: Registry,
    stages: HistogramVec,
    requests: IntCounterVec,
    grasps: IntCounterVec,
    waiting: IntGaugeVec,
    batches: HistogramVec,
    models: IntGaugeVec,
    reloads: IntCounterVec,
    rejected: IntGauge,
    connections: IntGauge,
    connections_limit: IntGauge,
    connections_refused: IntCounter,
    ready: IntGauge,
    tracked: IntGauge,
    dropped_lines: IntCounter,
    /// Of which `dropped_lines` has counted so many.
    dropped: (ErrorCounter, AtomicU64),
}

impl Metrics {
    /// The format of [`render`](Self::render).
    pub const CONTENT_TYPE: &str = TEXT_FORMAT;

    /// `dropped`: the lines that the log lost.
    pub fn new(dropped: ErrorCounter) -> Self {
        const VALID: &str = "the names below are valid and differ";
        let stages = HistogramOpts::new("graspd_stage_duration_seconds", "Time a request spent in each stage.");
        let metrics = Self {
            registry: Registry::new(),
            stages: HistogramVec::new(stages.buckets(BUCKETS.to_vec()), &["model", "stage"]).expect(VALID),
            requests: IntCounterVec::new(
                Opts::new("graspd_requests_total", "Requests by their outcome, a gRPC status code."),
                &["model", "code"],
            )
            .expect(VALID),
            grasps: IntCounterVec::new(Opts::new("graspd_grasps_total", "Grasps sent."), &["model"]).expect(VALID),
            waiting: IntGaugeVec::new(
                Opts::new("graspd_queue_requests", "Requests waiting for a session."),
                &["model"],
            )
            .expect(VALID),
            batches: HistogramVec::new(
                HistogramOpts::new("graspd_batch_size", "Volumes that a session took at once.")
                    .buckets(BATCHES.to_vec()),
                &["model"],
            )
            .expect(VALID),
            models: IntGaugeVec::new(
                Opts::new("graspd_model_info", "1 for each model that is served: what runs it, in which numbers."),
                &["model", "provider", "precision", "sha256"],
            )
            .expect(VALID),
            reloads: IntCounterVec::new(
                Opts::new(
                    "graspd_reloads_total",
                    "How often the folder of models was read anew: ok, or failed where not all of it can be served.",
                ),
                &["outcome"],
            )
            .expect(VALID),
            rejected: IntGauge::new(
                "graspd_rejected_files",
                "Model files that cannot be served, as of the last reload.",
            )
            .expect(VALID),
            connections: IntGauge::new("graspd_connections", "Connections to the gRPC listener that are open.")
                .expect(VALID),
            connections_limit: IntGauge::new("graspd_connections_limit", "Connections that may be open.").expect(VALID),
            connections_refused: IntCounter::new(
                "graspd_connections_refused_total",
                "Connections that were closed at once, for too many were open.",
            )
            .expect(VALID),
            ready: IntGauge::new("graspd_ready", "1 while requests are taken, 0 while it warms up or shuts down.")
                .expect(VALID),
            tracked: IntGauge::new("graspd_tracked_volumes", "Volumes that are kept for calls of TrackGrasps.")
                .expect(VALID),
            dropped_lines: IntCounter::new(
                "graspd_log_lines_dropped_total",
                "Lines of the log that were lost, because it was not read as fast as it was written.",
            )
            .expect(VALID),
            dropped: (dropped, AtomicU64::new(0)),
        };
        let Self { registry, stages, requests, grasps, waiting, batches, models, reloads, rejected, .. } = &metrics;
        let Self { connections, connections_limit, connections_refused, ready, tracked, dropped_lines, .. } = &metrics;
        registry.register(Box::new(stages.clone())).expect(VALID);
        registry.register(Box::new(requests.clone())).expect(VALID);
        registry.register(Box::new(grasps.clone())).expect(VALID);
        registry.register(Box::new(waiting.clone())).expect(VALID);
        registry.register(Box::new(batches.clone())).expect(VALID);
        registry.register(Box::new(models.clone())).expect(VALID);
        registry.register(Box::new(reloads.clone())).expect(VALID);
        registry.register(Box::new(rejected.clone())).expect(VALID);
        registry.register(Box::new(connections.clone())).expect(VALID);
        registry.register(Box::new(connections_limit.clone())).expect(VALID);
        registry.register(Box::new(connections_refused.clone())).expect(VALID);
        registry.register(Box::new(ready.clone())).expect(VALID);
        registry.register(Box::new(tracked.clone())).expect(VALID);
        registry.register(Box::new(dropped_lines.clone())).expect(VALID);
        // What has not happened yet is 0, lest its first time goes unseen by who looks at increases.
        for outcome in ["ok", "failed"] {
            metrics.reloads.with_label_values(&[outcome]);
        }
        // Of the process: CPU time, memory, open files.
        #[cfg(target_os = "linux")]
        registry.register(Box::new(ProcessCollector::for_self())).expect(VALID);
        metrics
    }

    /// A request was answered.
    pub fn answered(&self, model: &str, timings: &StageTimings, grasps: usize) {
        for (stage, seconds) in timings.stages() {
            self.stages.with_label_values(&[model, stage]).observe(seconds);
        }
        self.grasps.with_label_values(&[model]).inc_by(grasps as u64);
        self.ended(model, Code::Ok);
    }

    /// A request came to an end.
    pub fn ended(&self, model: &str, code: Code) {
        self.requests.with_label_values(&[model, code_name(code)]).inc();
    }

    /// Other models are served than before.
    pub fn replaced(&self, before: &[Arc<Engine>], now: &[Arc<Engine>]) {
        let labels = |engine: &Engine| {
            let Backend { provider, precision } = engine.backend;
            [engine.label.clone(), provider.to_string(), precision.to_string(), engine.source.sha256().to_owned()]
        };
        let now: Vec<_> = now.iter().map(|engine| labels(engine)).collect();
        for labels in &now {
            self.models.with_label_values(labels).set(1);
        }
        for gone in before.iter().map(|engine| labels(engine)).filter(|labels| !now.contains(labels)) {
            // It was there, as whatever is served is.
            let _ = self.models.remove_label_values(&gone.each_ref().map(String::as_str));
        }
    }

    /// The folder of models was read anew; so many of its files, or the whole of it, cannot be served.
    pub fn reloaded(&self, outcome: Result<usize, ()>) {
        let name = if outcome == Ok(0) { "ok" } else { "failed" };
        self.reloads.with_label_values(&[name]).inc();
        if let Ok(rejected) = outcome {
            self.rejected.set(rejected as i64);
        }
    }

    /// What is measured of a model's queue.
    pub fn gauges(&self, model: &str) -> Gauges {
        for (stage, _) in StageTimings::default().stages() {
            self.stages.with_label_values(&[model, stage]);
        }
        for code in [Code::Ok, Code::Internal, Code::ResourceExhausted, Code::DeadlineExceeded, Code::Cancelled] {
            self.requests.with_label_values(&[model, code_name(code)]);
        }
        Gauges { waiting: self.waiting.with_label_values(&[model]), batch: self.batches.with_label_values(&[model]) }
    }

    /// Of connections, of which so many may be open.
    pub fn connections(&self, most: usize, patience: Duration) -> ConnectionLimit {
        self.connections_limit.set(i64::try_from(most).unwrap_or(i64::MAX));
        ConnectionLimit { most, patience, open: self.connections.clone(), refused: self.connections_refused.clone() }
    }

    /// How many volumes are kept from one view to the next.
    pub fn tracked(&self) -> IntGauge {
        self.tracked.clone()
    }

    /// In Prometheus' text format.
    pub fn render(&self, state: State) -> String {
        self.ready.set((state == State::Ready).into());
        let (lines, counted) = &self.dropped;
        let lines = lines.dropped_lines() as u64;
        // Two may look at the same time: each adds what the other has not.
        self.dropped_lines.inc_by(lines.saturating_sub(counted.fetch_max(lines, Ordering::Relaxed)));
        TextEncoder::new().encode_to_string(&self.registry.gather()).expect("the encoder writes to memory")
    }
}

/// As the gRPC specification writes it; the codes that this server ends requests with.
pub(crate) fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::NotFound => "NOT_FOUND",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::Aborted => "ABORTED",
        Code::Unauthenticated => "UNAUTHENTICATED",
        Code::Unavailable => "UNAVAILABLE",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::Internal => "INTERNAL",
        _ => "UNKNOWN",
    }
}
