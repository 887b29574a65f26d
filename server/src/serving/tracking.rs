use std::sync::Arc;
use std::time::{Duration, Instant};

use grasp::{Fusion, View};
use grasp_proto::{DetectParams, FieldError, MAX_VIEWS, TABLE_HEIGHT, Workspace, check_count, depth_view, pb};
use nalgebra::Isometry3;
use prometheus::IntGauge;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::rpc::call::{FrameStamp, Observed};
use crate::rpc::refusal::Refusal;
use crate::serving::engine::Engine;
use crate::serving::scene::{FusionGrid, Integrated, camera_positions};
use grasp_planner::Scene;

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

/// The volume of a TrackGrasps stream, to which each request adds views.
pub(crate) struct Track {
    grid: FusionGrid,
    fusion: Fusion,
    frame_from_task: Isometry3<f64>,
    origin: FrameStamp,
    /// The parameters of the latest request with options.
    pub params: DetectParams,
}

/// The scene, its parameters, frame and stamp, and what the fusion showed.
type Fused = (Scene, DetectParams, FrameStamp, Observed);

impl Track {
    /// Adds views to the volume, or to a new one if a workspace is given. An invalid view is an error; views before it
    /// in the request may already be integrated.
    pub fn integrate(
        track: Option<Self>,
        engine: &Engine,
        params: DetectParams,
        workspace: Option<pb::Workspace>,
        views: &mut [pb::DepthView],
    ) -> (Option<Self>, Result<Fused, Refusal>) {
        match (track, workspace) {
            (None, None) => {
                let missing = FieldError::new("workspace", "absent", "must be given in the first request of a stream");
                (None, Err(missing.into()))
            }
            (Some(mut track), None) => {
                let views = converted(views, &track.frame_from_task);
                let fused = views.map_err(Refusal::from).and_then(|views| track.add(engine, params, &views, None));
                (Some(track), fused)
            }
            (track, Some(workspace)) => match Self::start(engine, &params, workspace, views) {
                Ok((mut track, views, table)) => {
                    let fused = track.add(engine, params, &views, table);
                    (Some(track), fused)
                }
                Err(refusal) => (track, Err(refusal)),
            },
        }
    }

    /// An empty volume, its first views, and the table that determined its pose.
    fn start(
        engine: &Engine,
        params: &DetectParams,
        workspace: pb::Workspace,
        views: &mut [pb::DepthView],
    ) -> Result<(Self, Vec<View>, Option<pb::FoundTable>), Refusal> {
        let mut workspace = Workspace::try_from(workspace)?;
        let origin =
            FrameStamp::checked("workspace.frame_id", std::mem::take(&mut workspace.frame_id), workspace.stamp)?;
        // The rotation of the grid may depend on the camera positions.
        check_count(views.len())?;
        let table = workspace.find_table(views, params.table.unwrap_or(TABLE_HEIGHT))?;
        let frame_from_task = workspace.frame_from_task;
        let views = converted(views, &frame_from_task)?;
        let grid = FusionGrid::of(&engine.source, &workspace, &camera_positions(&views))?;
        Ok((Self { fusion: grid.fusion(), grid, frame_from_task, origin, params: params.clone() }, views, table))
    }

    fn add(
        &mut self,
        engine: &Engine,
        params: DetectParams,
        views: &[View],
        table: Option<pb::FoundTable>,
    ) -> Result<Fused, Refusal> {
        let started = Instant::now();
        self.grid.check(&engine.source)?;
        let Integrated { warnings, .. } = self.grid.integrate(&mut self.fusion, views)?;
        // Without points: those of earlier views are not stored.
        let scene = self.grid.scene(&self.fusion, None)?;
        self.params = DetectParams { constraints: self.grid.within(params.constraints), ..params };
        let observed = Observed { fusion: Some(started.elapsed()), warnings, table };
        Ok((scene, self.params.clone(), self.origin.clone(), observed))
    }
}

fn converted(views: &[pb::DepthView], frame_from_task: &Isometry3<f64>) -> Result<Vec<View>, FieldError> {
    if views.len() > MAX_VIEWS {
        let needed = format_args!("must have at most {MAX_VIEWS}");
        return Err(FieldError::new("views", format_args!("a list of {}", views.len()), needed));
    }
    views.iter().enumerate().map(|(index, view)| depth_view(view, index, frame_from_task)).collect()
}
