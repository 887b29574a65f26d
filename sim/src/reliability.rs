//! Reliability: does a grasp of quality 0.9 lift its object nine times in ten?

use serde::{Deserialize, Serialize};

/// An executed grasp, as `bench --attempts` and `sim/pybullet/clear.py --attempts` write it; both have more fields.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Attempt {
    /// What the planner promised.
    pub quality: f64,
    /// Whether it lifted an object.
    #[serde(rename = "outcome", deserialize_with = "is_lifted")]
    pub lifted: bool,
}

fn is_lifted<'a, D: serde::Deserializer<'a>>(outcome: D) -> Result<bool, D::Error> {
    Ok(String::deserialize(outcome)? == "lifted")
}

/// Attempts whose quality is in one bin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Bin {
    /// How many.
    pub attempts: u64,
    /// How many of them lifted an object.
    pub lifted: u64,
    /// Mean of their qualities; 0 of none.
    pub quality: f64,
}

/// Quality against success.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reliability {
    /// Bins of equal width, over qualities from 0 to 1.
    pub bins: Vec<Bin>,
    /// Expected calibration error: the mean difference between a bin's quality and its share of successes, weighted by its
    /// attempts (Guo et al. 2017, equation 3).
    pub error: f64,
    /// All attempts in one bin.
    pub whole: Bin,
}

/// Bins of a diagram.
const BINS: usize = 20;

impl Reliability {
    /// Of these attempts.
    #[must_use]
    pub fn of(attempts: &[Attempt]) -> Self {
        let bin = |attempts: &mut dyn Iterator<Item = &Attempt>| {
            let mut bin = attempts.fold(Bin::default(), |bin, attempt| Bin {
                attempts: bin.attempts + 1,
                lifted: bin.lifted + u64::from(attempt.lifted),
                quality: bin.quality + attempt.quality,
            });
            bin.quality /= bin.attempts.max(1) as f64;
            bin
        };
        let place = |attempt: &Attempt| ((attempt.quality * BINS as f64) as usize).min(BINS - 1);
        let bins: Vec<Bin> =
            (0..BINS).map(|index| bin(&mut attempts.iter().filter(|attempt| place(attempt) == index))).collect();
        let off = |bin: &Bin| bin.attempts as f64 * bin.quality - bin.lifted as f64;
        let error = bins.iter().map(|bin| off(bin).abs()).sum::<f64>() / attempts.len().max(1) as f64;
        Self { bins, error, whole: bin(&mut attempts.iter()) }
    }
}

impl Bin {
    /// The share of the attempts that lifted an object, and its 95 % interval, which is right near 0 and 1 too
    /// (Wilson 1927); `None` of none.
    #[must_use]
    pub fn share(&self) -> Option<(f64, [f64; 2])> {
        const Z: f64 = 1.96;
        let n = self.attempts as f64;
        let share = self.lifted as f64 / n;
        let middle = (share + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
        let half = Z / (1.0 + Z * Z / n) * (share * (1.0 - share) / n + Z * Z / (4.0 * n * n)).sqrt();
        (self.attempts > 0).then_some((share, [middle - half, middle + half]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attempts(quality: f64, all: u64, lifted: u64) -> impl Iterator<Item = Attempt> {
        (0..all).map(move |number| Attempt { quality, lifted: number < lifted })
    }

    #[test]
    fn what_is_promised_and_kept_has_no_error() {
        let honest: Vec<Attempt> = attempts(0.75, 8, 6).chain(attempts(0.52, 100, 52)).collect();
        let found = Reliability::of(&honest);
        assert!(found.error < 1e-12, "{}", found.error);
        assert_eq!((found.whole.attempts, found.whole.lifted), (108, 58));
        // One part of ten promises 0.2 too much, the others 0.1 too little.
        let other: Vec<Attempt> = attempts(1.0, 10, 8).chain(attempts(0.6, 90, 63)).collect();
        assert!((Reliability::of(&other).error - (0.1 * 0.2 + 0.9 * 0.1)).abs() < 1e-12);
        assert_eq!(Reliability::of(&other).bins[BINS - 1].attempts, 10, "1 is in the last bin");
        assert_eq!(Reliability::of(&[]).error, 0.0);
    }

    #[test]
    fn intervals_are_wilsons() {
        // 5 of 10: 0.2366 to 0.7634, a textbook's figures.
        let (share, [low, high]) = Bin { attempts: 10, lifted: 5, quality: 0.5 }.share().unwrap();
        assert!(share == 0.5 && (low - 0.2366).abs() < 1e-4 && (high - 0.7634).abs() < 1e-4, "{low} {high}");
        assert_eq!(Bin::default().share(), None);
    }
}
