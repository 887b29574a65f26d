use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The retry hints of refused requests. Successive hints differ, so that the retries do not arrive together.
#[derive(Default)]
pub(crate) struct RetryHints {
    /// The latest time of a retry that was hinted.
    last: Mutex<Option<Instant>>,
}

/// Shortest hint, and the unit of hints.
const SHORTEST: Duration = Duration::from_millis(1);

/// Distance between two retries, relative to the time between two free places: some requests come from other callers.
const SPACING: f64 = 1.25;

/// Longest hint, relative to the time in which a full queue is served.
const LONGEST: u32 = 4;

impl RetryHints {
    /// How long the next refused caller should wait. A place in the queue becomes free every `pace`; a full queue has
    /// `places`.
    pub fn next(&self, pace: Duration, places: u32, now: Instant) -> Duration {
        let step = pace.mul_f64(SPACING).max(SHORTEST);
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let mut next = last.map_or(now, |last| last.max(now)) + step;
        if next > now + step * places * LONGEST {
            next = now + step;
        }
        *last = Some(next);
        next - now
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn retries_are_spread_over_the_time_in_which_places_become_free() {
        let (retry_hints, now) = (RetryHints::default(), Instant::now());
        let pace = Duration::from_millis(8);
        let hints: Vec<u128> = (0..41).map(|_| retry_hints.next(pace, 10, now).as_millis()).collect();
        let spread: Vec<u128> = (1..=40).map(|index| 10 * index).collect();
        assert_eq!(hints[..40], spread);
        assert_eq!(hints[40], 10, "after four lengths of the queue they start again");
        // After the hinted times have passed, the hint is short again.
        assert_eq!(retry_hints.next(pace, 10, now + Duration::from_secs(1)).as_millis(), 10);
        assert_eq!(RetryHints::default().next(Duration::ZERO, 1, now), SHORTEST);
    }
}
