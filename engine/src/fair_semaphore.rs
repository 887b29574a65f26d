use std::sync::Arc;
use std::time::{Duration, Instant};

use grasp::RequestError;
use tokio::sync::oneshot;
use tokio::time::timeout_at;

use crate::fair_queue::RequestMetadata;
use crate::model::Model;
use crate::observer::Refusal;
use crate::scheduler::{Refused, Scheduler, Service};

/// A semaphore whose waiting requests get the permits in the order of a `Scheduler`, for work on the CPU that needs
/// much memory: the conversion of a request and the fusion of its views. A bounded number of requests wait.
#[derive(Clone)]
pub struct FairSemaphore(Arc<Scheduler<oneshot::Sender<Permit>>>);

/// A permit, which returns to the semaphore when it is dropped.
pub struct Permit(Option<FairSemaphore>);

impl FairSemaphore {
    /// `permits` requests have a permit at the same time, and `capacity` others may wait.
    #[must_use]
    pub fn new(permits: usize, capacity: usize) -> Self {
        Self(Arc::new(Scheduler::new(permits, capacity, None)))
    }

    /// Waits for a permit for a request to a model, at most until its deadline, and returns how long it waited. Refuses
    /// immediately if too many requests wait, with the model's retry hint.
    ///
    /// # Errors
    /// [`RequestError`] if too many requests wait, or the deadline passes.
    pub async fn acquire(&self, model: &Model, request: RequestMetadata) -> Result<(Permit, Duration), RequestError> {
        let begun = Instant::now();
        let permit = self.take(request);
        let permit = match request.deadline {
            None => permit.await,
            Some(deadline) => timeout_at(deadline.into(), permit).await.map_err(|_| RequestError::expired())?,
        };
        let permit =
            permit.map_err(|refusal| model.refuse(refusal, "too many requests wait for conversion and fusion"))?;
        Ok((permit, begun.elapsed()))
    }

    /// Waits for a permit, or refuses immediately.
    async fn take(&self, request: RequestMetadata) -> Result<Permit, Refusal> {
        let (sender, permit) = oneshot::channel();
        let (slots, displaced) =
            self.0.push(vec![sender], request, Service::default()).map_err(|refused| match refused {
                Refused::Full => Refusal::Full,
                Refused::TooLate(_) => Refusal::Deadline,
            })?;
        drop(displaced);
        self.pass_on();
        let permit = permit.await;
        drop(slots);
        // The sender of a displaced request is dropped.
        permit.map_err(|_| Refusal::Displaced)
    }

    /// Gives the free permits to the requests that wait.
    fn pass_on(&self) {
        while let Some(next) = self.0.try_take() {
            if let Err(mut permit) = next.send(Permit(Some(self.clone()))) {
                // The request has been cancelled. Freed here: freeing it on drop would recurse.
                permit.0 = None;
                self.0.free();
            }
        }
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        if let Some(semaphore) = self.0.take() {
            semaphore.0.free();
            semaphore.pass_on();
        }
    }
}

#[cfg(test)]
mod tests {
    use grasp::Priority;
    use tokio::task::{JoinHandle, yield_now};

    use super::*;
    use crate::fair_queue::Caller;

    fn metadata(number: u8) -> RequestMetadata {
        RequestMetadata {
            caller: Caller::Address([10, 0, 0, number].into()),
            priority: Priority::Normal,
            deadline: None,
        }
    }

    /// A request of a caller that has begun to wait.
    async fn request(semaphore: &FairSemaphore, caller: u8) -> JoinHandle<Result<Permit, Refusal>> {
        let semaphore = semaphore.clone();
        let request = tokio::spawn(async move { semaphore.take(metadata(caller)).await });
        yield_now().await;
        request
    }

    #[tokio::test]
    async fn callers_get_permits_in_turn_and_few_requests_displace_many() {
        let semaphore = FairSemaphore::new(1, 3);
        let mut running = semaphore.take(metadata(1)).await.unwrap();
        let mut first = Vec::new();
        for _ in 0..3 {
            first.push(request(&semaphore, 1).await);
        }
        assert_eq!(semaphore.take(metadata(1)).await.err(), Some(Refusal::Full));
        let second = request(&semaphore, 2).await;
        assert_eq!(first.pop().unwrap().await.unwrap().err(), Some(Refusal::Displaced));
        for next in [first.remove(0), second, first.remove(0)] {
            assert!(!next.is_finished());
            drop(running);
            running = next.await.unwrap().ok().unwrap();
        }
        drop(running);
        assert!(semaphore.take(metadata(3)).await.is_ok());
    }

    #[tokio::test]
    async fn the_permit_of_a_cancelled_request_goes_to_the_next() {
        let semaphore = FairSemaphore::new(1, 3);
        let running = semaphore.take(metadata(1)).await.unwrap();
        let (cancelled, next) = (request(&semaphore, 1).await, request(&semaphore, 1).await);
        cancelled.abort();
        assert!(cancelled.await.is_err());
        let last = request(&semaphore, 1).await;
        assert_eq!(semaphore.0.waiting(), 2, "it left the line");
        drop(running);
        let got = next.await.unwrap().unwrap();
        last.abort();
        drop(got);
        assert!(last.await.is_err() && semaphore.take(metadata(1)).await.is_ok());
    }
}
