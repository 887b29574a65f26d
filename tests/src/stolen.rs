use std::fs;

/// Processor time in total, and the part that was stolen: used by other virtual machines of the host while this one had
/// runnable threads. With much stolen time, measured durations are unreliable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stolen {
    ticks: u64,
    stolen: u64,
}

impl Stolen {
    /// Since the start of the machine. All 0 if the kernel is not Linux.
    #[must_use]
    pub fn so_far() -> Self {
        Self::read(&fs::read_to_string("/proc/stat").unwrap_or_default())
    }

    /// The stolen share of the time between two readings, percent.
    #[must_use]
    pub fn percent_until(self, later: Self) -> f64 {
        // Some of these counters may decrease slightly (proc(5)).
        let [stolen, ticks] = [later.stolen.saturating_sub(self.stolen), later.ticks.saturating_sub(self.ticks)];
        100.0 * stolen as f64 / ticks.max(1) as f64
    }

    fn read(stat: &str) -> Self {
        let all = stat.lines().find_map(|line| line.strip_prefix("cpu ")).unwrap_or_default();
        // user, nice, system, idle, iowait, irq, softirq, steal. The user time includes that of guests (proc(5)).
        let times: Vec<u64> = all.split_whitespace().take(8).filter_map(|time| time.parse().ok()).collect();
        Self { ticks: times.iter().sum(), stolen: times.get(7).copied().unwrap_or(0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stolen_time_does_not_include_idle_time() {
        let before = Stolen::read("cpu  10 20 30 40 50 60 70 80 90 100\ncpu0 1 2 3 4 5 6 7 8 9 10\n");
        assert_eq!(before, Stolen { ticks: 360, stolen: 80 });
        let after = Stolen::read("cpu  20 20 30 100 50 60 70 110 95 100\n");
        assert!((before.percent_until(after) - 30.0).abs() < 1e-9);
        assert!(Stolen::read("").percent_until(Stolen::read("")).abs() < 1e-9);
    }
}
