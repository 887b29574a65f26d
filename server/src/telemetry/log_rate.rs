//! A limit on the rate of log lines, so that a flood of refused requests does not flood the log.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use prometheus::IntCounter;
use tracing::callsite::Identifier;
use tracing::{Event, Level, Metadata, warn};
use tracing_subscriber::layer::{Context, Filter};

/// Lines per second of each place in the code that writes lines.
const LINES: u64 = 50;

/// Interval at which suppressed lines are reported.
const REPORT: Duration = Duration::from_secs(10);

/// A log filter that suppresses lines of a place in the code beyond [`LINES`] per second. Lines at the levels `debug`
/// and `trace` are written only on request, and are not limited, except those of the HTTP/2 library.
#[derive(Clone)]
pub(super) struct LogRate {
    places: Arc<Mutex<HashMap<Identifier, Place>>>,
    suppressed: IntCounter,
}

/// A place in the code that writes lines.
struct Place {
    metadata: &'static Metadata<'static>,
    /// The start of the current second.
    second: Instant,
    /// Lines in it.
    lines: u64,
    /// Lines suppressed since the last report.
    suppressed: u64,
}

impl LogRate {
    /// `suppressed` counts the suppressed lines.
    pub fn new(suppressed: IntCounter) -> Self {
        Self { places: Arc::default(), suppressed }
    }

    /// Whether a line at `now` is written.
    fn admits(&self, metadata: &'static Metadata<'static>, now: Instant) -> bool {
        let mut places = self.places();
        let new = || Place { metadata, second: now, lines: 0, suppressed: 0 };
        let place = places.entry(metadata.callsite()).or_insert_with(new);
        if now.duration_since(place.second) >= Duration::from_secs(1) {
            (place.second, place.lines) = (now, 0);
        }
        place.lines += 1;
        let is_admitted = place.lines <= LINES;
        if !is_admitted {
            place.suppressed += 1;
            self.suppressed.inc();
        }
        is_admitted
    }

    /// Reports the suppressed lines; never returns.
    pub async fn report(self) {
        let mut interval = tokio::time::interval(REPORT);
        loop {
            interval.tick().await;
            for (metadata, lines) in self.take_suppressed() {
                let (module, line) = (metadata.target(), metadata.line());
                warn!(lines, module, line, "log lines suppressed: more than {LINES} per second");
            }
        }
    }

    fn take_suppressed(&self) -> Vec<(&'static Metadata<'static>, u64)> {
        let mut places = self.places();
        let taken = places.values_mut().map(|place| (place.metadata, std::mem::take(&mut place.suppressed)));
        taken.filter(|(_, lines)| *lines > 0).collect()
    }

    fn places(&self) -> MutexGuard<'_, HashMap<Identifier, Place>> {
        self.places.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<S> Filter<S> for LogRate {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let metadata = event.metadata();
        let is_limited = *metadata.level() <= Level::INFO || metadata.target().starts_with("h2");
        !is_limited || self.admits(metadata, Instant::now())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_place_writes_at_most_its_lines_in_a_second_and_the_others_are_counted() {
        let metadata = || {
            let span = tracing::info_span!("place");
            span.metadata().expect("spans are enabled")
        };
        let _subscriber = tracing::subscriber::set_default(tracing_subscriber::registry());
        let suppressed = IntCounter::new("suppressed", "Lines.").unwrap();
        let rate = LogRate::new(suppressed.clone());
        let (place, now) = (metadata(), Instant::now());
        let admitted = |at: Instant| (0..LINES + 10).filter(|_| rate.admits(place, at)).count() as u64;
        assert_eq!(admitted(now), LINES);
        assert_eq!(admitted(now + Duration::from_millis(999)), 0);
        assert_eq!(suppressed.get(), LINES + 20);
        assert_eq!(rate.take_suppressed().iter().map(|(_, lines)| *lines).collect::<Vec<_>>(), [LINES + 20]);
        assert_eq!(admitted(now + Duration::from_secs(1)), LINES);
        let other = { tracing::info_span!("other") };
        assert!(rate.admits(other.metadata().unwrap(), now));
    }
}
