use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp_models::batch_sizes;
use prometheus::IntGauge;

/// What waits for a model's sessions, first come, first served.
pub(crate) struct Queue<T> {
    state: Mutex<State<T>>,
    /// Something came, or nothing will any more.
    changed: Condvar,
    capacity: usize,
    gauge: IntGauge,
}

struct State<T> {
    waiting: VecDeque<Waiting<T>>,
    next: u64,
    /// Sessions that have answered what they took: for each a job more may wait, whatever the capacity, for it will be
    /// taken at once.
    free: usize,
    closed: bool,
}

struct Waiting<T> {
    number: u64,
    since: Instant,
    job: T,
}

/// A place in the queue. Who drops it has gone: the job leaves the queue, if no session has taken it yet.
pub(crate) struct QueueSlot<T> {
    queue: Arc<Queue<T>>,
    number: u64,
}

/// How many jobs a session takes at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Batching {
    /// At most so many.
    pub max: usize,
    /// For so long, counted from the first, a session that could take more waits for them.
    pub delay: Duration,
}

impl Batching {
    /// How many of those that wait are taken: the largest of the [sizes](batch_sizes) that networks are made ready for, so
    /// that nothing is computed only to fill a batch up, and no batch is the first of its size.
    fn fitting(self, waiting: usize) -> usize {
        batch_sizes(self.max).take_while(|&size| size <= waiting).last().unwrap_or(0)
    }
}

/// So many jobs wait that no more are taken.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Full;

impl<T> Queue<T> {
    /// A queue of so many sessions, in which `capacity` jobs may wait. They are counted in `gauge`, beside those of
    /// other queues that share it, as a model's old and new sessions do.
    pub fn new(sessions: usize, capacity: usize, gauge: IntGauge) -> Self {
        let state = State { waiting: VecDeque::new(), next: 0, free: sessions, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new(), capacity, gauge }
    }

    /// Appends a job, or refuses it at once. Not for a queue that is closed.
    pub fn push(self: &Arc<Self>, job: T) -> Result<QueueSlot<T>, Full> {
        let mut state = self.lock();
        // A free session may not have woken up yet for a job that waits.
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

    /// How many may wait.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Whether [`push`](Self::push) would refuse at this moment.
    pub fn is_full(&self) -> bool {
        let state = self.lock();
        state.waiting.len() >= self.capacity + state.free
    }

    /// Waits for jobs and takes them, the oldest first; none when the queue is closed and empty. The session is busy then,
    /// until it is [`free`](Self::free).
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
            // Whoever woke this session did not wake another.
            self.changed.notify_one();
        }
        if ended { None } else { Some(jobs) }
    }

    /// A session is about to answer what it took. It says so first, so that whoever gets the answer finds room for the
    /// next request.
    pub fn free(&self) {
        self.lock().free += 1;
    }

    /// Waits until there are as many jobs as fit together, or the first has waited long enough.
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

    /// Nothing is taken in any more; what waits is still given out.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn remove(&self, number: u64) {
        let mut state = self.lock();
        // Sorted by number, as they came.
        if let Ok(index) = state.waiting.binary_search_by_key(&number, |waiting| waiting.number) {
            state.waiting.remove(index);
            self.gauge.dec();
        }
    }

    /// A panic cannot leave it half changed: nothing that could panic is done with it.
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
        let gauge = IntGauge::new("waiting", "How many wait.").unwrap();
        (Arc::new(Queue::new(sessions, capacity, gauge.clone())), gauge)
    }

    #[test]
    fn jobs_come_out_in_their_order_and_no_more_than_fit_wait() {
        let (queue, gauge) = queue(0, 3);
        let _places: Vec<_> = (0..3).map(|job| queue.push(job).ok().unwrap()).collect();
        assert_eq!(queue.push(3).err(), Some(Full));
        assert_eq!(gauge.get(), 3);
        queue.free();
        assert_eq!(queue.take(ONE), Some(vec![0]));
        queue.free();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }), Some(vec![1, 2]));
        assert_eq!(gauge.get(), 0);
    }

    #[test]
    fn what_does_not_fill_a_batch_is_left_for_the_next() {
        let (queue, _) = queue(2, 16);
        let _places: Vec<_> = (0..17).map(|job| queue.push(job).ok().unwrap()).collect();
        let take = || queue.take(Batching { max: 6, ..ONE }).inspect(|_| queue.free()).map(|jobs| jobs.len());
        assert_eq!([take(), take(), take(), take()], [6, 6, 4, 1].map(Some));
    }

    #[test]
    fn who_has_gone_leaves_the_queue() {
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
    fn a_closed_queue_gives_out_what_it_has_and_ends() {
        let (queue, _) = queue(1, 2);
        let _slot = queue.push(1).ok().unwrap();
        queue.close();
        assert_eq!(queue.take(ONE), Some(vec![1]));
        queue.free();
        assert_eq!(queue.take(ONE), None);
    }

    #[test]
    fn a_free_session_is_a_place_more_until_it_takes_something() {
        let (queue, _) = queue(1, 1);
        let mut places = vec![queue.push(1).ok().unwrap(), queue.push(2).ok().unwrap()];
        assert_eq!(queue.push(3).err(), Some(Full));
        assert_eq!(queue.take(ONE), Some(vec![1]));
        assert_eq!(queue.push(3).err(), Some(Full), "it is busy, and one waits");
        queue.free();
        places.push(queue.push(3).ok().unwrap());
        assert_eq!(queue.take(ONE), Some(vec![2]));
    }

    #[test]
    fn a_session_that_may_wait_takes_what_comes_meanwhile() {
        let (queue, _) = queue(2, 4);
        let batching = Batching { max: 3, delay: Duration::from_secs(600) };
        let session = {
            let queue = Arc::clone(&queue);
            thread::spawn(move || queue.take(batching))
        };
        // It would wait ten minutes for a third.
        let _places: Vec<_> = (0..3).map(|job| queue.push(job).ok().unwrap()).collect();
        assert_eq!(session.join().unwrap(), Some(vec![0, 1, 2]));

        // And it does not wait any longer than it may.
        let _slot = queue.push(7).ok().unwrap();
        assert_eq!(queue.take(Batching { max: 3, delay: Duration::from_millis(1) }), Some(vec![7]));
    }

    #[test]
    fn every_job_is_given_out_once_however_many_sessions_take() {
        let (queue, _) = queue(4, 10_000);
        let sessions: Vec<_> = (0..4)
            .map(|index| {
                let queue = Arc::clone(&queue);
                let batching = Batching { max: 1 + index, delay: Duration::from_micros(50 * index as u64) };
                let take = move || queue.take(batching).inspect(|_| queue.free());
                thread::spawn(move || std::iter::from_fn(take).flatten().collect::<Vec<u32>>())
            })
            .collect();
        let places: Vec<_> = (0..10_000).map(|job| queue.push(job).ok().unwrap()).collect();
        queue.close();
        let mut taken: Vec<u32> = sessions.into_iter().flat_map(|session| session.join().unwrap()).collect();
        taken.sort_unstable();
        assert_eq!(taken, (0..10_000).collect::<Vec<_>>());
        drop(places);
    }
}
