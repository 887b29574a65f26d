use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use grasp_proto::{DetectParams, FieldError, TABLE_HEIGHT, Workspace, check_count, pb};
use prometheus::IntGauge;
use prost_types::Timestamp;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::cubes::{Cubes, Fused, edge};
use super::engine::Engine;
use super::frame_stamp::FrameStamp;
use super::observation::Observation;
use super::refusal::Refusal;

/// Limits on TrackGrasps streams: the number of their volumes, and the time without a request.
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
    pub fn acquire(&self) -> Result<TrackPermit, Refusal> {
        let volumes = self.take(1)?;
        Ok(TrackPermit { volumes, gauge: self.gauge.clone() })
    }

    /// Changes the number of a stream's volumes, or refuses immediately.
    pub fn resize(&self, permit: &mut TrackPermit, volumes: usize) -> Result<(), Refusal> {
        if volumes > self.limit {
            let value = format_args!("a workspace of {volumes} cubes");
            let needed = format_args!("must have at most {} (--max-tracked)", self.limit);
            return Err(FieldError::new("workspace.extent", value, needed).into());
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

    fn take(&self, volumes: usize) -> Result<OwnedSemaphorePermit, Refusal> {
        let count = u32::try_from(volumes).unwrap_or(u32::MAX);
        let permit = Arc::clone(&self.permits).try_acquire_many_owned(count);
        let permit = permit.map_err(|_| Refusal::TooManyTracked { needed: volumes, limit: self.limit })?;
        self.gauge.add(volumes as i64);
        Ok(permit)
    }

    /// Returns after the timeout, with the refusal that ends the stream.
    pub async fn expired(&self) -> Refusal {
        tokio::time::sleep(self.timeout).await;
        Refusal::TrackExpired(self.timeout)
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

/// The field of a TrackGrasps stream, to which each request adds views.
pub(crate) struct Track {
    cubes: Cubes,
    origin: FrameStamp,
    /// The parameters of the latest request with options.
    pub params: DetectParams,
}

/// The start of a new field.
pub(crate) struct Start {
    workspace: Workspace,
    origin: FrameStamp,
    /// Half-life of the measurements, views.
    half_life: Option<f64>,
}

impl Start {
    pub fn checked(workspace: pb::Workspace, half_life: Option<f64>) -> Result<Self, Refusal> {
        if let Some(half_life) = half_life
            && !HALF_LIFE.contains(&half_life)
        {
            let needed = format_args!("must be from {} to {} views", HALF_LIFE.start(), HALF_LIFE.end());
            return Err(FieldError::new("half_life", half_life, needed).into());
        }
        let mut workspace = Workspace::try_from(workspace)?;
        let frame_id = std::mem::take(&mut workspace.frame_id);
        let origin = FrameStamp::checked("workspace.frame_id", frame_id, workspace.stamp)?;
        Ok(Self { workspace, origin, half_life })
    }

    /// The number of volumes that the field of a planner has.
    pub fn volumes(&self, engine: &Engine, params: &DetectParams) -> Result<usize, FieldError> {
        Cubes::count(&engine.source, &self.workspace, params.margin)
    }
}

/// Shortest and longest half-life, views.
const HALF_LIFE: RangeInclusive<f64> = 0.5..=10_000.0;

impl Track {
    /// Adds views to the field, or to a new one if a workspace is given. `stamp` is their time, if it is not that of the
    /// workspace. An invalid view is an error; views before it in the request may already be integrated. Stops when
    /// `is_wanted` returns false.
    pub fn integrate(
        track: Option<Self>,
        engine: &Engine,
        params: DetectParams,
        start: Option<Start>,
        views: &mut [pb::DepthView],
        stamp: Option<Timestamp>,
        is_wanted: &dyn Fn() -> bool,
    ) -> (Option<Self>, Result<(Fused, FrameStamp), Refusal>) {
        match (track, start) {
            (None, None) => {
                let missing = FieldError::new("workspace", "absent", "must be given in the first request of a stream");
                (None, Err(missing.into()))
            }
            (Some(mut track), None) => {
                let views = Observation::depth(views, track.cubes.frame_from_task());
                let views = views.map_err(Refusal::from);
                let fused = views.and_then(|views| track.add(engine, params, views, stamp, None, is_wanted));
                (Some(track), fused)
            }
            (track, Some(start)) => match Self::start(engine, &params, start, views) {
                Ok((mut track, views, table)) => {
                    let fused = track.add(engine, params, views, stamp, table, is_wanted);
                    (Some(track), fused)
                }
                Err(refusal) => (track, Err(refusal.into())),
            },
        }
    }

    /// An empty field, its first views, and the table that determined its pose.
    fn start(
        engine: &Engine,
        params: &DetectParams,
        Start { mut workspace, origin, half_life }: Start,
        views: &mut [pb::DepthView],
    ) -> Result<(Self, Observation, Option<pb::FoundTable>), FieldError> {
        // The rotation of the grid may depend on the camera positions.
        check_count(views.len())?;
        let edge = edge(&engine.source, workspace.size);
        let height = params.table.unwrap_or(TABLE_HEIGHT);
        let (views, table) = Observation::of_depth(views, &mut workspace, height, edge)?;
        let cubes = Cubes::of(&engine.source, &workspace, &views.cameras(), params.margin)?;
        Ok((Self { cubes: cubes.tracked(half_life), origin, params: params.clone() }, views, table))
    }

    /// Number of volumes.
    pub fn volumes(&self) -> usize {
        self.cubes.len()
    }

    fn add(
        &mut self,
        engine: &Engine,
        params: DetectParams,
        views: Observation,
        stamp: Option<Timestamp>,
        table: Option<pb::FoundTable>,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<(Fused, FrameStamp), Refusal> {
        self.cubes.check(&engine.source)?;
        let fused = self.cubes.fuse(views, table, &params, is_wanted)?;
        self.params = params;
        self.origin.stamp = stamp.or(self.origin.stamp);
        Ok((fused, self.origin.clone()))
    }
}
