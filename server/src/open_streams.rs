//! A limit on the `DetectGraspsStream` calls that are open at the same time.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use grasp::{Code, RequestError};
use grasp_engine::Caller;

/// Maximum number of open streams. Each holds at most an HTTP/2 window of 1 MiB that is not read yet.
const LIMIT: usize = 1024;

/// Retry hint when all streams are in use: streams are long-lived.
const IN_USE: Duration = Duration::from_secs(1);

/// The open streams of each caller.
#[derive(Clone, Default)]
pub(crate) struct OpenStreams(Arc<Mutex<HashMap<Caller, usize>>>);

/// An open stream. Dropping it frees its place.
pub(crate) struct OpenStream {
    all: OpenStreams,
    caller: Caller,
}

impl OpenStreams {
    /// Opens a stream. A caller may have half of the streams that the others leave.
    pub fn open(&self, caller: Caller) -> Result<OpenStream, RequestError> {
        let mut streams = self.lock();
        let own = streams.get(&caller).copied().unwrap_or_default();
        let others = streams.values().sum::<usize>() - own;
        if own >= LIMIT.saturating_sub(others) / 2 {
            let message = format!(
                "{} streams are open, {own} of them of this client, which may have half of what the others leave of \
                 {LIMIT}; close a stream; retry after {IN_USE:?}",
                own + others
            );
            return Err(RequestError::new(Code::ResourceExhausted, message).after(IN_USE));
        }
        *streams.entry(caller).or_default() += 1;
        Ok(OpenStream { all: self.clone(), caller })
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Caller, usize>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        let mut streams = self.all.lock();
        if let Some(open) = streams.get_mut(&self.caller) {
            *open -= 1;
            if *open == 0 {
                streams.remove(&self.caller);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caller_may_have_half_of_the_streams_that_the_others_leave() {
        let streams = OpenStreams::default();
        let caller = |last: u8| Caller::Address([10, 0, 0, last].into());
        let many = |last: u8| std::iter::from_fn(|| streams.open(caller(last)).ok()).collect::<Vec<_>>();
        let first = many(1);
        assert_eq!(first.len(), LIMIT / 2);
        let error = streams.open(caller(1)).err().unwrap();
        assert!(error.message.starts_with("512 streams are open, 512 of them of this client"), "{error}");
        assert_eq!(many(2).len(), LIMIT / 4);
        drop(first);
        assert!(streams.lock().is_empty());
    }
}
