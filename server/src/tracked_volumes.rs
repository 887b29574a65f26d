//! Limits on `TrackGrasps` streams: the number of their volumes, and the time without a request.

use std::sync::Arc;
use std::time::Duration;

use grasp::{Code, RequestError};
use prometheus::IntGauge;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Retry hint when all volumes are in use: streams are long-lived.
const IN_USE: Duration = Duration::from_secs(1);

/// The volumes of all streams.
pub(crate) struct TrackedVolumes {
    permits: Arc<Semaphore>,
    limit: usize,
    timeout: Duration,
    gauge: IntGauge,
}

/// The permit of one stream, for its volumes: one for each cube of its workspace, and at least one.
pub(crate) struct TrackPermit {
    volumes: OwnedSemaphorePermit,
    gauge: IntGauge,
}

impl TrackedVolumes {
    pub fn new(limit: usize, timeout: Duration, gauge: IntGauge) -> Self {
        Self { permits: Arc::new(Semaphore::new(limit)), limit, timeout, gauge }
    }

    /// Takes a permit, or refuses immediately.
    pub fn acquire(&self) -> Result<TrackPermit, RequestError> {
        let volumes = self.take(1)?;
        Ok(TrackPermit { volumes, gauge: self.gauge.clone() })
    }

    /// Changes the number of a stream's volumes, or refuses immediately.
    pub fn resize(&self, permit: &mut TrackPermit, volumes: usize) -> Result<(), RequestError> {
        if volumes > self.limit {
            let value = format_args!("a workspace of {volumes} cubes");
            let needed = format_args!("must have at most {} (--max-tracked)", self.limit);
            return Err(RequestError::invalid("workspace.extent", value, needed));
        }
        let held = permit.count();
        if let Some(surplus) = held.checked_sub(volumes) {
            self.gauge.sub(surplus as i64);
            drop(permit.volumes.split(surplus));
        } else {
            permit.volumes.merge(self.take(volumes - held)?);
        }
        Ok(())
    }

    fn take(&self, volumes: usize) -> Result<OwnedSemaphorePermit, RequestError> {
        let count = u32::try_from(volumes).unwrap_or(u32::MAX);
        let permit = Arc::clone(&self.permits).try_acquire_many_owned(count).map_err(|_| {
            let message = format!(
                "too few of the {} tracked volumes are free: {volumes} needed; close a stream, or raise --max-tracked",
                self.limit
            );
            RequestError::new(Code::ResourceExhausted, message).after(IN_USE)
        })?;
        self.gauge.add(volumes as i64);
        Ok(permit)
    }

    /// Returns after the timeout, with the error that ends the stream.
    pub async fn expired(&self) -> RequestError {
        tokio::time::sleep(self.timeout).await;
        let message =
            format!("no request for {:?} (--track-timeout), the volume was dropped; open a new stream", self.timeout);
        RequestError::new(Code::Aborted, message)
    }
}

impl TrackPermit {
    /// Number of volumes.
    pub fn count(&self) -> usize {
        self.volumes.num_permits()
    }
}

impl Drop for TrackPermit {
    fn drop(&mut self) {
        self.gauge.sub(self.count() as i64);
    }
}
