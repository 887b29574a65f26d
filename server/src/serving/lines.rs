use std::collections::VecDeque;
use std::time::{Duration, Instant};

use grasp_proto::Priority;

use crate::transport::caller::Caller;

/// The waiting jobs of a queue. Callers are served in turn, and the jobs of a caller in their order; jobs with batch
/// priority are served when no normal one waits, and now and then before one.
pub(super) struct Lines<T> {
    /// The callers with waiting jobs, in the order in which they are served: with normal and with batch priority.
    of_class: [VecDeque<Line<T>>; 2],
    /// Number of waiting jobs.
    waiting: usize,
    /// Normal jobs that were taken since the last batch job, while one was waiting.
    overtaken: u32,
}

/// The waiting jobs of a caller, never empty.
struct Line<T> {
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
    /// When a batch with this job must start if it waits at most `delay` for further jobs: not later than halfway to the
    /// job's deadline.
    fn start_by(&self, delay: Duration) -> Instant {
        let half = self.deadline.map(|deadline| deadline.saturating_duration_since(self.since) / 2);
        self.since + half.map_or(delay, |half| half.min(delay))
    }
}

/// Whose job it is, and when it has to be done.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ticket {
    pub caller: Caller,
    pub priority: Priority,
    /// When the caller stops waiting.
    pub deadline: Option<Instant>,
}

/// The place of a waiting job.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    class: usize,
    line: usize,
    job: usize,
}

/// After this many normal jobs, a waiting batch job is taken, so that batch jobs do not wait for ever.
const OVERTAKING: u32 = 8;

impl<T> Lines<T> {
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
    pub fn ahead_of(&self, ticket: Ticket) -> usize {
        let ahead = |lines: &VecDeque<Line<T>>| {
            let own = lines.iter().find(|line| line.caller == ticket.caller).map_or(0, |line| line.jobs.len());
            let others = lines.iter().filter(|line| line.caller != ticket.caller);
            own + others.map(|line| line.jobs.len().min(own + 1)).sum::<usize>()
        };
        let [normal, batch] = &self.of_class;
        match ticket.priority {
            Priority::Normal => ahead(normal),
            Priority::Batch => normal.iter().map(|line| line.jobs.len()).sum::<usize>() + ahead(batch),
        }
    }

    /// The job that a new job displaces in a full queue. A normal job displaces the newest batch job of the caller with
    /// the most of them. If there is none, the newest job of the caller with the most jobs of the same priority is
    /// displaced, if that caller has at least two jobs more than this one.
    pub fn displaced_by(&self, ticket: Ticket) -> Option<Place> {
        let longest = |class: usize| {
            let lines = self.of_class[class].iter().enumerate();
            lines.map(|(index, line)| (line.jobs.len(), index)).max_by_key(|(length, _)| *length)
        };
        let class = ticket.priority as usize;
        let batch = Priority::Batch as usize;
        if class < batch
            && let Some((_, index)) = longest(batch)
        {
            return self.newest(batch, index);
        }
        let own = self.of_class[class].iter().find(|line| line.caller == ticket.caller);
        let own = own.map_or(0, |line| line.jobs.len());
        longest(class).filter(|(length, _)| *length >= own + 2).and_then(|(_, index)| self.newest(class, index))
    }

    /// Whether `count` new jobs of a caller, after `before` that need no place of another, can all [displace
    /// one](Self::displaced_by).
    pub fn can_displace(&self, ticket: Ticket, before: usize, count: usize) -> bool {
        let class = ticket.priority as usize;
        let lengths = |class: usize| self.of_class[class].iter().map(|line| (line.caller, line.jobs.len()));
        let is_own = |&(caller, _): &(Caller, usize)| caller == ticket.caller;
        let own = before + lengths(class).find(is_own).map_or(0, |(_, length)| length);
        let mut others: Vec<usize> = lengths(class).filter(|line| !is_own(line)).map(|(_, length)| length).collect();
        let mut of_batch: usize = match ticket.priority {
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

    /// The newest job of a line.
    fn newest(&self, class: usize, line: usize) -> Option<Place> {
        let job = self.of_class[class][line].jobs.len().checked_sub(1)?;
        Some(Place { class, line, job })
    }

    /// Appends a job with a number above those of all jobs before it.
    pub fn append(&mut self, ticket: Ticket, number: u64, job: T) {
        let waiting = Waiting { number, since: Instant::now(), deadline: ticket.deadline, job };
        self.waiting += 1;
        let lines = &mut self.of_class[ticket.priority as usize];
        match lines.iter_mut().find(|line| line.caller == ticket.caller) {
            Some(line) => line.jobs.push_back(waiting),
            None => lines.push_back(Line { caller: ticket.caller, jobs: VecDeque::from([waiting]) }),
        }
    }

    /// Takes the next job: the oldest of the caller whose turn it is.
    pub fn take(&mut self) -> Option<T> {
        let [normal, batch] = &mut self.of_class;
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

    /// The place of a job by its number.
    pub fn find(&self, number: u64) -> Option<Place> {
        self.of_class.iter().enumerate().find_map(|(class, lines)| {
            lines.iter().enumerate().find_map(|(line, Line { jobs, .. })| {
                // Sorted by number, because jobs are appended in that order.
                let job = jobs.binary_search_by_key(&number, |waiting| waiting.number).ok()?;
                Some(Place { class, line, job })
            })
        })
    }

    /// Removes the job at a place.
    pub fn remove(&mut self, Place { class, line, job }: Place) -> Option<T> {
        let lines = &mut self.of_class[class];
        let removed = lines.get_mut(line)?.jobs.remove(job)?;
        self.waiting -= 1;
        if lines[line].jobs.is_empty() {
            lines.remove(line);
        }
        Some(removed.job)
    }

    /// When a batch of the waiting jobs must start if each waits at most `delay`; `None` if no job waits.
    pub fn start_by(&self, delay: Duration) -> Option<Instant> {
        self.of_class.iter().flatten().flat_map(|line| &line.jobs).map(|waiting| waiting.start_by(delay)).min()
    }
}
