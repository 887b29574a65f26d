use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp_models::batch_sizes;
use prometheus::IntGauge;

/// A bounded FIFO queue of jobs for a model's sessions.
pub(crate) struct Queue<T> {
    state: Mutex<State<T>>,
    /// Signals a new job or the closing of the queue.
    changed: Condvar,
    capacity: usize,
    gauge: IntGauge,
}

struct State<T> {
    waiting: VecDeque<Waiting<T>>,
    next: u64,
    /// Idle sessions. Each allows one job beyond the capacity, because it takes that job immediately.
    free: usize,
    closed: bool,
}

struct Waiting<T> {
    number: u64,
    since: Instant,
    job: T,
}

/// A slot in the queue. Dropping it removes its job, if no session has taken it yet.
pub(crate) struct QueueSlot<T> {
    queue: Arc<Queue<T>>,
    number: u64,
}

/// How a session forms batches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Batching {
    /// Maximum batch size, jobs.
    pub max: usize,
    /// Maximum time that a session waits for a batch to fill, from the arrival of its first job.
    pub delay: Duration,
}

impl Batching {
    /// The batch size for this number of waiting jobs: the largest of the [sizes](batch_sizes) that the networks are
    /// warmed up for, so that batches need no padding.
    fn fitting(self, waiting: usize) -> usize {
        batch_sizes(self.max).take_while(|&size| size <= waiting).last().unwrap_or(0)
    }
}

/// The queue is full.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Full;

impl<T> Queue<T> {
    /// A queue for this many sessions and `capacity` waiting jobs, which are counted in `gauge`. During a reload, the
    /// old and the new queue of a model share a gauge.
    pub fn new(sessions: usize, capacity: usize, gauge: IntGauge) -> Self {
        let state = State { waiting: VecDeque::new(), next: 0, free: sessions, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new(), capacity, gauge }
    }

    /// Appends a job, or refuses it immediately. Must not be called after [`close`](Self::close).
    pub fn push(self: &Arc<Self>, job: T) -> Result<QueueSlot<T>, Full> {
        let mut state = self.lock();
        // An idle session may not have woken up yet for a waiting job.
        if state.waiting.len() >= self.capacity + state.free {
            return Err(Full);
        }
        let number = state.next;
        state.next += 1;
        state.waiting.push_back(Waiting { number, since: Instant::now(), job });
        self.gauge.inc();
        drop(state);
        self.changed.notify_one();
        Ok(QueueSlot { queue: Arc::clone(self), number })
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Whether [`push`](Self::push) would refuse a job now.
    pub fn is_full(&self) -> bool {
        let state = self.lock();
        state.waiting.len() >= self.capacity + state.free
    }

    /// Waits for jobs and takes a batch, oldest first; None when the queue is closed and empty. The session counts as
    /// busy until it calls [`free`](Self::free).
    pub fn take(&self, batching: Batching) -> Option<Vec<T>> {
        let mut state = self.lock();
        let waiting = |state: &mut State<T>| state.waiting.is_empty() && !state.closed;
        state = self.changed.wait_while(state, waiting).unwrap_or_else(PoisonError::into_inner);
        if !batching.delay.is_zero() {
            state = self.gather(state, batching);
        }
        state.free -= 1;
        let count = batching.fitting(state.waiting.len());
        let jobs: Vec<T> = state.waiting.drain(..count).map(|waiting| waiting.job).collect();
        self.gauge.sub(count as i64);
        let (left, ended) = (!state.waiting.is_empty(), state.closed && jobs.is_empty());
        drop(state);
        if left {
            // `push` woke only this session.
            self.changed.notify_one();
        }
        if ended { None } else { Some(jobs) }
    }

    /// Marks a session as idle. The session calls it before it sends its results, so that a client that has received
    /// one finds a slot for its next request.
    pub fn free(&self) {
        self.lock().free += 1;
    }

    /// Waits until the batch is full, or the delay has passed since the arrival of its first job.
    fn gather<'a>(&self, mut state: MutexGuard<'a, State<T>>, batching: Batching) -> MutexGuard<'a, State<T>> {
        while !state.closed && state.waiting.len() < batching.max {
            let Some(first) = state.waiting.front() else { break };
            let left = batching.delay.saturating_sub(first.since.elapsed());
            if left.is_zero() {
                break;
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        state
    }

    /// Closes the queue. Waiting jobs can still be taken.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn remove(&self, number: u64) {
        let mut state = self.lock();
        // Sorted by number, because jobs are appended in that order.
        if let Ok(index) = state.waiting.binary_search_by_key(&number, |waiting| waiting.number) {
            state.waiting.remove(index);
            self.gauge.dec();
        }
    }

    /// Ignores poisoning: no code that holds the lock can panic halfway through a change.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Drop for QueueSlot<T> {
    fn drop(&mut self) {
        self.queue.remove(self.number);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const ONE: Batching = Batching { max: 1, delay: Duration::ZERO };

    fn queue(sessions: usize, capacity: usize) -> (Arc<Queue<u32>>, IntGauge) {
        let gauge = IntGauge::new("waiting", "Waiting jobs.").unwrap();
        (Arc::new(Queue::new(sessions, capacity, gauge.clone())), gauge)
    }

    #[test]
    fn jobs_are_taken_in_order_and_limited_by_the_capacity() {
        let (queue, gauge) = queue(0, 3);
        let _slots: Vec<_> = (0..3).map(|job| queue.push(job).ok().unwrap()).collect();
        assert_eq!(queue.push(3).err(), Some(Full));
        assert_eq!(gauge.get(), 3);
        queue.free();
        assert_eq!(queue.take(ONE), Some(vec![0]));
        queue.free();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }), Some(vec![1, 2]));
        assert_eq!(gauge.get(), 0);
    }

    #[test]
    fn batches_have_only_the_sizes_that_are_warmed_up() {
        let (queue, _) = queue(2, 16);
        let _slots: Vec<_> = (0..17).map(|job| queue.push(job).ok().unwrap()).collect();
        let take = || queue.take(Batching { max: 6, ..ONE }).inspect(|_| queue.free()).map(|jobs| jobs.len());
        assert_eq!([take(), take(), take(), take()], [6, 6, 4, 1].map(Some));
    }

    #[test]
    fn a_dropped_slot_removes_its_job() {
        let (queue, gauge) = queue(1, 2);
        let first = queue.push(1).ok().unwrap();
        let second = queue.push(2).ok().unwrap();
        drop(first);
        assert_eq!(gauge.get(), 1);
        let _third = queue.push(3).ok().unwrap();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }), Some(vec![2, 3]));
        drop(second);
        assert_eq!(gauge.get(), 0);
    }

    #[test]
    fn a_closed_queue_returns_its_jobs_and_then_none() {
        let (queue, _) = queue(1, 2);
        let _slot = queue.push(1).ok().unwrap();
        queue.close();
        assert_eq!(queue.take(ONE), Some(vec![1]));
        queue.free();
        assert_eq!(queue.take(ONE), None);
    }

    #[test]
    fn an_idle_session_adds_one_to_the_capacity() {
        let (queue, _) = queue(1, 1);
        let mut slots = vec![queue.push(1).ok().unwrap(), queue.push(2).ok().unwrap()];
        assert_eq!(queue.push(3).err(), Some(Full));
        assert_eq!(queue.take(ONE), Some(vec![1]));
        assert_eq!(queue.push(3).err(), Some(Full), "the session is busy and one job waits");
        queue.free();
        slots.push(queue.push(3).ok().unwrap());
        assert_eq!(queue.take(ONE), Some(vec![2]));
    }

    #[test]
    fn with_a_delay_a_batch_fills_up() {
        let (queue, _) = queue(2, 4);
        let batching = Batching { max: 3, delay: Duration::from_secs(600) };
        let session = {
            let queue = Arc::clone(&queue);
            thread::spawn(move || queue.take(batching))
        };
        // The session would wait ten minutes for a third job.
        let _slots: Vec<_> = (0..3).map(|job| queue.push(job).ok().unwrap()).collect();
        assert_eq!(session.join().unwrap(), Some(vec![0, 1, 2]));

        // After the delay it takes an incomplete batch.
        let _slot = queue.push(7).ok().unwrap();
        assert_eq!(queue.take(Batching { max: 3, delay: Duration::from_millis(1) }), Some(vec![7]));
    }

    #[test]
    fn concurrent_sessions_take_each_job_exactly_once() {
        let (queue, _) = queue(4, 10_000);
        let sessions: Vec<_> = (0..4)
            .map(|index| {
                let queue = Arc::clone(&queue);
                let batching = Batching { max: 1 + index, delay: Duration::from_micros(50 * index as u64) };
                let take = move || queue.take(batching).inspect(|_| queue.free());
                thread::spawn(move || std::iter::from_fn(take).flatten().collect::<Vec<u32>>())
            })
            .collect();
        let slots: Vec<_> = (0..10_000).map(|job| queue.push(job).ok().unwrap()).collect();
        queue.close();
        let mut jobs: Vec<u32> = sessions.into_iter().flat_map(|session| session.join().unwrap()).collect();
        jobs.sort_unstable();
        assert_eq!(jobs, (0..10_000).collect::<Vec<_>>());
        drop(slots);
    }
}
