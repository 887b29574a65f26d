use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use grasp_proto::{DetectParams, FieldError, MAX_VIEWS, TABLE_HEIGHT, Workspace, check_count, depth_view, pb};
use nalgebra::Isometry3;
use prometheus::IntGauge;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::rpc::call::{FrameStamp, Observed};
use crate::rpc::refusal::Refusal;
use crate::serving::cubes::{CubeScene, Cubes};
use crate::serving::engine::Engine;
use crate::serving::observation::Observation;

/// Limits on TrackGrasps streams: their number, and the time without a request.
pub(crate) struct TrackedVolumes {
    permits: Arc<Semaphore>,
    limit: usize,
    timeout: Duration,
    gauge: IntGauge,
}

/// The permit of one stream.
pub(crate) struct TrackPermit {
    _permit: OwnedSemaphorePermit,
    gauge: IntGauge,
}

impl TrackedVolumes {
    pub fn new(limit: usize, timeout: Duration, gauge: IntGauge) -> Self {
        Self { permits: Arc::new(Semaphore::new(limit)), limit, timeout, gauge }
    }

    /// Takes a permit, or refuses immediately.
    pub fn acquire(&self) -> Result<TrackPermit, Refusal> {
        let Ok(permit) = Arc::clone(&self.permits).try_acquire_owned() else {
            return Err(Refusal::TooManyTracked(self.limit));
        };
        self.gauge.inc();
        Ok(TrackPermit { _permit: permit, gauge: self.gauge.clone() })
    }

    /// Returns after the timeout, with the refusal that ends the stream.
    pub async fn expired(&self) -> Refusal {
        tokio::time::sleep(self.timeout).await;
        Refusal::TrackExpired(self.timeout)
    }
}

impl Drop for TrackPermit {
    fn drop(&mut self) {
        self.gauge.dec();
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
    pub workspace: pb::Workspace,
    /// Half-life of the measurements, views.
    pub half_life: Option<f64>,
}

/// The scenes, frame and stamp, and what the fusion showed.
type Fused = (Vec<CubeScene>, FrameStamp, Observed);

/// Shortest and longest half-life, views.
const HALF_LIFE: RangeInclusive<f64> = 0.5..=10_000.0;

impl Track {
    /// Adds views to the field, or to a new one if a workspace is given. An invalid view is an error; views before it
    /// in the request may already be integrated.
    pub fn integrate(
        track: Option<Self>,
        engine: &Engine,
        params: DetectParams,
        start: Option<Start>,
        views: &mut [pb::DepthView],
    ) -> (Option<Self>, Result<Fused, Refusal>) {
        match (track, start) {
            (None, None) => {
                let missing = FieldError::new("workspace", "absent", "must be given in the first request of a stream");
                (None, Err(missing.into()))
            }
            (Some(mut track), None) => {
                let views = converted(views, track.cubes.frame_from_task());
                let fused = views.map_err(Refusal::from).and_then(|views| track.add(engine, params, views, None));
                (Some(track), fused)
            }
            (track, Some(start)) => match Self::start(engine, &params, start, views) {
                Ok((mut track, views, table)) => {
                    let fused = track.add(engine, params, views, table);
                    (Some(track), fused)
                }
                Err(refusal) => (track, Err(refusal)),
            },
        }
    }

    /// An empty field, its first views, and the table that determined its pose.
    fn start(
        engine: &Engine,
        params: &DetectParams,
        Start { workspace, half_life }: Start,
        views: &mut [pb::DepthView],
    ) -> Result<(Self, Observation, Option<pb::FoundTable>), Refusal> {
        if let Some(half_life) = half_life
            && !HALF_LIFE.contains(&half_life)
        {
            let needed = format_args!("must be from {} to {} views", HALF_LIFE.start(), HALF_LIFE.end());
            return Err(FieldError::new("half_life", half_life, needed).into());
        }
        let mut workspace = Workspace::try_from(workspace)?;
        let origin =
            FrameStamp::checked("workspace.frame_id", std::mem::take(&mut workspace.frame_id), workspace.stamp)?;
        // The rotation of the grid may depend on the camera positions.
        check_count(views.len())?;
        let table = workspace.find_table(views, params.table.unwrap_or(TABLE_HEIGHT))?;
        let views = converted(views, &workspace.frame_from_task)?;
        let cubes = Cubes::of(&engine.source, &workspace, &views.cameras(), params.margin)?;
        let cubes = match half_life {
            Some(half_life) => cubes.forgetting(half_life),
            None => cubes,
        };
        Ok((Self { cubes, origin, params: params.clone() }, views, table))
    }

    fn add(
        &mut self,
        engine: &Engine,
        params: DetectParams,
        mut views: Observation,
        table: Option<pb::FoundTable>,
    ) -> Result<Fused, Refusal> {
        let started = Instant::now();
        self.cubes.check(&engine.source)?;
        params.check_objects(views.is_labelled())?;
        let integrated = self.cubes.integrate(&mut views, params.table)?;
        let (warnings, depth_factors) = (integrated.warnings.clone(), integrated.depth_factors.clone());
        let objects = views.objects(self.cubes.frame_from_task(), &params.objects)?;
        // Without points: those of earlier views are not stored.
        let scenes = self.cubes.scenes(integrated.without_points(), objects.as_ref(), &params)?;
        self.params = params;
        let observed = Observed { fusion: Some(started.elapsed()), warnings, table, depth_factors };
        Ok((scenes, self.origin.clone(), observed))
    }
}

fn converted(views: &[pb::DepthView], frame_from_task: &Isometry3<f64>) -> Result<Observation, FieldError> {
    if views.len() > MAX_VIEWS {
        let needed = format_args!("must have at most {MAX_VIEWS}");
        return Err(FieldError::new("views", format_args!("a list of {}", views.len()), needed));
    }
    let views = views.iter().enumerate().map(|(index, view)| depth_view(view, index, frame_from_task));
    Ok(Observation::Depth(views.collect::<Result<_, _>>()?))
}
