//! Work done on all cores whose results come in order.

use std::collections::BTreeMap;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc;

/// Calls `work` for every number on rayon's threads, and `take` with the results in the order of the numbers. At most a
/// few results for each thread are made ahead of the one that `take` waits for.
///
/// # Errors
/// The first of `take`; no more work is begun then.
pub fn for_each<T: Send, E>(
    numbers: Range<u64>,
    work: impl Fn(u64) -> T + Sync,
    mut take: impl FnMut(u64, T) -> Result<(), E>,
) -> Result<(), E> {
    let ahead = 8 * rayon::current_num_threads();
    // Never full: there is room for all that is under way.
    let (sender, results) = mpsc::sync_channel(ahead);
    let work = &work;
    rayon::in_place_scope_fifo(|scope| {
        let mut waiting = numbers.clone();
        let begin = |number| {
            let sender = sender.clone();
            scope.spawn_fifo(move |_| {
                // A panic goes on where the result is waited for, which would otherwise wait for ever.
                let result = catch_unwind(AssertUnwindSafe(|| work(number)));
                // Nobody listens any more only after an error, and then the result does not matter.
                drop(sender.send((number, result)));
            });
        };
        waiting.by_ref().take(ahead).for_each(begin);
        let mut early = BTreeMap::new();
        for number in numbers {
            let result = loop {
                if let Some(result) = early.remove(&number) {
                    break result;
                }
                let (other, result) = results.recv().expect("a sender is kept here");
                early.insert(other, result);
            };
            waiting.next().into_iter().for_each(begin);
            take(number, result.unwrap_or_else(|panic| resume_unwind(panic)))?;
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
    fn an_error_ends_it() {
        let ended = for_each(0..1000, |number| number, |number, _| if number == 5 { Err(number) } else { Ok(()) });
        assert_eq!(ended, Err(5));
    }
}
