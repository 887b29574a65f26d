//! A limit on the memory of messages that are being received.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use prometheus::IntGauge;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Retry hint when the budget is used up: messages of fast clients are complete by then.
const RETRY_AFTER: Duration = Duration::from_millis(100);

/// Memory for the messages that are being received on all connections.
pub(crate) struct ReceiveBudget {
    capacity: usize,
    used: AtomicUsize,
    /// Shows `used`.
    gauge: IntGauge,
}

/// The budget from the view of one connection. It may use at most as much as all connections leave free, so half of
/// the capacity if it is the only one; thus clients that never complete their messages leave memory for others.
#[derive(Clone)]
pub(crate) struct ConnectionShare {
    budget: Arc<ReceiveBudget>,
    used: Arc<AtomicUsize>,
}

/// The received part of a message. Dropping it returns the memory.
pub(crate) struct Received {
    share: ConnectionShare,
    bytes: usize,
}

impl ReceiveBudget {
    /// A budget of `capacity` bytes whose use `gauge` shows.
    pub fn new(capacity: usize, gauge: IntGauge) -> Arc<Self> {
        Arc::new(Self { capacity, used: AtomicUsize::new(0), gauge })
    }

    /// The share of a new connection.
    pub fn connection(self: &Arc<Self>) -> ConnectionShare {
        ConnectionShare { budget: Arc::clone(self), used: Arc::default() }
    }
}

impl ConnectionShare {
    /// A message of which nothing has been received yet.
    pub fn message(self) -> Received {
        Received { share: self, bytes: 0 }
    }
}

impl Received {
    /// Adds received data. The error is the status of the request.
    pub fn add(&mut self, bytes: usize) -> Result<(), Status> {
        let ConnectionShare { budget, used } = &self.share;
        let total = budget.used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let of_connection = used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.bytes += bytes;
        budget.gauge.add(bytes as i64);
        // Another thread may have changed the second sum after the first was read.
        let of_others = total.saturating_sub(of_connection);
        if of_connection <= budget.capacity.saturating_sub(of_others) / 2 {
            return Ok(());
        }
        self.clear();
        let message = format!(
            "{total} bytes of messages are being received, {of_connection} of them on this connection, and a connection \
             may use half of what the others leave of {} (--max-receiving-bytes); retry after {RETRY_AFTER:?}",
            self.share.budget.capacity
        );
        let details = ErrorDetails::with_retry_info(Some(RETRY_AFTER));
        Err(Status::with_error_details(Code::ResourceExhausted, message, details))
    }

    /// Returns the memory: the message is complete or refused.
    pub fn clear(&mut self) {
        let ConnectionShare { budget, used } = &self.share;
        used.fetch_sub(self.bytes, Ordering::Relaxed);
        budget.used.fetch_sub(self.bytes, Ordering::Relaxed);
        budget.gauge.sub(self.bytes as i64);
        self.bytes = 0;
    }
}

impl Drop for Received {
    fn drop(&mut self) {
        self.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_connection_may_use_half_of_what_the_others_leave() {
        let gauge = IntGauge::new("receiving", "Bytes.").unwrap();
        let budget = ReceiveBudget::new(1000, gauge.clone());
        let first = budget.connection();
        let mut messages: Vec<Received> = (0..5).map(|_| first.clone().message()).collect();
        assert!(messages.iter_mut().all(|message| message.add(100).is_ok()));
        let mut sixth = first.message();
        let status = sixth.add(1).unwrap_err();
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert!(status.get_details_retry_info().is_some());
        for figure in ["501 bytes", "1000 (--max-receiving-bytes)"] {
            assert!(status.message().contains(figure), "{status}");
        }

        let mut second = budget.connection().message();
        assert!(second.add(250).is_ok() && second.add(1).is_err());
        assert_eq!(gauge.get(), 500, "a refused message returns its memory");
        drop(messages);
        assert_eq!(gauge.get(), 0);
        assert!(second.add(500).is_ok());
        second.clear();
        assert_eq!((gauge.get(), budget.used.load(Ordering::Relaxed)), (0, 0));
    }

    #[test]
    fn messages_of_a_connection_on_several_threads_are_all_counted() {
        let gauge = IntGauge::new("receiving", "Bytes.").unwrap();
        let budget = ReceiveBudget::new(1 << 20, gauge.clone());
        let connection = budget.connection();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                let connection = connection.clone();
                scope.spawn(move || {
                    for _ in 0..20_000 {
                        let mut message = connection.clone().message();
                        assert!(message.add(100).is_ok() && message.add(7).is_ok());
                    }
                });
            }
        });
        assert_eq!((gauge.get(), budget.used.load(Ordering::Relaxed)), (0, 0));
    }
}
