use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use grasp_models::batch_sizes;
use grasp_proto::Priority;
use prometheus::IntGauge;

use crate::transport::caller::Caller;

/// A bounded queue of jobs for a model's sessions. Callers are served in turn, and the jobs of a caller in their order.
/// If the queue is full, a job of a caller with few jobs displaces the newest job of the caller with the most.
pub(crate) struct Queue<T> {
    state: Mutex<State<T>>,
    /// Signals a new job or the closing of the queue.
    changed: Condvar,
    sessions: usize,
    capacity: usize,
    gauge: IntGauge,
}

struct State<T> {
    /// The callers with waiting jobs, in the order in which they are served: with normal and with batch priority.
    lines: [VecDeque<Line<T>>; 2],
    /// Number of waiting jobs.
    waiting: usize,
    next: u64,
    /// Idle sessions. Each allows one job beyond the capacity, because it takes that job immediately.
    free: usize,
    /// Normal jobs that were taken since the last batch job, while one was waiting.
    overtaken: u32,
    closed: bool,
}

/// The waiting jobs of a caller, never empty.
struct Line<T> {
    caller: Caller,
    jobs: VecDeque<Waiting<T>>,
}

struct Waiting<T> {
    number: u64,
    since: Instant,
    job: T,
}

/// Whose job it is, and when it has to be done.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ticket {
    pub caller: Caller,
    pub priority: Priority,
    /// When the caller stops waiting.
    pub deadline: Option<Instant>,
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
    /// The queue is full.
    Full,
    /// The job would be done only after its deadline: the estimated time until then.
    TooLate(Duration),
}

/// After this many normal jobs, a waiting batch job is taken, so that batch jobs do not wait for ever.
const OVERTAKING: u32 = 8;

impl<T> State<T> {
    fn is_full(&self, capacity: usize) -> bool {
        // An idle session may not have woken up yet for a waiting job.
        self.waiting >= capacity + self.free
    }

    /// Number of waiting jobs that are taken before a new job.
    fn ahead_of(&self, ticket: Ticket) -> usize {
        let ahead = |lines: &VecDeque<Line<T>>| {
            let own = lines.iter().find(|line| line.caller == ticket.caller).map_or(0, |line| line.jobs.len());
            let others = lines.iter().filter(|line| line.caller != ticket.caller);
            own + others.map(|line| line.jobs.len().min(own + 1)).sum::<usize>()
        };
        let [normal, batch] = &self.lines;
        match ticket.priority {
            Priority::Normal => ahead(normal),
            Priority::Batch => normal.iter().map(|line| line.jobs.len()).sum::<usize>() + ahead(batch),
        }
    }

    /// The line whose newest job a new job displaces: that of the batch job of the caller with the most, or of a caller
    /// that has at least two jobs more than this one. Its priority and place.
    fn displaced_by(&self, ticket: Ticket) -> Option<(usize, usize)> {
        let longest = |class: usize| {
            let lines = self.lines[class].iter().enumerate();
            lines.map(|(index, line)| (line.jobs.len(), index)).max_by_key(|(length, _)| *length)
        };
        let class = ticket.priority as usize;
        let batch = Priority::Batch as usize;
        if class < batch
            && let Some((_, index)) = longest(batch)
        {
            return Some((batch, index));
        }
        let own = self.lines[class].iter().find(|line| line.caller == ticket.caller);
        let own = own.map_or(0, |line| line.jobs.len());
        longest(class).filter(|(length, _)| *length >= own + 2).map(|(_, index)| (class, index))
    }

    fn append(&mut self, ticket: Ticket, waiting: Waiting<T>) {
        self.waiting += 1;
        let lines = &mut self.lines[ticket.priority as usize];
        match lines.iter_mut().find(|line| line.caller == ticket.caller) {
            Some(line) => line.jobs.push_back(waiting),
            None => lines.push_back(Line { caller: ticket.caller, jobs: VecDeque::from([waiting]) }),
        }
    }

    /// Takes the next job: the oldest of the caller whose turn it is.
    fn take(&mut self) -> Option<T> {
        let [normal, batch] = &mut self.lines;
        let is_batch = normal.is_empty() || !batch.is_empty() && self.overtaken >= OVERTAKING;
        self.overtaken = if is_batch || batch.is_empty() { 0 } else { self.overtaken + 1 };
        let lines = if is_batch { batch } else { normal };
        let mut line = lines.pop_front()?;
        let next = line.jobs.pop_front()?;
        self.waiting -= 1;
        if !line.jobs.is_empty() {
            lines.push_back(line);
        }
        Some(next.job)
    }

    /// Removes the job at a place in a line.
    fn remove(&mut self, class: usize, line: usize, index: usize) -> Option<T> {
        let lines = &mut self.lines[class];
        let removed = lines.get_mut(line)?.jobs.remove(index)?;
        self.waiting -= 1;
        if lines[line].jobs.is_empty() {
            lines.remove(line);
        }
        Some(removed.job)
    }

    /// When the job that has waited longest arrived.
    fn oldest(&self) -> Option<Instant> {
        self.lines.iter().flatten().filter_map(|line| line.jobs.front()).map(|waiting| waiting.since).min()
    }
}

impl<T> Queue<T> {
    /// A queue for this many sessions and `capacity` waiting jobs, which are counted in `gauge`. During a reload, the
    /// old and the new queue of a model share a gauge.
    pub fn new(sessions: usize, capacity: usize, gauge: IntGauge) -> Self {
        let lines = [VecDeque::new(), VecDeque::new()];
        let state = State { lines, waiting: 0, next: 0, free: sessions, overtaken: 0, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new(), sessions, capacity, gauge }
    }

    /// Appends a job, or refuses it immediately. `service` is the expected time of one job. The second value is a job
    /// that the new one displaces. Must not be called after [`close`](Self::close).
    pub fn push(
        self: &Arc<Self>,
        job: T,
        ticket: Ticket,
        service: Service,
    ) -> Result<(QueueSlot<T>, Option<T>), Refused> {
        let mut state = self.lock();
        let now = Instant::now();
        let displaced = self.place(&state, ticket, service, now)?;
        let displaced = displaced.and_then(|(class, line)| {
            let newest = state.lines[class][line].jobs.len() - 1;
            self.gauge.dec();
            state.remove(class, line, newest)
        });
        let number = state.next;
        state.next += 1;
        state.append(ticket, Waiting { number, since: now, job });
        self.gauge.inc();
        drop(state);
        self.changed.notify_one();
        Ok((QueueSlot { queue: Arc::clone(self), number }, displaced))
    }

    /// Whether [`push`](Self::push) would accept a job now.
    pub fn check(&self, ticket: Ticket, service: Service) -> Result<(), Refused> {
        self.place(&self.lock(), ticket, service, Instant::now()).map(|_| ())
    }

    /// The line whose newest job a new job would displace, if the queue is full.
    fn place(
        &self,
        state: &State<T>,
        ticket: Ticket,
        service: Service,
        now: Instant,
    ) -> Result<Option<(usize, usize)>, Refused> {
        // An idle server accepts every job, so that its expectation cannot become wrong for ever.
        if let Some(deadline) = ticket.deadline
            && state.free == 0
        {
            let running = self.sessions as f64 / 2.0;
            let turns = (state.ahead_of(ticket) as f64 + running) / self.sessions as f64;
            let estimate = service.mean.mul_f64(turns) + service.long;
            if deadline < now + estimate {
                return Err(Refused::TooLate(estimate));
            }
        }
        if state.is_full(self.capacity) { state.displaced_by(ticket).map(Some).ok_or(Refused::Full) } else { Ok(None) }
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Number of waiting jobs.
    pub fn waiting(&self) -> usize {
        self.lock().waiting
    }

    /// Waits for jobs and takes a batch; None when the queue is closed and empty. The session counts as busy until it
    /// calls [`free`](Self::free).
    pub fn take(&self, batching: Batching) -> Option<Vec<T>> {
        let mut state = self.lock();
        let waiting = |state: &mut State<T>| state.waiting == 0 && !state.closed;
        state = self.changed.wait_while(state, waiting).unwrap_or_else(PoisonError::into_inner);
        if !batching.delay.is_zero() {
            state = self.gather(state, batching);
        }
        state.free -= 1;
        let count = batching.fitting(state.waiting);
        let jobs: Vec<T> = (0..count).map_while(|_| state.take()).collect();
        self.gauge.sub(jobs.len() as i64);
        let (left, ended) = (state.waiting > 0, state.closed && jobs.is_empty());
        drop(state);
        if left {
            // `push` woke only this session.
            self.changed.notify_one();
        }
        if ended { None } else { Some(jobs) }
    }

    /// Takes all jobs, without a session for them.
    pub fn take_all(&self) -> Vec<T> {
        let mut state = self.lock();
        let jobs: Vec<T> = std::iter::from_fn(|| state.take()).collect();
        self.gauge.sub(jobs.len() as i64);
        jobs
    }

    /// Marks a session as idle. The session calls it before it sends its results, so that a client that has received
    /// one finds a slot for its next request.
    pub fn free(&self) {
        self.lock().free += 1;
    }

    /// Waits until the batch is full, or the delay has passed since the arrival of its first job.
    fn gather<'a>(&self, mut state: MutexGuard<'a, State<T>>, batching: Batching) -> MutexGuard<'a, State<T>> {
        while !state.closed && state.waiting < batching.max {
            let Some(first) = state.oldest() else { break };
            let left = batching.delay.saturating_sub(first.elapsed());
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
        let place = state.lines.iter().enumerate().find_map(|(class, lines)| {
            lines.iter().enumerate().find_map(|(line, Line { jobs, .. })| {
                // Sorted by number, because jobs are appended in that order.
                let index = jobs.binary_search_by_key(&number, |waiting| waiting.number).ok()?;
                Some((class, line, index))
            })
        });
        if let Some((class, line, index)) = place {
            state.remove(class, line, index);
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

    const CALLER: Caller = Caller::Unknown;

    const ONE: Batching = Batching { max: 1, delay: Duration::ZERO };

    fn ticket(caller: Caller, priority: Priority) -> Ticket {
        Ticket { caller, priority, deadline: None }
    }

    /// Pushes a job that does not displace another.
    fn push(queue: &Arc<Queue<u32>>, job: u32) -> Result<QueueSlot<u32>, Refused> {
        let (slot, displaced) = queue.push(job, ticket(CALLER, Priority::Normal), Service::default())?;
        assert_eq!(displaced, None);
        Ok(slot)
    }

    fn queue(sessions: usize, capacity: usize) -> (Arc<Queue<u32>>, IntGauge) {
        let gauge = IntGauge::new("waiting", "Waiting jobs.").unwrap();
        (Arc::new(Queue::new(sessions, capacity, gauge.clone())), gauge)
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
                queue.push(job, ticket(caller(number), Priority::Normal), Service::default()).ok().unwrap()
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
        let push = |number: u8, job: u32| queue.push(job, ticket(caller(number), Priority::Normal), Service::default());
        let mut slots: Vec<_> = (0..4).map(|job| push(1, job).ok().unwrap()).collect();
        assert_eq!(push(1, 4).err(), Some(Refused::Full));
        for (job, displaced) in [(20, 3), (21, 2)] {
            assert!(queue.check(ticket(caller(2), Priority::Normal), Service::default()).is_ok());
            let (slot, job) = push(2, job).ok().unwrap();
            assert_eq!(job, Some(displaced));
            slots.push((slot, None));
        }
        assert_eq!(queue.check(ticket(caller(2), Priority::Normal), Service::default()), Err(Refused::Full));
        assert_eq!(push(2, 22).err(), Some(Refused::Full), "both have two");
        assert_eq!((gauge.get(), queue.waiting()), (4, 4));
        queue.free();
        assert_eq!(queue.take(Batching { max: 4, ..ONE }).unwrap(), [0, 20, 1, 21]);
        drop(slots);
        assert_eq!((gauge.get(), queue.waiting()), (0, 0));
    }

    #[test]
    fn batch_jobs_wait_for_normal_ones_and_are_displaced_by_them_but_not_for_ever() {
        let (queue, _) = queue(1, 12);
        let push = |job: u32, priority| queue.push(job, ticket(CALLER, priority), Service::default());
        let mut slots: Vec<_> = (0..3).map(|job| push(100 + job, Priority::Batch).ok().unwrap()).collect();
        slots.extend((0..10).map(|job| push(job, Priority::Normal).ok().unwrap()));
        assert_eq!(push(103, Priority::Batch).err(), Some(Refused::Full));
        let (slot, displaced) = push(10, Priority::Normal).ok().unwrap();
        assert_eq!(displaced, Some(102));
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
            queue.push(0, Ticket { deadline, ..ticket(caller(number), Priority::Normal) }, service)
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
