use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use grasp::Priority;

/// Waiting jobs. Callers are served in turn, and the jobs of a caller in their order; jobs with batch priority are
/// served when no normal job waits, or after [`OVERTAKING`] normal ones.
pub(crate) struct FairQueue<T> {
    /// The callers with waiting jobs, in the order in which they are served: with normal and with batch priority.
    of_class: [VecDeque<CallerQueue<T>>; 2],
    /// Number of waiting jobs.
    waiting: usize,
    /// Normal jobs that were taken since the last batch job, while one was waiting.
    overtaken: u32,
}

/// The waiting jobs of a caller, never empty.
struct CallerQueue<T> {
    caller: Caller,
    jobs: VecDeque<Waiting<T>>,
}

struct Waiting<T> {
    number: u64,
    since: Instant,
    deadline: Option<Instant>,
    job: T,
}

impl<T> Waiting<T> {
    /// When a batch with this job must start if it waits at most `delay` for further jobs: not later than halfway to
    /// the job's deadline.
    fn start_by(&self, delay: Duration) -> Instant {
        let half = self.deadline.map(|deadline| deadline.saturating_duration_since(self.since) / 2);
        self.since + half.map_or(delay, |half| half.min(delay))
    }
}

/// The sender of a request: callers share the server fairly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Caller {
    /// SHA-256 of the access token.
    Token([u8; 32]),
    /// The address of the client; for IPv6 its /64 network, because a client can use all addresses in it.
    Address(IpAddr),
    /// Neither is known.
    Unknown,
}

/// Who sent a request, and when it must be answered.
#[derive(Clone, Copy, Debug)]
pub struct RequestMetadata {
    /// The sender.
    pub caller: Caller,
    /// The order in which requests are served.
    pub priority: Priority,
    /// When the caller stops waiting.
    pub deadline: Option<Instant>,
}

/// The place of a waiting job.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    class: usize,
    queue: usize,
    job: usize,
}

/// After this many normal jobs, a waiting batch job is taken, so that batch jobs do not wait for ever.
const OVERTAKING: u32 = 8;

impl<T> FairQueue<T> {
    pub fn new() -> Self {
        Self { of_class: [VecDeque::new(), VecDeque::new()], waiting: 0, overtaken: 0 }
    }

    /// Number of waiting jobs.
    pub fn len(&self) -> usize {
        self.waiting
    }

    /// Whether no job waits.
    pub fn is_empty(&self) -> bool {
        self.waiting == 0
    }

    /// Number of waiting jobs that are taken before a new job.
    pub fn ahead_of(&self, request: RequestMetadata) -> usize {
        let ahead = |queues: &VecDeque<CallerQueue<T>>| {
            let own = queues.iter().find(|queue| queue.caller == request.caller).map_or(0, |queue| queue.jobs.len());
            let others = queues.iter().filter(|queue| queue.caller != request.caller);
            own + others.map(|queue| queue.jobs.len().min(own + 1)).sum::<usize>()
        };
        let [normal, batch] = &self.of_class;
        match request.priority {
            Priority::Normal => ahead(normal),
            Priority::Batch => normal.iter().map(|queue| queue.jobs.len()).sum::<usize>() + ahead(batch),
        }
    }

    /// The job that a new job displaces in a full queue. A normal job displaces the newest batch job of the caller with
    /// the most of them. If there is none, the newest job of the caller with the most jobs of the same priority is
    /// displaced, if that caller has at least two jobs more than this one.
    pub fn displaced_by(&self, request: RequestMetadata) -> Option<Place> {
        let longest = |class: usize| {
            let queues = self.of_class[class].iter().enumerate();
            queues.map(|(index, queue)| (queue.jobs.len(), index)).max_by_key(|(length, _)| *length)
        };
        let class = request.priority as usize;
        let batch = Priority::Batch as usize;
        if class < batch
            && let Some((_, index)) = longest(batch)
        {
            return self.newest(batch, index);
        }
        let own = self.of_class[class].iter().find(|queue| queue.caller == request.caller);
        let own = own.map_or(0, |queue| queue.jobs.len());
        longest(class).filter(|(length, _)| *length >= own + 2).and_then(|(_, index)| self.newest(class, index))
    }

    /// Whether `count` new jobs of a caller, which follow `before` new ones that found free places, can all [displace
    /// one](Self::displaced_by).
    pub fn can_displace(&self, request: RequestMetadata, before: usize, count: usize) -> bool {
        let class = request.priority as usize;
        let lengths = |class: usize| self.of_class[class].iter().map(|queue| (queue.caller, queue.jobs.len()));
        let is_own = |&(caller, _): &(Caller, usize)| caller == request.caller;
        let own = before + lengths(class).find(is_own).map_or(0, |(_, length)| length);
        let mut others: Vec<usize> = lengths(class).filter(|queue| !is_own(queue)).map(|(_, length)| length).collect();
        let mut of_batch: usize = match request.priority {
            Priority::Normal => lengths(Priority::Batch as usize).map(|(_, length)| length).sum(),
            Priority::Batch => 0,
        };
        (own..own + count).all(|own| {
            let longest = others.iter_mut().max();
            let displaced =
                if of_batch > 0 { Some(&mut of_batch) } else { longest.filter(|length| **length >= own + 2) };
            displaced.map(|length| *length -= 1).is_some()
        })
    }

    /// The newest job of a queue.
    fn newest(&self, class: usize, queue: usize) -> Option<Place> {
        let job = self.of_class[class][queue].jobs.len().checked_sub(1)?;
        Some(Place { class, queue, job })
    }

    /// Appends a job with a number above those of all jobs before it.
    pub fn append(&mut self, request: RequestMetadata, number: u64, job: T) {
        let waiting = Waiting { number, since: Instant::now(), deadline: request.deadline, job };
        self.waiting += 1;
        let queues = &mut self.of_class[request.priority as usize];
        match queues.iter_mut().find(|queue| queue.caller == request.caller) {
            Some(queue) => queue.jobs.push_back(waiting),
            None => queues.push_back(CallerQueue { caller: request.caller, jobs: VecDeque::from([waiting]) }),
        }
    }

    /// Takes the next job: the oldest of the caller whose turn it is.
    pub fn take(&mut self) -> Option<T> {
        let [normal, batch] = &mut self.of_class;
        let is_batch = normal.is_empty() || !batch.is_empty() && self.overtaken >= OVERTAKING;
        self.overtaken = if is_batch || batch.is_empty() { 0 } else { self.overtaken + 1 };
        let queues = if is_batch { batch } else { normal };
        let mut queue = queues.pop_front()?;
        let next = queue.jobs.pop_front()?;
        self.waiting -= 1;
        if !queue.jobs.is_empty() {
            queues.push_back(queue);
        }
        Some(next.job)
    }

    /// The place of a job by its number.
    pub fn find(&self, number: u64) -> Option<Place> {
        self.of_class.iter().enumerate().find_map(|(class, queues)| {
            queues.iter().enumerate().find_map(|(queue, CallerQueue { jobs, .. })| {
                // Sorted by number, because jobs are appended in that order.
                let job = jobs.binary_search_by_key(&number, |waiting| waiting.number).ok()?;
                Some(Place { class, queue, job })
            })
        })
    }

    /// Removes the job at a place.
    pub fn remove(&mut self, Place { class, queue, job }: Place) -> Option<T> {
        let queues = &mut self.of_class[class];
        let removed = queues.get_mut(queue)?.jobs.remove(job)?;
        self.waiting -= 1;
        if queues[queue].jobs.is_empty() {
            queues.remove(queue);
        }
        Some(removed.job)
    }

    /// When a batch of the waiting jobs must start if each waits at most `delay`; `None` if no job waits.
    pub fn start_by(&self, delay: Duration) -> Option<Instant> {
        self.of_class.iter().flatten().flat_map(|queue| &queue.jobs).map(|waiting| waiting.start_by(delay)).min()
    }
}
