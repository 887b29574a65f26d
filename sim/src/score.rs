//! Figures of the benchmark.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::benchmark::{Attempt, Ending, Round};
use crate::trial::Outcome;

/// The benchmark's figures over all rounds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Rounds.
    pub rounds: usize,
    /// Objects at the start of the rounds.
    pub objects: usize,
    /// Executed grasps.
    pub attempts: usize,
    /// Lifted objects.
    pub successes: usize,
    /// Grasp success rate: successes / attempts.
    pub gsr: f64,
    /// Declutter rate: successes / objects.
    pub dr: f64,
    /// Distance of `gsr` from the farther end of its 95 % interval.
    pub gsr_interval: f64,
    /// Distance of `dr` from the farther end of its 95 % interval.
    pub dr_interval: f64,
    /// Attempts by the room beside each finger of the open hand ([`Attempt::room`]): none, 0 to 4 mm, 4 to 8 mm, 8 mm and
    /// more.
    #[serde(default)]
    pub by_room: [OfRoom; 4],
    /// Failed attempts with a contact at the pre-grasp.
    pub blocked_at_pregrasp: usize,
    /// Empty grasps.
    pub closed_on_nothing: usize,
    /// Attempts that lost the object during the lift.
    pub lost_in_lift: usize,
    /// Failures in which the hand closed short of the grasp because of a contact. They are included in the three above.
    pub stopped_short: usize,
    /// Rounds that ended with an empty table.
    pub cleared: usize,
    /// Rounds that ended because the cameras saw no object.
    pub nothing_seen: usize,
    /// Rounds that ended because the planner proposed no grasp.
    pub nothing_proposed: usize,
    /// Rounds that ended after two consecutive failures.
    pub gave_up: usize,
    /// Median fusion time of an observation, milliseconds.
    pub fusion_p50_ms: f64,
    /// 95th percentile of the fusion time, milliseconds.
    pub fusion_p95_ms: f64,
    /// Median planning time, milliseconds.
    pub planning_p50_ms: f64,
    /// 95th percentile of the planning time, milliseconds.
    pub planning_p95_ms: f64,
}

/// Attempts on objects that leave a similar room beside the fingers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OfRoom {
    /// Executed grasps.
    pub attempts: usize,
    /// Lifted objects.
    pub successes: usize,
}

/// Bounds between the rooms of [`Summary::by_room`], metres.
const ROOMS: [f64; 3] = [0.0, 0.004, 0.008];

impl OfRoom {
    fn all(attempts: &[Attempt]) -> [Self; 4] {
        let mut all = [Self::default(); 4];
        for Attempt { outcome, room, .. } in attempts {
            let Some(room) = room else { continue };
            let of = &mut all[ROOMS.iter().filter(|bound| room >= bound).count()];
            of.attempts += 1;
            of.successes += usize::from(outcome.is_success());
        }
        all
    }
}

impl Summary {
    /// Pools the rounds, as in the papers.
    #[must_use]
    pub fn new(rounds: &[Round]) -> Self {
        let attempts: Vec<Attempt> = rounds.iter().flat_map(|round| round.attempts.iter().copied()).collect();
        let count = |wanted: fn(&Outcome) -> bool| attempts.iter().filter(|attempt| wanted(&attempt.outcome)).count();
        let ended = |ending: Ending| rounds.iter().filter(|round| round.ending == ending).count();
        let objects = rounds.iter().map(|round| round.objects).sum();
        let successes = count(Outcome::is_success);
        let (gsr, gsr_interval) = proportion(successes, attempts.len());
        let (dr, dr_interval) = proportion(successes, objects);
        let fusion = Milliseconds::new(rounds.iter().flat_map(|round| &round.fusion));
        let planning = Milliseconds::new(rounds.iter().flat_map(|round| &round.planning));
        Self {
            rounds: rounds.len(),
            objects,
            attempts: attempts.len(),
            successes,
            gsr,
            dr,
            gsr_interval,
            dr_interval,
            by_room: OfRoom::all(&attempts),
            blocked_at_pregrasp: count(|o| *o == Outcome::BlockedAtPregrasp),
            closed_on_nothing: count(|o| *o == Outcome::ClosedOnNothing),
            lost_in_lift: count(|o| *o == Outcome::LostInLift),
            stopped_short: attempts
                .iter()
                .filter(|attempt| {
                    !attempt.outcome.is_success()
                        && attempt.outcome != Outcome::BlockedAtPregrasp
                        && attempt.short_by > 1e-6
                })
                .count(),
            cleared: ended(Ending::Cleared),
            nothing_seen: ended(Ending::NothingSeen),
            nothing_proposed: ended(Ending::NothingProposed),
            gave_up: ended(Ending::GaveUp),
            fusion_p50_ms: fusion.percentile(0.5),
            fusion_p95_ms: fusion.percentile(0.95),
            planning_p50_ms: planning.percentile(0.5),
            planning_p95_ms: planning.percentile(0.95),
        }
    }
}

/// A proportion, and its distance from the farther end of its [`wilson`] interval; 0 and 1 for no attempts.
fn proportion(part: usize, whole: usize) -> (f64, f64) {
    if whole == 0 {
        return (0.0, 1.0);
    }
    let share = part as f64 / whole as f64;
    let [low, high] = wilson(part as u64, whole as u64);
    (share, (share - low).max(high - share))
}

/// The 95 % Wilson score interval of a proportion (Wilson 1927), which is also valid near 0 and 1. NaN without attempts.
#[must_use]
pub fn wilson(part: u64, whole: u64) -> [f64; 2] {
    const Z: f64 = 1.96;
    let n = whole as f64;
    let share = part as f64 / n;
    let middle = (share + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (share * (1.0 - share) / n + Z * Z / (4.0 * n * n)).sqrt();
    [middle - half, middle + half]
}

/// A figure over several seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation; `None` for a single value.
    pub std: Option<f64>,
    /// Number of values.
    pub n: usize,
}

impl Spread {
    /// The spread of these values; `None` without values.
    #[must_use]
    pub fn new(values: &[f64]) -> Option<Self> {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let std = (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt());
        (!values.is_empty()).then_some(Self { mean, std, n: values.len() })
    }

    /// As a percentage: `79.7 ± 2.0`.
    #[must_use]
    pub fn percent(&self) -> String {
        let std = self.std.map_or_else(String::new, |std| format!(" ± {:.1}", std * 100.0));
        format!("{:.1}{std}", self.mean * 100.0)
    }
}

/// Sorted durations, milliseconds.
struct Milliseconds(Vec<f64>);

impl Milliseconds {
    fn new<'a>(durations: impl Iterator<Item = &'a Duration>) -> Self {
        let mut sorted: Vec<f64> = durations.map(|duration| duration.as_secs_f64() * 1e3).collect();
        sorted.sort_by(f64::total_cmp);
        Self(sorted)
    }

    /// The value below which this share lies; 0 without values.
    fn percentile(&self, share: f64) -> f64 {
        let rank = (share * self.0.len() as f64) as usize;
        self.0.get(rank.min(self.0.len().saturating_sub(1))).copied().unwrap_or(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_attempts_have_wide_intervals() {
        let (share, interval) = proportion(3, 3);
        assert_eq!(share, 1.0);
        assert!((interval - 0.561).abs() < 1e-3, "{interval}");
        let (share, interval) = proportion(800, 1000);
        assert!(share == 0.8 && (interval - 0.0259).abs() < 1e-3, "{interval}");
        assert_eq!(proportion(0, 0), (0.0, 1.0));
    }

    #[test]
    fn seeds_are_averaged() {
        assert_eq!(Spread::new(&[]), None);
        assert_eq!(Spread::new(&[0.5]), Some(Spread { mean: 0.5, std: None, n: 1 }));
        let two = Spread::new(&[0.1, 0.3]).unwrap();
        assert_eq!(two.percent(), "20.0 ± 14.1");
    }

    #[test]
    fn percentiles_are_measured_values() {
        let durations: Vec<Duration> = (1..=100).rev().map(Duration::from_millis).collect();
        let sorted = Milliseconds::new(durations.iter());
        assert_eq!((sorted.percentile(0.5), sorted.percentile(0.95), sorted.percentile(1.0)), (51.0, 96.0, 100.0));
        assert_eq!(Milliseconds::new([].iter()).percentile(0.5), 0.0);
    }
}
