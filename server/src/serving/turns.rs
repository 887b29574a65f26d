use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;
use tokio::time::timeout_at;

use super::engine::Engine;
use super::job::EngineError;
use super::lines::{Lines, Ticket};
use super::refusal::Refusal;

/// The right to convert a request and to fuse its views, which needs a CPU and much memory. A bounded number of requests
/// wait for it, in the same order as in the [`Queue`](super::queue::Queue) of a model.
pub(crate) struct Turns {
    state: Mutex<State>,
    /// Maximum number of waiting requests.
    capacity: usize,
}

struct State {
    lines: Lines<oneshot::Sender<Turn>>,
    /// Number of the next waiting request.
    next: u64,
    /// Number of free turns.
    free: usize,
}

/// A turn. Dropping it gives it to the next request.
pub(crate) struct Turn(Option<Arc<Turns>>);

/// Why a request gets no turn.
#[derive(Debug, PartialEq, Eq)]
enum NoTurn {
    /// Too many requests wait.
    Full,
    /// The request of another caller has taken the place.
    Displaced,
}

/// A waiting request. Dropping it removes the request.
struct Waiting {
    turns: Arc<Turns>,
    number: u64,
}

impl Turns {
    /// `count` requests have a turn at the same time, and `capacity` others may wait.
    pub fn new(count: usize, capacity: usize) -> Arc<Self> {
        let state = State { lines: Lines::new(), next: 0, free: count };
        Arc::new(Self { state: Mutex::new(state), capacity })
    }

    /// Waits for the turn of a request to a model, at most until its deadline, and returns how long it waited. Refuses
    /// immediately if too many requests wait, with the model's retry hint.
    pub async fn of_request(self: &Arc<Self>, engine: &Engine, ticket: Ticket) -> Result<(Turn, Duration), Refusal> {
        let begun = Instant::now();
        let turn = self.take(ticket);
        let turn = match ticket.deadline {
            None => turn.await,
            Some(deadline) => timeout_at(deadline.into(), turn).await.map_err(|_| EngineError::Expired)?,
        };
        let reason = "too many requests wait for conversion and fusion".to_owned();
        let turn = turn.map_err(|refused| match refused {
            NoTurn::Full => engine.full(reason),
            NoTurn::Displaced => engine.displaced(reason),
        });
        Ok((turn?, begun.elapsed()))
    }

    /// Waits for a turn, or refuses immediately.
    async fn take(self: &Arc<Self>, ticket: Ticket) -> Result<Turn, NoTurn> {
        let (waiting, turn) = match self.enter(ticket)? {
            Ok(turn) => return Ok(turn),
            Err(waiting) => waiting,
        };
        let turn = turn.await;
        drop(waiting);
        // The sender of a displaced request is dropped.
        turn.map_err(|_| NoTurn::Displaced)
    }

    /// A free turn, or a place in the lines.
    fn enter(self: &Arc<Self>, ticket: Ticket) -> Result<Result<Turn, (Waiting, oneshot::Receiver<Turn>)>, NoTurn> {
        let mut state = self.lock();
        if state.free > 0 {
            state.free -= 1;
            return Ok(Ok(Turn(Some(Arc::clone(self)))));
        }
        if state.lines.len() >= self.capacity {
            let place = state.lines.displaced_by(ticket).ok_or(NoTurn::Full)?;
            state.lines.remove(place);
        }
        let (sender, turn) = oneshot::channel();
        let number = state.next;
        state.next += 1;
        state.lines.append(ticket, number, sender);
        Ok(Err((Waiting { turns: Arc::clone(self), number }, turn)))
    }

    /// Gives a turn to the next request that still waits.
    fn pass_on(self: &Arc<Self>) {
        loop {
            let mut state = self.lock();
            let Some(next) = state.lines.take() else {
                state.free += 1;
                return;
            };
            drop(state);
            match next.send(Turn(Some(Arc::clone(self)))) {
                Ok(()) => return,
                // The request has been cancelled. Its turn is not passed on when it is dropped, but by the next round.
                Err(mut turn) => turn.0 = None,
            }
        }
    }

    /// Ignores poisoning: no code that holds the lock can panic halfway through a change.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(turns) = self.0.take() {
            turns.pass_on();
        }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        let mut state = self.turns.lock();
        if let Some(place) = state.lines.find(self.number) {
            state.lines.remove(place);
        }
    }
}

#[cfg(test)]
mod tests {
    use grasp_proto::Priority;
    use tokio::task::{JoinHandle, yield_now};

    use super::*;
    use crate::transport::caller::Caller;

    fn ticket(number: u8) -> Ticket {
        Ticket { caller: Caller::Address([10, 0, 0, number].into()), priority: Priority::Normal, deadline: None }
    }

    /// A request of a caller that has begun to wait.
    async fn request(turns: &Arc<Turns>, caller: u8) -> JoinHandle<Result<Turn, NoTurn>> {
        let turns = Arc::clone(turns);
        let request = tokio::spawn(async move { turns.take(ticket(caller)).await });
        yield_now().await;
        request
    }

    #[tokio::test]
    async fn callers_get_turns_in_turn_and_few_requests_displace_many() {
        let turns = Turns::new(1, 3);
        let mut running = turns.take(ticket(1)).await.unwrap();
        let mut first = Vec::new();
        for _ in 0..3 {
            first.push(request(&turns, 1).await);
        }
        assert_eq!(turns.take(ticket(1)).await.err(), Some(NoTurn::Full));
        let second = request(&turns, 2).await;
        assert_eq!(first.pop().unwrap().await.unwrap().err(), Some(NoTurn::Displaced));
        for next in [first.remove(0), second, first.remove(0)] {
            assert!(!next.is_finished());
            drop(running);
            running = next.await.unwrap().ok().unwrap();
        }
        drop(running);
        assert!(turns.take(ticket(3)).await.is_ok());
    }

    #[tokio::test]
    async fn the_turn_of_a_cancelled_request_goes_to_the_next() {
        let turns = Turns::new(1, 3);
        let running = turns.take(ticket(1)).await.unwrap();
        let (cancelled, next) = (request(&turns, 1).await, request(&turns, 1).await);
        cancelled.abort();
        assert!(cancelled.await.is_err());
        let last = request(&turns, 1).await;
        assert_eq!(turns.lock().lines.len(), 2, "it left the line");
        drop(running);
        let got = next.await.unwrap().unwrap();
        last.abort();
        drop(got);
        assert!(last.await.is_err() && turns.take(ticket(1)).await.is_ok());
    }
}
