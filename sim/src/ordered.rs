//! Parallel work whose results are taken in order.

use std::collections::BTreeMap;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError, mpsc};
use std::thread;

/// Results per thread that are computed or wait for an earlier one.
const AHEAD: u64 = 4;

/// Computes `work` of each number on all CPUs and gives the results to `take`, in the order of the numbers and as soon as
/// they are there, so that an interrupted run has taken nearly all of them. The threads are not those of rayon, where a
/// planner that waits for a part of its work would compute a whole other number meanwhile.
///
/// # Errors
/// The first error of `take`. No further work is started then.
pub fn for_each<T: Send, E>(
    numbers: Range<u64>,
    work: impl Fn(u64) -> T + Sync,
    mut take: impl FnMut(u64, T) -> Result<(), E>,
) -> Result<(), E> {
    let window = AHEAD * rayon::current_num_threads() as u64;
    let is_stopped = AtomicBool::new(false);
    let (work, is_stopped) = (&work, &is_stopped);
    // As many as are started and not taken, so that no thread waits to send.
    let (starter, to_do) = mpsc::sync_channel(window as usize);
    let (sender, results) = mpsc::sync_channel(window as usize);
    let to_do = &Mutex::new(to_do);
    thread::scope(|scope| {
        for _ in 0..rayon::current_num_threads() {
            let sender = sender.clone();
            scope.spawn(move || {
                let next = || to_do.lock().unwrap_or_else(PoisonError::into_inner).recv();
                while let Ok(number) = next() {
                    if is_stopped.load(Ordering::Relaxed) {
                        break;
                    }
                    // Fails after an error of `take`, when the result is not needed.
                    let _ = sender.send((number, catch_unwind(AssertUnwindSafe(|| work(number)))));
                }
            });
        }
        // Ends the threads when it is dropped.
        let starter = starter;
        let (mut started, mut next) = (numbers.start, numbers.start);
        let mut early = BTreeMap::new();
        while next < numbers.end {
            let end = numbers.end.min(next + window);
            // The threads end, and so no longer receive, only after an error.
            (started..end).for_each(|number| _ = starter.send(number));
            started = end;
            // The sender above keeps the channel open, and each started work sends one result.
            let Ok((number, result)) = results.recv() else { break };
            early.insert(number, result);
            while let Some(result) = early.remove(&next) {
                let taken = match result {
                    Ok(result) => take(next, result),
                    Err(panic) => {
                        is_stopped.store(true, Ordering::Relaxed);
                        resume_unwind(panic)
                    }
                };
                taken.inspect_err(|_| is_stopped.store(true, Ordering::Relaxed))?;
                next += 1;
            }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_order() {
        let mut seen = Vec::new();
        let slow_when_even = |number: u64| {
            std::thread::sleep(std::time::Duration::from_micros(if number.is_multiple_of(2) { 300 } else { 10 }));
            number * number
        };
        for_each(3..200, slow_when_even, |number, square| {
            seen.push((number, square));
            Ok::<(), ()>(())
        })
        .unwrap();
        assert_eq!(seen, (3..200).map(|number| (number, number * number)).collect::<Vec<_>>());
    }

    #[test]
    #[should_panic(expected = "number 7")]
    fn a_panic_is_passed_on() {
        let _ = for_each(0..1000, |number| assert_ne!(number, 7, "number 7"), |_, ()| Ok::<(), ()>(()));
    }

    #[test]
    fn an_error_stops_the_work() {
        let ended = for_each(0..1000, |number| number, |number, _| if number == 5 { Err(number) } else { Ok(()) });
        assert_eq!(ended, Err(5));
    }

    #[test]
    fn results_are_taken_while_later_ones_are_computed() {
        let (sender, receiver) = mpsc::sync_channel(1);
        let receiver = std::sync::Mutex::new(receiver);
        // The work on 100 ends when the result of 0 was taken.
        let wait = |number| {
            if number == 100 {
                receiver.lock().unwrap().recv().unwrap()
            }
        };
        for_each(0..101, wait, |number, ()| if number == 0 { sender.send(()) } else { Ok(()) }).unwrap();
    }
}
