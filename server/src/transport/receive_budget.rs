//! A limit on the memory of messages that are being received.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
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
    /// What the peers with connections use.
    peers: Mutex<HashMap<Option<IpAddr>, Weak<AtomicUsize>>>,
}

/// The part of the budget that a peer may use with all of its connections: at most half of what the other peers leave,
/// so half of the capacity if it is the only one. Thus clients that never complete their messages leave memory for
/// others.
#[derive(Clone)]
pub(crate) struct PeerShare {
    budget: Arc<ReceiveBudget>,
    used: Arc<AtomicUsize>,
}

/// The received part of a message. Dropping it returns the memory.
pub(crate) struct Received {
    share: PeerShare,
    bytes: usize,
}

impl ReceiveBudget {
    /// A budget of `capacity` bytes whose use `gauge` shows.
    pub fn new(capacity: usize, gauge: IntGauge) -> Arc<Self> {
        Arc::new(Self { capacity, used: AtomicUsize::new(0), gauge, peers: Mutex::default() })
    }

    /// The share of a new connection of a peer; `None` is the machine itself, over a UNIX socket.
    pub fn of_peer(self: &Arc<Self>, peer: Option<IpAddr>) -> PeerShare {
        let mut peers = self.peers.lock().unwrap_or_else(PoisonError::into_inner);
        let used = peers.get(&peer).and_then(Weak::upgrade).unwrap_or_else(|| {
            peers.retain(|_, used| used.strong_count() > 0);
            let used = Arc::default();
            peers.insert(peer, Arc::downgrade(&used));
            used
        });
        PeerShare { budget: Arc::clone(self), used }
    }
}

impl PeerShare {
    /// A message of which nothing has been received yet.
    pub fn message(self) -> Received {
        Received { share: self, bytes: 0 }
    }
}

impl Received {
    /// Adds received data. The error is the status of the request.
    pub fn add(&mut self, bytes: usize) -> Result<(), Status> {
        let PeerShare { budget, used } = &self.share;
        let total = budget.used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let of_peer = used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.bytes += bytes;
        budget.gauge.add(bytes as i64);
        // Another thread may have changed the second sum after the first was read.
        let of_others = total.saturating_sub(of_peer);
        if of_peer <= budget.capacity.saturating_sub(of_others) / 2 {
            return Ok(());
        }
        self.clear();
        let message = format!(
            "{total} bytes of messages are being received, {of_peer} of them from this address, and an address may use \
             half of what the others leave of {} (--max-receiving-bytes); retry after {RETRY_AFTER:?}",
            self.share.budget.capacity
        );
        let details = ErrorDetails::with_retry_info(Some(RETRY_AFTER));
        Err(Status::with_error_details(Code::ResourceExhausted, message, details))
    }

    /// Returns the memory: the message is complete or refused.
    pub fn clear(&mut self) {
        let PeerShare { budget, used } = &self.share;
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
    fn an_address_may_use_half_of_what_the_others_leave() {
        let gauge = IntGauge::new("receiving", "Bytes.").unwrap();
        let budget = ReceiveBudget::new(1000, gauge.clone());
        let [one, other] = [1, 2].map(|last| Some(IpAddr::from([10, 0, 0, last])));
        let first = budget.of_peer(one);
        let mut messages: Vec<Received> = (0..5).map(|_| first.clone().message()).collect();
        assert!(messages.iter_mut().all(|message| message.add(100).is_ok()));
        // With another connection it has no more.
        let mut sixth = budget.of_peer(one).message();
        let status = sixth.add(1).unwrap_err();
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert!(status.get_details_retry_info().is_some());
        for figure in ["501 bytes", "1000 (--max-receiving-bytes)"] {
            assert!(status.message().contains(figure), "{status}");
        }

        let mut second = budget.of_peer(other).message();
        assert!(second.add(250).is_ok() && second.add(1).is_err());
        assert_eq!(gauge.get(), 500, "a refused message returns its memory");
        drop(messages);
        assert_eq!(gauge.get(), 0);
        assert!(second.add(500).is_ok());
        second.clear();
        assert_eq!((gauge.get(), budget.used.load(Ordering::Relaxed)), (0, 0));
    }

    #[test]
    fn messages_of_a_peer_on_several_threads_are_all_counted() {
        let gauge = IntGauge::new("receiving", "Bytes.").unwrap();
        let budget = ReceiveBudget::new(1 << 20, gauge.clone());
        let connection = budget.of_peer(None);
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
