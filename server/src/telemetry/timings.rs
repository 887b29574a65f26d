use std::time::Duration;

use grasp_proto::pb;
use tracing::Span;

/// Durations of a request's stages, used for the response's latency, the span's fields and the histograms.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StageTimings {
    pub queue: Duration,
    pub preprocessing: Duration,
    /// None for requests that contain a volume.
    pub fusion: Option<Duration>,
    pub inference: Duration,
    /// None for models without an evaluator.
    pub evaluation: Option<Duration>,
    pub postprocessing: Duration,
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

    /// Records the durations in the fields of the request's span.
    pub fn record(&self, span: &Span) {
        for (stage, seconds) in self.stages() {
            span.record(stage, seconds);
        }
    }
}

impl From<&StageTimings> for pb::Latency {
    fn from(timings: &StageTimings) -> Self {
        Self {
            queue: timings.queue.as_secs_f64(),
            preprocessing: timings.preprocessing.as_secs_f64(),
            fusion: timings.fusion.unwrap_or_default().as_secs_f64(),
            inference: timings.inference.as_secs_f64(),
            evaluation: timings.evaluation.unwrap_or_default().as_secs_f64(),
            postprocessing: timings.postprocessing.as_secs_f64(),
            total: timings.total.as_secs_f64(),
        }
    }
}
