use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Durations of a request's stages.
#[derive(Clone, Copy, Debug, Default)]
pub struct StageTimings {
    /// Waiting for a session, and for the conversion.
    pub queue: Duration,
    /// Decoding and checks of the message.
    pub preprocessing: Duration,
    /// None for requests that contain a volume.
    pub fusion: Option<Duration>,
    /// The network.
    pub inference: Duration,
    /// None for models without an evaluator.
    pub evaluation: Option<Duration>,
    /// Decoding of the network's output.
    pub postprocessing: Duration,
    /// From the complete message to the reply.
    pub total: Duration,
}

impl StageTimings {
    /// Name and duration of each stage, seconds.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let stages = [
            ("queue", Some(self.queue)),
            ("preprocessing", Some(self.preprocessing)),
            ("fusion", self.fusion),
            ("inference", Some(self.inference)),
            ("evaluation", self.evaluation),
            ("postprocessing", Some(self.postprocessing)),
            ("total", Some(self.total)),
        ];
        stages.into_iter().filter_map(|(stage, duration)| Some((stage, duration?.as_secs_f64())))
    }
}

/// Numbers and durations of a model's requests since it has been served.
#[derive(Debug, Default)]
pub struct Statistics {
    succeeded: AtomicU64,
    failed: AtomicU64,
    batches: AtomicU64,
    volumes: AtomicU64,
    queue: AtomicU64,
    preprocessing: AtomicU64,
    inference: AtomicU64,
    output: AtomicU64,
    total: AtomicU64,
}

/// A snapshot of [`Statistics`]. Durations are sums over the requests that succeeded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Requests with a result.
    pub succeeded: u64,
    /// Requests without a result.
    pub failed: u64,
    /// Batches that sessions have computed.
    pub batches: u64,
    /// Volumes in these batches.
    pub volumes: u64,
    /// Waiting.
    pub queue: Duration,
    /// Decoding and checks of the messages.
    pub preprocessing: Duration,
    /// The network.
    pub inference: Duration,
    /// All work on the outputs of the network.
    pub output: Duration,
    /// From the complete message to the reply.
    pub total: Duration,
}

impl Statistics {
    /// Adds a request that succeeded.
    pub fn succeeded(&self, timings: &StageTimings) {
        let add = |sum: &AtomicU64, duration: Duration| {
            sum.fetch_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX), Ordering::Relaxed);
        };
        add(&self.queue, timings.queue);
        add(&self.preprocessing, timings.preprocessing);
        add(&self.inference, timings.inference);
        add(&self.output, timings.postprocessing + timings.evaluation.unwrap_or_default());
        add(&self.total, timings.total);
        self.succeeded.fetch_add(1, Ordering::Relaxed);
    }

    /// Adds a request that ended without a result.
    pub fn failed(&self) {
        self.failed.fetch_add(1, Ordering::Relaxed);
    }

    /// Adds a batch.
    pub(crate) fn batch(&self, volumes: usize) {
        self.batches.fetch_add(1, Ordering::Relaxed);
        self.volumes.fetch_add(volumes as u64, Ordering::Relaxed);
    }

    /// The numbers and durations now.
    pub fn totals(&self) -> Totals {
        let count = |sum: &AtomicU64| sum.load(Ordering::Relaxed);
        let time = |sum: &AtomicU64| Duration::from_nanos(count(sum));
        Totals {
            succeeded: count(&self.succeeded),
            failed: count(&self.failed),
            batches: count(&self.batches),
            volumes: count(&self.volumes),
            queue: time(&self.queue),
            preprocessing: time(&self.preprocessing),
            inference: time(&self.inference),
            output: time(&self.output),
            total: time(&self.total),
        }
    }
}
