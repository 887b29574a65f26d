//! A load generator and its report.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};
use tonic::Code;

/// When calls start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arrivals {
    /// Closed loop: this many callers, each with one call in flight.
    Callers(usize),
    /// Open loop: Poisson arrivals at this rate, calls per second, independent of the response times.
    Rate(f64),
}

/// When the load ends. Calls in flight are completed.
#[derive(Clone, Debug)]
pub enum Until {
    /// After this many calls.
    Calls(usize),
    /// After this time.
    Elapsed(Duration),
    /// After this time, or when the flag is set.
    Stopped(Duration, Arc<AtomicBool>),
}

/// Latencies and outcomes of the calls.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Time from the first call to the last response.
    pub elapsed: Duration,
    /// Latencies of the successful calls, sorted. With [`Arrivals::Rate`] a latency counts from the scheduled start of
    /// the call, so that a slow server cannot delay the clock (coordinated omission).
    pub answered: Vec<Duration>,
    /// Latencies of the failed calls, sorted, by gRPC status code.
    pub refused: BTreeMap<i32, Vec<Duration>>,
}

impl Report {
    /// The quantile `share` (in [0, 1]) of sorted times, by the nearest-rank method; zero without times.
    #[must_use]
    pub fn quantile(times: &[Duration], share: f64) -> Duration {
        let rank = (times.len() as f64 * share).ceil() as usize;
        times.get(rank.clamp(1, times.len().max(1)) - 1).copied().unwrap_or_default()
    }

    /// Successful calls per second.
    #[must_use]
    pub fn throughput(&self) -> f64 {
        self.answered.len() as f64 / self.elapsed.as_secs_f64().max(f64::MIN_POSITIVE)
    }

    /// Number of failed calls.
    #[must_use]
    pub fn refusals(&self) -> usize {
        self.refused.values().map(Vec::len).sum()
    }

    fn add(&mut self, took: Duration, outcome: Result<(), Code>) {
        match outcome {
            Ok(()) => self.answered.push(took),
            Err(code) => self.refused.entry(code.into()).or_default().push(took),
        }
    }

    /// Adds a later run of the same load.
    pub fn append(&mut self, later: Self) {
        self.elapsed += later.elapsed;
        self.merge(later);
        self.sort();
    }

    fn sort(&mut self) {
        self.answered.sort_unstable();
        self.refused.values_mut().for_each(|times| times.sort_unstable());
    }

    fn merge(&mut self, other: Self) {
        self.answered.extend(other.answered);
        for (code, times) in other.refused {
            self.refused.entry(code).or_default().extend(times);
        }
    }
}

/// Runs `call` repeatedly and reports the latencies. Its argument is the index of the call, from 0.
///
/// # Panics
/// If a call panics, or if a rate is so small that a pause between two calls does not fit a [`Duration`].
pub async fn load<C, F>(arrivals: Arrivals, until: Until, call: C) -> Report
where
    C: Fn(usize) -> F + Send + Sync + 'static,
    F: Future<Output = Result<(), Code>> + Send,
{
    let call = Arc::new(call);
    let started = Instant::now();
    let continues = move |number: usize, now: Instant| match &until {
        Until::Calls(calls) => number < *calls,
        Until::Elapsed(duration) => now < started + *duration,
        Until::Stopped(duration, is_stopped) => now < started + *duration && !is_stopped.load(Ordering::Relaxed),
    };
    let mut report = match arrivals {
        Arrivals::Callers(callers) => by_callers(callers, continues, &call).await,
        Arrivals::Rate(rate) => at_rate(rate, continues, &call).await,
    };
    report.elapsed = started.elapsed();
    report.sort();
    report
}

async fn by_callers<C, F>(
    callers: usize,
    continues: impl Fn(usize, Instant) -> bool + Clone + Send + 'static,
    call: &Arc<C>,
) -> Report
where
    C: Fn(usize) -> F + Send + Sync + 'static,
    F: Future<Output = Result<(), Code>> + Send,
{
    let next = Arc::new(AtomicUsize::new(0));
    let mut tasks = JoinSet::new();
    for _ in 0..callers {
        let (call, next, continues) = (Arc::clone(call), Arc::clone(&next), continues.clone());
        tasks.spawn(async move {
            let mut report = Report::default();
            loop {
                let (number, start) = (next.fetch_add(1, Ordering::Relaxed), Instant::now());
                if !continues(number, start) {
                    return report;
                }
                let outcome = call(number).await;
                report.add(start.elapsed(), outcome);
            }
        });
    }
    let mut report = Report::default();
    for one in tasks.join_all().await {
        report.merge(one);
    }
    report
}

async fn at_rate<C, F>(rate: f64, continues: impl Fn(usize, Instant) -> bool, call: &Arc<C>) -> Report
where
    C: Fn(usize) -> F + Send + Sync + 'static,
    F: Future<Output = Result<(), Code>> + Send,
{
    // A fixed seed gives the same arrival times in every run, so that runs are comparable.
    let mut random = SmallRng::seed_from_u64(1);
    let mut tasks = JoinSet::new();
    let mut due = Instant::now();
    let mut report = Report::default();
    let mut number = 0;
    loop {
        // The interarrival time of a Poisson process is exponential.
        due += Duration::from_secs_f64(-(1.0 - random.random::<f64>()).ln() / rate);
        if !continues(number, due) {
            break;
        }
        sleep_until(due).await;
        let call = Arc::clone(call);
        tasks.spawn(async move {
            let outcome = call(number).await;
            (due.elapsed(), outcome)
        });
        number += 1;
        while let Some(done) = tasks.try_join_next() {
            add(&mut report, done);
        }
    }
    while let Some(done) = tasks.join_next().await {
        add(&mut report, done);
    }
    report
}

/// Adds a finished call. A panic of the call is propagated, because the report would be incomplete.
fn add(report: &mut Report, done: Result<(Duration, Result<(), Code>), tokio::task::JoinError>) {
    match done {
        Ok((took, outcome)) => report.add(took, outcome),
        Err(error) => std::panic::resume_unwind(error.into_panic()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_call_is_made_once_and_counted() {
        for arrivals in [Arrivals::Callers(4), Arrivals::Rate(1e5)] {
            let made = Arc::new(AtomicUsize::new(0));
            let sum = Arc::clone(&made);
            let report = load(arrivals, Until::Calls(100), move |number| {
                sum.fetch_add(number, Ordering::Relaxed);
                async move { if number % 4 == 0 { Err(Code::ResourceExhausted) } else { Ok(()) } }
            });
            let report = report.await;
            assert_eq!(made.load(Ordering::Relaxed), 4950, "{arrivals:?}");
            assert_eq!((report.answered.len(), report.refusals()), (75, 25));
            assert!(report.answered.is_sorted() && report.throughput() > 0.0);
        }
    }

    #[tokio::test]
    async fn the_load_ends_after_the_given_time() {
        for arrivals in [Arrivals::Callers(2), Arrivals::Rate(1000.0)] {
            let report = load(arrivals, Until::Elapsed(Duration::from_millis(100)), async |_| {
                tokio::time::sleep(Duration::from_millis(1)).await;
                Ok(())
            });
            let report = report.await;
            assert!(!report.answered.is_empty(), "{arrivals:?}");
            assert!(report.answered[0] >= Duration::from_millis(1));
        }
    }

    #[test]
    fn quantiles_are_measured_values() {
        let times: Vec<_> = (1..=10).map(Duration::from_millis).collect();
        let at = |share| Report::quantile(&times, share).as_millis();
        assert_eq!([at(0.0), at(0.5), at(0.9), at(0.91), at(1.0)], [1, 5, 9, 10, 10]);
        assert_eq!(Report::quantile(&[], 0.5), Duration::ZERO);
    }
}
