use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp_models::batch_sizes;

use crate::fair_queue::{FairQueue, RequestMetadata};
use crate::observer::ModelObserver;

/// A bounded queue of jobs for the sessions of a model, or of requests for the permits of a
/// [`FairSemaphore`](crate::FairSemaphore). Callers are served in turn, and the jobs of a caller in their order. If the
/// queue is full, a job of a caller with few jobs displaces the newest job of the caller with the most. Jobs that
/// cannot be done before their deadline are refused.
pub(crate) struct Scheduler<T> {
    state: Mutex<State<T>>,
    /// Signals a new job or the closing of the queue.
    changed: Condvar,
    sessions: usize,
    capacity: usize,
    /// Counts the waiting jobs.
    observer: Option<Arc<dyn ModelObserver>>,
}

struct State<T> {
    jobs: FairQueue<T>,
    /// Number of the next job.
    next: u64,
    /// Idle sessions. Each allows one job beyond the capacity, because it takes that job immediately.
    free: usize,
    closed: bool,
}

/// A slot in the queue. Dropping it removes its job, if no session has taken it yet.
pub(crate) struct Slot<T> {
    scheduler: Arc<Scheduler<T>>,
    number: u64,
}

/// How a session forms batches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Batching {
    /// Maximum batch size, jobs.
    pub max: usize,
    /// Maximum time that a job waits for a batch to fill. It waits at most half of the time until its deadline.
    pub delay: Duration,
}

impl Batching {
    /// The batch size for this number of waiting jobs: the largest of the [sizes](batch_sizes) that the networks are
    /// warmed up for, so that batches need no padding.
    fn fitting(self, waiting: usize) -> usize {
        batch_sizes(self.max).take_while(|&size| size <= waiting).last().unwrap_or(0)
    }
}

/// The time of one job.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Service {
    pub mean: Duration,
    /// A time that few jobs exceed.
    pub long: Duration,
}

/// Why a job is refused.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Refused {
    /// There are not enough places for all jobs of the request.
    Full,
    /// The job would be done only after its deadline: the estimated time until it is done.
    TooLate(Duration),
}

impl<T> Scheduler<T> {
    /// A scheduler for this many sessions and `capacity` waiting jobs.
    pub fn new(sessions: usize, capacity: usize, observer: Option<Arc<dyn ModelObserver>>) -> Self {
        let state = State { jobs: FairQueue::new(), next: 0, free: sessions, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new(), sessions, capacity, observer }
    }

    fn count(&self, more: i64) {
        if let Some(observer) = &self.observer {
            observer.waiting(more);
        }
    }

    /// Appends the jobs of a request, or refuses all of them immediately. `service` is the expected time of one job.
    /// The second value is the list of the jobs that the new ones displace. Must not be called after
    /// [`close`](Self::close).
    pub fn push(
        self: &Arc<Self>,
        jobs: Vec<T>,
        request: RequestMetadata,
        service: Service,
    ) -> Result<(Vec<Slot<T>>, Vec<T>), Refused> {
        let mut state = self.lock();
        self.admit(&state, jobs.len(), request, service)?;
        let (mut slots, mut displaced) = (Vec::with_capacity(jobs.len()), Vec::new());
        for job in jobs {
            if self.places(&state) == 0
                && let Some(place) = state.jobs.displaced_by(request)
            {
                displaced.extend(state.jobs.remove(place));
                self.count(-1);
            }
            let number = state.next;
            state.next += 1;
            state.jobs.append(request, number, job);
            self.count(1);
            slots.push(Slot { scheduler: Arc::clone(self), number });
        }
        drop(state);
        slots.iter().for_each(|_| self.changed.notify_one());
        Ok((slots, displaced))
    }

    /// Whether [`push`](Self::push) would accept this number of jobs now.
    pub fn check(&self, jobs: usize, request: RequestMetadata, service: Service) -> Result<(), Refused> {
        self.admit(&self.lock(), jobs, request, service)
    }

    /// Whether there are places for all jobs of a request, and time.
    fn admit(&self, state: &State<T>, jobs: usize, request: RequestMetadata, service: Service) -> Result<(), Refused> {
        // An idle server accepts every job, so that a wrong estimate is corrected by new measurements.
        if let Some(deadline) = request.deadline
            && state.free == 0
        {
            let running = self.sessions as f64 / 2.0;
            let ahead = state.jobs.ahead_of(request) + jobs.saturating_sub(1);
            let turns = (ahead as f64 + running) / self.sessions as f64;
            let estimate = service.mean.mul_f64(turns) + service.long;
            if deadline < Instant::now() + estimate {
                return Err(Refused::TooLate(estimate));
            }
        }
        let free = self.places(state).min(jobs);
        if state.jobs.can_displace(request, free, jobs - free) { Ok(()) } else { Err(Refused::Full) }
    }

    /// Number of free places. An idle session may not have woken up yet for a waiting job.
    fn places(&self, state: &State<T>) -> usize {
        (self.capacity + state.free).saturating_sub(state.jobs.len())
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Number of waiting jobs.
    pub fn waiting(&self) -> usize {
        self.lock().jobs.len()
    }

    /// Waits for jobs and takes a batch; None when the queue is closed and empty. The session counts as busy until it
    /// calls [`free`](Self::free).
    pub fn take(&self, batching: Batching) -> Option<Vec<T>> {
        let mut state = self.lock();
        let waiting = |state: &mut State<T>| state.jobs.is_empty() && !state.closed;
        state = self.changed.wait_while(state, waiting).unwrap_or_else(PoisonError::into_inner);
        if !batching.delay.is_zero() {
            state = self.gather(state, batching);
        }
        state.free -= 1;
        let count = batching.fitting(state.jobs.len());
        let jobs: Vec<T> = (0..count).map_while(|_| state.jobs.take()).collect();
        self.count(-(jobs.len() as i64));
        let (left, ended) = (!state.jobs.is_empty(), state.closed && jobs.is_empty());
        drop(state);
        if left {
            // `push` woke only this session.
            self.changed.notify_one();
        }
        if ended { None } else { Some(jobs) }
    }

    /// Takes the next job if a session is idle, which counts as busy until [`free`](Self::free) is called.
    pub fn try_take(&self) -> Option<T> {
        let mut state = self.lock();
        if state.free == 0 {
            return None;
        }
        let job = state.jobs.take()?;
        state.free -= 1;
        self.count(-1);
        Some(job)
    }

    /// Takes all jobs, without a session for them.
    pub fn take_all(&self) -> Vec<T> {
        let mut state = self.lock();
        let jobs: Vec<T> = std::iter::from_fn(|| state.jobs.take()).collect();
        self.count(-(jobs.len() as i64));
        jobs
    }

    /// Marks a session as idle. The session calls it before it sends its results, so that a client that has received
    /// one finds a slot for its next request.
    pub fn free(&self) {
        self.lock().free += 1;
    }

    /// Waits until the batch is full, or one of its jobs can wait no longer.
    fn gather<'a>(&self, mut state: MutexGuard<'a, State<T>>, batching: Batching) -> MutexGuard<'a, State<T>> {
        while !state.closed && state.jobs.len() < batching.max {
            let Some(start) = state.jobs.start_by(batching.delay) else { break };
            let left = start.saturating_duration_since(Instant::now());
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
        if let Some(place) = state.jobs.find(number) {
            state.jobs.remove(place);
            self.count(-1);
        }
    }

    /// Ignores poisoning: no code that holds the lock can panic halfway through a change.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Drop for Slot<T> {
    fn drop(&mut self) {
        self.scheduler.remove(self.number);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use std::sync::atomic::{AtomicI64, Ordering};

    use grasp::Priority;

    use super::*;
    use crate::fair_queue::Caller;
    use crate::observer::Refusal;

    const CALLER: Caller = Caller::Unknown;

    /// The number of waiting jobs, as it was counted.
    #[derive(Default)]
    struct Waiting(AtomicI64);

    impl Waiting {
        fn get(&self) -> i64 {
            self.0.load(Ordering::Relaxed)
        }
    }

    impl ModelObserver for Waiting {
        fn waiting(&self, more: i64) {
            self.0.fetch_add(more, Ordering::Relaxed);
        }

        fn accepted(&self, _: Priority, _: usize) {}

        fn refused(&self, _: Refusal) {}

        fn batch(&self, _: usize) {}

        fn hanging(&self, _: i64) {}
    }

    const ONE: Batching = Batching { max: 1, delay: Duration::ZERO };

    fn request(caller: Caller, priority: Priority) -> RequestMetadata {
        RequestMetadata { caller, priority, deadline: None }
    }

    /// Pushes a job that does not displace another.
    fn push(queue: &Arc<Scheduler<u32>>, job: u32) -> Result<Slot<u32>, Refused> {
        let (mut slots, displaced) = queue.push(vec![job], request(CALLER, Priority::Normal), Service::default())?;
        assert!(displaced.is_empty());
        Ok(slots.remove(0))
    }

    fn queue(sessions: usize, capacity: usize) -> (Arc<Scheduler<u32>>, Arc<Waiting>) {
        let gauge = Arc::new(Waiting::default());
        (Arc::new(Scheduler::new(sessions, capacity, Some(Arc::clone(&gauge) as Arc<dyn ModelObserver>))), gauge)
    }

    #[test]
    fn jobs_are_taken_in_order_and_limited_by_the_capacity() {
        let (queue, gauge) = queue(0, 3);
        let _slots: Vec<_> = (0..3).map(|job| push(&queue, job).ok().unwrap()).collect();
        assert_eq!(push(&queue, 3).err(), Some(Refused::Full));
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
        let _slots: Vec<_> = (0..17).map(|job| push(&queue, job).ok().unwrap()).collect();
        let take = || queue.take(Batching { max: 6, ..ONE }).inspect(|_| queue.free()).map(|jobs| jobs.len());
        assert_eq!([take(), take(), take(), take()], [6, 6, 4, 1].map(Some));
    }

    #[test]
    fn a_dropped_slot_removes_its_job() {
        let (queue, gauge) = queue(1, 2);
        let first = push(&queue, 1).ok().unwrap();
        let second = push(&queue, 2).ok().unwrap();
        drop(first);
        assert_eq!(gauge.get(), 1);
        let _third = push(&queue, 3).ok().unwrap();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }), Some(vec![2, 3]));
        drop(second);
        assert_eq!(gauge.get(), 0);
    }

    #[test]
    fn a_closed_queue_returns_its_jobs_and_then_none() {
        let (queue, _) = queue(1, 2);
        let _slot = push(&queue, 1).ok().unwrap();
        queue.close();
        assert_eq!(queue.take(ONE), Some(vec![1]));
        queue.free();
        assert_eq!(queue.take(ONE), None);
    }

    #[test]
    fn an_idle_session_adds_one_to_the_capacity() {
        let (queue, _) = queue(1, 1);
        let mut slots = vec![push(&queue, 1).ok().unwrap(), push(&queue, 2).ok().unwrap()];
        assert_eq!(push(&queue, 3).err(), Some(Refused::Full));
        assert_eq!(queue.take(ONE), Some(vec![1]));
        assert_eq!(push(&queue, 3).err(), Some(Refused::Full), "the session is busy and one job waits");
        queue.free();
        slots.push(push(&queue, 3).ok().unwrap());
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
        let _slots: Vec<_> = (0..3).map(|job| push(&queue, job).ok().unwrap()).collect();
        assert_eq!(session.join().unwrap(), Some(vec![0, 1, 2]));

        // After the delay it takes an incomplete batch.
        let _slot = push(&queue, 7).ok().unwrap();
        assert_eq!(queue.take(Batching { max: 3, delay: Duration::from_millis(1) }), Some(vec![7]));
    }

    #[test]
    fn a_job_does_not_wait_for_its_batch_until_its_deadline() {
        let (queue, _) = queue(1, 4);
        let deadline = Some(Instant::now() + Duration::from_millis(200));
        let urgent = RequestMetadata { deadline, ..request(CALLER, Priority::Normal) };
        let _slots =
            [push(&queue, 1), queue.push(vec![2], urgent, Service::default()).map(|(mut slots, _)| slots.remove(0))];
        // The delay would end after ten minutes.
        assert_eq!(queue.take(Batching { max: 3, delay: Duration::from_secs(600) }), Some(vec![1, 2]));
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
        let slots: Vec<_> = (0..10_000).map(|job| push(&queue, job).ok().unwrap()).collect();
        queue.close();
        let mut jobs: Vec<u32> = sessions.into_iter().flat_map(|session| session.join().unwrap()).collect();
        jobs.sort_unstable();
        assert_eq!(jobs, (0..10_000).collect::<Vec<_>>());
        drop(slots);
    }

    /// The caller with this number.
    fn caller(number: u8) -> Caller {
        Caller::Address([10, 0, 0, number].into())
    }

    #[test]
    fn callers_are_served_in_turn_and_their_jobs_in_order() {
        let (queue, _) = queue(1, 16);
        let slots: Vec<_> = [(1, 10), (1, 11), (1, 12), (1, 13), (2, 20), (2, 21), (3, 30)]
            .map(|(number, job)| {
                queue.push(vec![job], request(caller(number), Priority::Normal), Service::default()).ok().unwrap()
            })
            .into();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }).unwrap(), [10, 20, 30, 11]);
        queue.free();
        assert_eq!(queue.take(Batching { max: 8, ..ONE }).unwrap(), [21, 12]);
        drop(slots);
    }

    #[test]
    fn in_a_full_queue_a_caller_with_few_jobs_displaces_the_newest_of_the_caller_with_the_most() {
        let (queue, gauge) = queue(0, 4);
        let push =
            |number: u8, job: u32| queue.push(vec![job], request(caller(number), Priority::Normal), Service::default());
        let mut slots: Vec<_> = (0..4).map(|job| push(1, job).ok().unwrap()).collect();
        assert_eq!(push(1, 4).err(), Some(Refused::Full));
        for (job, displaced) in [(20, 3), (21, 2)] {
            assert!(queue.check(1, request(caller(2), Priority::Normal), Service::default()).is_ok());
            let (slot, job) = push(2, job).ok().unwrap();
            assert_eq!(job, [displaced]);
            slots.push((slot, Vec::new()));
        }
        assert_eq!(queue.check(1, request(caller(2), Priority::Normal), Service::default()), Err(Refused::Full));
        assert_eq!(push(2, 22).err(), Some(Refused::Full), "both have two");
        assert_eq!((gauge.get(), queue.waiting()), (4, 4));
        queue.free();
        assert_eq!(queue.take(Batching { max: 4, ..ONE }).unwrap(), [0, 20, 1, 21]);
        drop(slots);
        assert_eq!((gauge.get(), queue.waiting()), (0, 0));
    }

    #[test]
    fn the_jobs_of_a_request_are_all_accepted_or_none_and_then_displace_none() {
        let (queue, gauge) = queue(0, 6);
        let push = |number: u8, jobs: std::ops::Range<u32>, priority| {
            queue.push(jobs.collect(), request(caller(number), priority), Service::default())
        };
        let mut slots =
            vec![push(1, 0..4, Priority::Normal).ok().unwrap(), push(1, 4..6, Priority::Batch).ok().unwrap()];
        assert_eq!(push(2, 20..25, Priority::Normal).err(), Some(Refused::Full), "two batch jobs and one of the four");
        assert_eq!((gauge.get(), queue.waiting()), (6, 6));
        let (accepted, displaced) = push(2, 20..23, Priority::Normal).ok().unwrap();
        assert_eq!((accepted.len(), displaced), (3, vec![5, 4, 3]));
        slots.push((accepted, Vec::new()));
        assert_eq!(push(2, 23..24, Priority::Normal).err(), Some(Refused::Full), "both have three");
        assert_eq!(push(3, 30..33, Priority::Normal).err(), Some(Refused::Full), "with two it has as many as they");
        assert_eq!((gauge.get(), queue.waiting()), (6, 6));
    }

    #[test]
    fn batch_jobs_wait_for_normal_ones_and_are_displaced_by_them_but_not_for_ever() {
        let (queue, _) = queue(1, 12);
        let push = |job: u32, priority| queue.push(vec![job], request(CALLER, priority), Service::default());
        let mut slots: Vec<_> = (0..3).map(|job| push(100 + job, Priority::Batch).ok().unwrap()).collect();
        slots.extend((0..10).map(|job| push(job, Priority::Normal).ok().unwrap()));
        assert_eq!(push(103, Priority::Batch).err(), Some(Refused::Full));
        let (slot, displaced) = push(10, Priority::Normal).ok().unwrap();
        assert_eq!(displaced, [102]);
        let taken: Vec<u32> = (0..13).map(|_| queue.take(ONE).inspect(|_| queue.free()).unwrap()[0]).collect();
        assert_eq!(taken, [0, 1, 2, 3, 4, 5, 6, 7, 100, 8, 9, 10, 101]);
        drop((slots, slot));
    }

    #[test]
    fn a_job_that_cannot_be_done_before_its_deadline_is_refused_unless_a_session_is_idle() {
        let (queue, _) = queue(1, 16);
        let service = Service { mean: Duration::from_secs(10), long: Duration::from_secs(10) };
        let push = |number: u8, seconds: u64| {
            let deadline = Some(Instant::now() + Duration::from_secs(seconds));
            queue.push(vec![0], RequestMetadata { deadline, ..request(caller(number), Priority::Normal) }, service)
        };
        let mut slots = vec![push(1, 5).ok().unwrap()];
        assert_eq!(queue.take(ONE), Some(vec![0]));
        // The running job takes 5 seconds more, this one 10.
        assert_eq!(push(1, 14).err(), Some(Refused::TooLate(Duration::from_secs(15))));
        slots.extend([push(1, 16).ok().unwrap(), push(1, 26).ok().unwrap(), push(1, 36).ok().unwrap()]);
        // Of the three jobs of the other caller only one is before it.
        assert!(matches!(push(2, 24), Err(Refused::TooLate(_))));
        slots.push(push(2, 26).ok().unwrap());
        drop(slots);
    }
}
