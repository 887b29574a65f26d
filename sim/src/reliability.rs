//! Reliability of predicted qualities: does a grasp of quality 0.9 succeed in 90 % of its executions?

use grasp_models::Calibration;
use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

use crate::score::wilson;

/// An executed grasp as written by `bench --attempts` and `sim/pybullet/clear.py --attempts`; other fields are ignored.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Attempt {
    /// Predicted quality.
    pub quality: f64,
    /// Whether the grasp lifted an object.
    #[serde(rename = "outcome", deserialize_with = "is_lifted")]
    pub lifted: bool,
}

fn is_lifted<'a, D: serde::Deserializer<'a>>(outcome: D) -> Result<bool, D::Error> {
    Ok(String::deserialize(outcome)? == "lifted")
}

/// Attempts with a quality in one bin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Bin {
    /// Number of attempts.
    pub attempts: u64,
    /// Number of attempts that lifted an object.
    pub lifted: u64,
    /// Mean quality; 0 without attempts.
    pub quality: f64,
}

/// Reliability diagram.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reliability {
    /// Bins of equal width, over qualities from 0 to 1.
    pub bins: Vec<Bin>,
    /// Expected calibration error: the mean absolute difference between a bin's quality and its success rate, weighted
    /// by its attempts (Guo et al. 2017, equation 3).
    pub error: f64,
    /// All attempts in one bin.
    pub whole: Bin,
}

/// Number of bins.
const BINS: usize = 20;

impl Reliability {
    /// The diagram of these attempts.
    #[must_use]
    pub fn new(attempts: &[Attempt]) -> Self {
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

/// The calibration that makes the qualities of these attempts their success rate: a logistic regression on the log-odds
/// of the quality. `None` if all attempts have the same outcome or the same quality, if the success rate does not rise
/// with the quality, or if the regression does not converge.
#[must_use]
pub fn calibration(attempts: &[Attempt]) -> Option<Calibration> {
    let lifted = attempts.iter().filter(|attempt| attempt.lifted).count();
    if lifted == 0 || lifted == attempts.len() {
        return None;
    }
    // Platt's targets, which keep the regression finite.
    let [n, m] = [lifted as f64, (attempts.len() - lifted) as f64];
    let target = |attempt: &Attempt| if attempt.lifted { (n + 1.0) / (n + 2.0) } else { 1.0 / (m + 2.0) };
    let log_odds = |attempt: &Attempt| {
        let quality = attempt.quality.clamp(1e-4, 1.0 - 1e-4);
        (quality / (1.0 - quality)).ln()
    };
    let rows: Vec<Row> =
        attempts.iter().map(|attempt| (Vector2::new(log_odds(attempt), 1.0), target(attempt))).collect();
    if rows.iter().all(|(features, _)| *features == rows[0].0) {
        return None;
    }
    let weights = regression(&rows, Vector2::new(0.0, ((n + 1.0) / (m + 1.0)).ln()))?;
    Some(Calibration { slope: weights.x as f32, offset: weights.y as f32 }).filter(|found| found.slope > 0.0)
}

/// Features and target of an attempt.
type Row = (Vector2<f64>, f64);

/// The weights of a logistic regression, by Newton's method from `weights`; `None` if it does not converge. The loss is
/// convex, but a whole step can raise it.
fn regression(rows: &[Row], mut weights: Vector2<f64>) -> Option<Vector2<f64>> {
    const STEPS: usize = 50;
    const HALVINGS: i32 = 60;
    /// Twice the predicted difference from the smallest loss. Its statistical error is about 1, its rounding errors are
    /// much smaller.
    const TOLERANCE: f64 = 1e-6;
    for _ in 0..STEPS {
        let (mut gradient, mut curvature) = (Vector2::zeros(), Matrix2::identity() * 1e-9);
        for (features, target) in rows {
            let probability = 1.0 / (1.0 + (-weights.dot(features)).exp());
            gradient += features * (probability - target);
            curvature += features * features.transpose() * (probability * (1.0 - probability));
        }
        let step = curvature.try_inverse()? * gradient;
        if gradient.dot(&step) < TOLERANCE {
            return Some(weights - step);
        }
        let before = loss(rows, &weights);
        let mut shorter = (0..=HALVINGS).map(|halvings| weights - step * 0.5_f64.powi(halvings));
        weights = shorter.find(|weights| loss(rows, weights) < before)?;
    }
    None
}

/// The negative log-likelihood.
fn loss(rows: &[Row], weights: &Vector2<f64>) -> f64 {
    let of_row = |(features, target): &Row| {
        let score = weights.dot(features);
        score.max(0.0) + (-score.abs()).exp().ln_1p() - target * score
    };
    rows.iter().map(of_row).sum()
}

impl Bin {
    /// The success rate and its 95 % interval; `None` without attempts.
    #[must_use]
    pub fn share(&self) -> Option<(f64, [f64; 2])> {
        let share = self.lifted as f64 / self.attempts as f64;
        (self.attempts > 0).then(|| (share, wilson(self.lifted, self.attempts)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attempts(quality: f64, all: u64, lifted: u64) -> impl Iterator<Item = Attempt> {
        (0..all).map(move |number| Attempt { quality, lifted: number < lifted })
    }

    #[test]
    fn calibrated_qualities_have_no_error() {
        let calibrated: Vec<Attempt> = attempts(0.75, 8, 6).chain(attempts(0.52, 100, 52)).collect();
        let found = Reliability::new(&calibrated);
        assert!(found.error < 1e-12, "{}", found.error);
        assert_eq!((found.whole.attempts, found.whole.lifted), (108, 58));
        // One tenth is 0.2 too high, the others are 0.1 too low.
        let other: Vec<Attempt> = attempts(1.0, 10, 8).chain(attempts(0.6, 90, 63)).collect();
        assert!((Reliability::new(&other).error - (0.1 * 0.2 + 0.9 * 0.1)).abs() < 1e-12);
        assert_eq!(Reliability::new(&other).bins[BINS - 1].attempts, 10, "quality 1 is in the last bin");
        assert_eq!(Reliability::new(&[]).error, 0.0);
    }

    #[test]
    fn overconfident_qualities_are_calibrated() {
        // The log-odds are twice those of the success rates, and 0.5 higher.
        let rates = [0.2, 0.5, 0.8, 0.9];
        let quality = |rate: f64| 1.0 / (1.0 + (-(2.0 * (rate / (1.0 - rate)).ln() + 0.5)).exp());
        let all: Vec<Attempt> =
            rates.iter().flat_map(|&rate| attempts(quality(rate), 10_000, (1e4 * rate) as u64)).collect();
        let fitted = calibration(&all).unwrap();
        assert!((fitted.slope - 0.5).abs() < 0.01 && (fitted.offset + 0.25).abs() < 0.01, "{fitted:?}");
        let calibrated = |quality: f64| {
            let score = fitted.apply((quality / (1.0 - quality)).ln() as f32);
            1.0 / (1.0 + f64::from(-score).exp())
        };
        assert!(rates.iter().all(|&rate| (calibrated(quality(rate)) - rate).abs() < 0.005));

        let falling: Vec<Attempt> = attempts(0.2, 100, 90).chain(attempts(0.8, 100, 10)).collect();
        assert_eq!(calibration(&falling), None);
        assert_eq!(calibration(&attempts(0.7, 10, 10).collect::<Vec<_>>()), None);
        assert_eq!(calibration(&attempts(0.7, 10, 5).collect::<Vec<_>>()), None);
    }

    #[test]
    fn a_calibration_is_found_where_whole_newton_steps_diverge() {
        let all: Vec<Attempt> = attempts(0.9999, 1000, 990).chain(attempts(0.7, 100, 0)).collect();
        let fitted = calibration(&all).unwrap();
        assert!((fitted.slope - 1.102).abs() < 0.001 && (fitted.offset + 5.643).abs() < 0.001, "{fitted:?}");
    }

    #[test]
    fn intervals_are_wilson_score_intervals() {
        // 5 of 10: 0.2366 to 0.7634, a textbook example.
        let (share, [low, high]) = Bin { attempts: 10, lifted: 5, quality: 0.5 }.share().unwrap();
        assert!(share == 0.5 && (low - 0.2366).abs() < 1e-4 && (high - 0.7634).abs() < 1e-4, "{low} {high}");
        assert_eq!(Bin::default().share(), None);
    }
}
