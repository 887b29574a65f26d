use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::scheduler::Service;

/// Mean times of a scene and of a batch, in which the latest batches count most.
pub(crate) struct ServiceTime(Mutex<Times>);

struct Times {
    /// The time of a batch divided by its number of scenes: how fast the queue advances.
    scene: Mean,
    /// How long a scene takes: it is done when its batch is.
    batch: Mean,
}

/// A mean, the mean deviation from it, and the number of the values.
#[derive(Clone, Copy)]
struct Mean {
    seconds: f64,
    deviation: f64,
    values: f64,
}

/// The means are over about this many of the latest values.
const MEMORY: f64 = 8.0;

impl Mean {
    /// Adds a value. The first replaces the initial one.
    fn add(&mut self, seconds: f64) {
        self.values = (self.values + 1.0).min(MEMORY);
        let difference = seconds - self.seconds;
        // The difference from the initial value is not a deviation.
        if self.values > 1.0 {
            self.deviation += (difference.abs() - self.deviation) / self.values;
        }
        self.seconds += difference / self.values;
    }
}

impl ServiceTime {
    /// The time of one scene in a batch of its own.
    pub fn new(duration: Duration) -> Self {
        let mean = Mean { seconds: duration.as_secs_f64(), deviation: 0.0, values: 0.0 };
        Self(Mutex::new(Times { scene: mean, batch: mean }))
    }

    /// Replaces the initial time.
    pub fn start_with(&self, duration: Duration) {
        let Self(times) = Self::new(duration);
        *self.times() = times.into_inner().unwrap_or_else(PoisonError::into_inner);
    }

    /// Adds the time of a batch.
    pub fn add(&self, duration: Duration, scenes: u32) {
        let mut times = self.times();
        times.scene.add(duration.as_secs_f64() / f64::from(scenes));
        times.batch.add(duration.as_secs_f64());
    }

    /// The mean is at least one millisecond, the unit of the retry hint. For a normal distribution, one batch in twenty
    /// takes longer than the mean plus two mean deviations.
    pub fn get(&self) -> Service {
        let Times { scene, batch } = *self.times();
        let mean = Duration::from_secs_f64(scene.seconds).max(Duration::from_millis(1));
        Service { mean, long: mean.max(Duration::from_secs_f64(batch.seconds + 2.0 * batch.deviation)) }
    }

    fn times(&self) -> MutexGuard<'_, Times> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_takes_as_long_as_its_batch() {
        let times = ServiceTime::new(Duration::from_millis(5));
        assert_eq!(times.get(), Service { mean: Duration::from_millis(5), long: Duration::from_millis(5) });
        (0..20).for_each(|_| times.add(Duration::from_millis(800), 8));
        let Service { mean, long } = times.get();
        assert_eq!((mean.as_millis(), long.as_millis()), (100, 800));
    }
}
