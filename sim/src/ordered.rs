//! Parallel work with results in order.

use std::ops::Range;

use rayon::prelude::*;

/// Numbers per thread in a chunk: enough that threads idle little at its end, and few enough that an interrupted run
/// loses only seconds.
const CHUNK: u64 = 16;

/// Calls `work` for every number on rayon's threads, and `take` with the results in the order of the numbers.
///
/// # Errors
/// The first error of `take`. No further work is started then.
pub fn for_each<T: Send, E>(
    numbers: Range<u64>,
    work: impl Fn(u64) -> T + Sync,
    mut take: impl FnMut(u64, T) -> Result<(), E>,
) -> Result<(), E> {
    let chunk = CHUNK * rayon::current_num_threads() as u64;
    let mut start = numbers.start;
    while start < numbers.end {
        let end = numbers.end.min(start + chunk);
        let results: Vec<T> = (start..end).into_par_iter().map(&work).collect();
        (start..end).zip(results).try_for_each(|(number, result)| take(number, result))?;
        start = end;
    }
    Ok(())
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
}
