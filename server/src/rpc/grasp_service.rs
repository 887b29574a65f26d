use std::sync::Arc;
use std::time::Duration;

use grasp::{Volume, WORKSPACE_SIZE};
use grasp_proto::pb::find_table_request::Observation as Seen;
use grasp_proto::pb::grasp_service_server::GraspService;
use grasp_proto::pb::recording::{Answer, Request as Recorded};
use grasp_proto::{
    Candidate, DetectParams, FieldError, Priority, TABLE_HEIGHT, Workspace, candidates, check_count, pb, resolution,
};
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

use crate::rpc::call::{Call, CallContext, Calls};
use crate::rpc::pending::{PendingReply, Prepared};
use crate::serving::cubes::{CubeScene, Cubes, check_margin, edge};
use crate::serving::frame_stamp::FrameStamp;
use crate::serving::job::EngineError;
use crate::serving::observation::{Observation, Observed, Placed};
use crate::serving::refusal::Refusal;
use crate::serving::registry::{ModelRegistry, check_voxel_size};
use crate::serving::tracking::TrackedVolumes;
use crate::serving::turns::Turns;
use crate::telemetry::recorder::{Pending, Recorder};
use crate::transport::deadline::Deadline;
use grasp_planner::Scene;

/// Largest volume that is converted on the async runtime's thread, bytes. That takes tens of microseconds, as long as
/// handing it to another thread.
const INLINE_BYTES: usize = 1 << 20;

/// grasp.v1.GraspService.
#[derive(Clone)]
pub(crate) struct GraspRpc {
    pub(super) models: Arc<ModelRegistry>,
    pub(super) calls: Calls,
    pub(super) tracked_volumes: Arc<TrackedVolumes>,
    pub(super) recorder: Recorder,
    /// Requests of one stream that are queued behind the current one.
    pub(super) read_ahead: usize,
    /// The requests that are converted and fused.
    pub(super) conversions: Arc<Turns>,
}

/// A call that is queued, or refused with its refusal not yet sent.
pub(super) struct PendingCall {
    pub call: Call,
    reply: Result<PendingReply, Refusal>,
    recording: Pending,
}

impl PendingCall {
    pub async fn finish(self) -> Result<pb::DetectGraspsResponse, Refusal> {
        let Self { mut call, reply, recording } = self;
        let outcome = match reply {
            Ok(pending) => pending.response(&mut call).await,
            Err(refusal) => Err(refusal),
        };
        let outcome = outcome.map_err(|refusal| call.end(refusal));
        recording.answered(&outcome, |response| Answer::Grasps(response.clone()));
        outcome
    }

    async fn respond(self) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let id = self.call.id.clone();
        self.finish().await.map(Response::new).map_err(|refusal| refusal.status(&id))
    }
}

impl GraspRpc {
    /// `queue` is the length of a queue, `at_once` the number of volumes that a model can compute at the same time. A
    /// stream keeps that many in work, but never fills a queue.
    pub fn new(
        models: Arc<ModelRegistry>,
        calls: Calls,
        tracked_volumes: TrackedVolumes,
        recorder: Recorder,
        conversions: Arc<Turns>,
        queue: usize,
        at_once: usize,
    ) -> Self {
        let read_ahead = at_once.min(queue / 2).max(1);
        let tracked_volumes = Arc::new(tracked_volumes);
        Self { models, calls, tracked_volumes, recorder, read_ahead, conversions }
    }

    /// Opens a call and submits its request. [`PendingCall::finish`] returns both results and refusals.
    pub(super) async fn begin(
        &self,
        request_id: String,
        context: CallContext,
        recording: Pending,
        submit: impl AsyncFnOnce(&mut Call) -> Result<PendingReply, Refusal>,
    ) -> PendingCall {
        let (mut call, checked) = self.calls.open(request_id, context);
        let reply = match checked {
            Ok(()) => submit(&mut call).await,
            Err(refusal) => Err(refusal),
        };
        PendingCall { call, reply, recording }
    }

    pub(super) async fn submit(
        &self,
        request: pb::DetectGraspsRequest,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsRequest { volume, options, .. } = request;
        let volume = volume.ok_or_else(|| FieldError::new("volume", "absent", "must be given"))?;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let prepared = self.of_volume(volume, &params, call).await?;
        PendingReply::detect(call, prepared, params)
    }

    /// Selects the model for a volume and converts the volume.
    async fn of_volume(
        &self,
        mut volume: pb::Volume,
        params: &DetectParams,
        call: &mut Call,
    ) -> Result<Prepared, Refusal> {
        let origin = FrameStamp::checked("volume.frame_id", std::mem::take(&mut volume.frame_id), volume.stamp)?;
        params.check_without_views()?;
        // Selects the model first, so that no volume is converted that no model accepts.
        let engine = self.models.select(&params.model, &params.version, Some(resolution(&volume)?))?;
        call.set_model(&engine);
        let ticket = call.ticket(params.priority);
        engine.check_capacity(1, ticket)?;
        let (checked, waited) = if volume.data.len() <= INLINE_BYTES {
            (Volume::try_from(&volume)?, Duration::ZERO)
        } else {
            let (turn, waited) = self.conversions.of_request(&engine, ticket).await?;
            engine.check_capacity(1, ticket)?;
            (blocking(turn, call.deadline, move |_| Ok(Volume::try_from(&volume)?)).await?, waited)
        };
        check_voxel_size(&checked, &engine)?;
        check_margin(params.margin, checked.resolution() as f64 * checked.voxel_size())?;
        let mut params = params.clone();
        if params.margin > 0.0 {
            params.constraints.workspace = Some(checked.within(params.margin));
        }
        let scenes = vec![CubeScene { scene: Scene { volume: checked, points: None }, params }];
        Ok(Prepared { engine, scenes, observed: Observed { waited, ..Observed::default() }, origin })
    }

    async fn submit_depth(
        &self,
        request: pb::DetectGraspsFromDepthRequest,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsFromDepthRequest { views, workspace, options, .. } = request;
        self.submit_views(views.len(), workspace, options, call, depth(views)).await
    }

    async fn submit_cloud(
        &self,
        request: pb::DetectGraspsFromCloudRequest,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsFromCloudRequest { views, workspace, options, .. } = request;
        self.submit_views(views.len(), workspace, options, call, clouds(views)).await
    }

    /// Fuses `count` views and queues the scenes. `place` converts the views and sets the pose of the workspace.
    async fn submit_views(
        &self,
        count: usize,
        workspace: Option<pb::Workspace>,
        options: Option<pb::Options>,
        call: &mut Call,
        place: impl FnOnce(&mut Workspace, f64, f64) -> Result<Placed, FieldError> + Send + 'static,
    ) -> Result<PendingReply, Refusal> {
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let prepared = self.of_views(count, workspace, &params, call, place).await?;
        PendingReply::detect(call, prepared, params)
    }

    /// Selects the model for `count` views and fuses them. `place` converts the views and sets the pose of the
    /// workspace, in which the table is at the given height and the cubes have the given edge, metres.
    async fn of_views(
        &self,
        count: usize,
        workspace: Option<pb::Workspace>,
        params: &DetectParams,
        call: &mut Call,
        place: impl FnOnce(&mut Workspace, f64, f64) -> Result<Placed, FieldError> + Send + 'static,
    ) -> Result<Prepared, Refusal> {
        check_count(count)?;
        let mut workspace = Workspace::try_from(workspace.unwrap_or_default())?;
        let origin =
            FrameStamp::checked("workspace.frame_id", std::mem::take(&mut workspace.frame_id), workspace.stamp)?;
        let engine = self.models.select(&params.model, &params.version, None)?;
        call.set_model(&engine);
        let ticket = call.ticket(params.priority);
        engine.check_capacity(1, ticket)?;
        let (turn, waited) = self.conversions.of_request(&engine, ticket).await?;
        engine.check_capacity(1, ticket)?;
        let (selected, params) = (Arc::clone(&engine), params.clone());
        let fused = blocking(turn, call.deadline, move |is_wanted| {
            let edge = edge(&selected.source, workspace.size);
            let (observation, table) = place(&mut workspace, params.table.unwrap_or(TABLE_HEIGHT), edge)?;
            let mut cubes = Cubes::of(&selected.source, &workspace, &observation.cameras(), params.margin)?;
            cubes.fuse(observation, table, &params, is_wanted)
        });
        let (scenes, observed) = fused.await?;
        Ok(Prepared { engine, scenes, observed: Observed { waited, ..observed }, origin })
    }

    /// Scores the candidates of a request.
    async fn scores(
        &self,
        request: pb::ScoreGraspsRequest,
        call: &mut Call,
    ) -> Result<pb::ScoreGraspsResponse, Refusal> {
        use pb::score_grasps_request::Scene as Message;
        let pb::ScoreGraspsRequest { candidates: messages, scene, options, .. } = request;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let candidates: Vec<Candidate> = candidates(&messages, &params)?;
        // Checked before the views are fused. The resolution is not known yet.
        let engine = self.models.select(&params.model, &params.version, None)?;
        if engine.source.network().is_none() {
            let value = format_args!("`{}`", engine.source.name());
            return Err(FieldError::new("options.model", value, "which has no network and cannot score").into());
        }
        let one_cube = |workspace: &Option<pb::Workspace>, field: &'static str| match workspace {
            Some(pb::Workspace { extent: Some(_), .. }) => Err(FieldError::new(field, "given", "must be absent")),
            _ => Ok(()),
        };
        let prepared = match scene {
            None => {
                let needed = "volume, depth or clouds must be given";
                return Err(FieldError::new("scene", "absent", needed).into());
            }
            Some(Message::Volume(volume)) => self.of_volume(volume, &params, call).await?,
            Some(Message::Depth(pb::DepthViews { views, workspace })) => {
                one_cube(&workspace, "depth.workspace.extent")?;
                let prepared = self.of_views(views.len(), workspace, &params, call, depth(views)).await;
                prepared.map_err(|refusal| inside("depth", refusal))?
            }
            Some(Message::Clouds(pb::CloudViews { views, workspace })) => {
                one_cube(&workspace, "clouds.workspace.extent")?;
                let prepared = self.of_views(views.len(), workspace, &params, call, clouds(views)).await;
                prepared.map_err(|refusal| inside("clouds", refusal))?
            }
        };
        PendingReply::score(call, prepared, params, &candidates)?.response(call).await
    }

    /// Finds the table in a view.
    async fn table(&self, request: pb::FindTableRequest, call: &mut Call) -> Result<pb::FindTableResponse, Refusal> {
        let pb::FindTableRequest { observation, workspace, table_height, .. } = request;
        let observation = observation.ok_or_else(|| FieldError::new("view", "absent", "must be given, or cloud"))?;
        let height = table_height.unwrap_or(TABLE_HEIGHT);
        if !(0.0..=WORKSPACE_SIZE).contains(&height) {
            let needed = format_args!("must be from 0 to {WORKSPACE_SIZE} m");
            return Err(FieldError::new("table_height", height, needed).into());
        }
        let workspace = pb::Workspace { find_table: true, ..workspace.unwrap_or_default() };
        let mut workspace = Workspace::try_from(workspace)?;
        let frame_id = std::mem::take(&mut workspace.frame_id);
        let origin = FrameStamp::checked("workspace.frame_id", frame_id, workspace.stamp)?;
        // The retry hint of a refusal is that of the default model.
        let engine = self.models.select("", "", None)?;
        let (turn, _) = self.conversions.of_request(&engine, call.ticket(Priority::Normal)).await?;
        let edge = workspace.size.unwrap_or(WORKSPACE_SIZE);
        let find = move |_: &dyn Fn() -> bool| {
            let found = match observation {
                Seen::View(mut view) => {
                    workspace.find_table_in(&mut view, true, height, edge).map_err(|error| error.inside("view"))
                }
                Seen::Cloud(cloud) => {
                    workspace.find_table_in_cloud(&cloud, height, edge).map_err(|error| error.inside("cloud"))
                }
            };
            Ok(Some(found?))
        };
        let table = blocking(turn, call.deadline, find).await?;
        let FrameStamp { frame_id, stamp } = origin;
        Ok(pb::FindTableResponse { request_id: call.id.clone(), frame_id, stamp, table })
    }

    /// The status that ends a stream. The refusal is logged and counted.
    pub(super) fn refuse(&self, refusal: Refusal, context: CallContext) -> Status {
        let (call, _) = self.calls.open(String::new(), context);
        let id = call.id.clone();
        call.end(refusal).status(&id)
    }
}

/// Converts depth images for a workspace.
fn depth(mut views: Vec<pb::DepthView>) -> impl FnOnce(&mut Workspace, f64, f64) -> Result<Placed, FieldError> {
    move |workspace, table, edge| Observation::of_depth(&mut views, workspace, table, edge)
}

/// Converts point clouds for a workspace.
fn clouds(views: Vec<pb::CloudView>) -> impl FnOnce(&mut Workspace, f64, f64) -> Result<Placed, FieldError> {
    move |workspace, table, edge| Observation::of_clouds(&views, workspace, table, edge)
}

/// The refusal of a field of `message`, with the path from the request. Options are not in it.
fn inside(message: &str, refusal: Refusal) -> Refusal {
    match refusal {
        Refusal::Field(error) if !error.field.starts_with("options") => Refusal::Field(error.inside(message)),
        refusal => refusal,
    }
}

/// Runs `work` on a thread for blocking tasks, to keep the async runtime's threads free. It is passed a function that
/// returns whether its result is still wanted: the call was not cancelled, and the deadline has not passed.
pub(super) async fn blocking<T: Send + 'static>(
    permits: impl Send + 'static,
    deadline: Option<Deadline>,
    work: impl FnOnce(&dyn Fn() -> bool) -> Result<T, Refusal> + Send + 'static,
) -> Result<T, Refusal> {
    // Dropped with this future, if the call is cancelled.
    let call = Arc::new(());
    let weak = Arc::downgrade(&call);
    // Holds the permits until the work is done, even if the call is cancelled before.
    let work = move || {
        let _permits = permits;
        work(&|| weak.strong_count() > 0 && !deadline.is_some_and(Deadline::has_passed))
    };
    let done = tokio::task::spawn_blocking(work).await;
    drop(call);
    done.unwrap_or_else(|panic| Err(EngineError::Panic(panic.to_string()).into()))
}

#[tonic::async_trait]
impl GraspService for GraspRpc {
    async fn detect_grasps(
        &self,
        request: Request<pb::DetectGraspsRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::of(&request);
        let mut request = request.into_inner();
        let recording = self.recorder.request(|| Recorded::Volume(request.clone()));
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, context, recording, async |call| self.submit(request, call).await).await.respond().await
    }

    async fn detect_grasps_from_depth(
        &self,
        request: Request<pb::DetectGraspsFromDepthRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::of(&request);
        let mut request = request.into_inner();
        let recording = self.recorder.request(|| Recorded::Depth(request.clone()));
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, context, recording, async |call| self.submit_depth(request, call).await).await.respond().await
    }

    async fn detect_grasps_from_cloud(
        &self,
        request: Request<pb::DetectGraspsFromCloudRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::of(&request);
        let mut request = request.into_inner();
        let recording = self.recorder.request(|| Recorded::Cloud(request.clone()));
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, context, recording, async |call| self.submit_cloud(request, call).await).await.respond().await
    }

    async fn score_grasps(
        &self,
        request: Request<pb::ScoreGraspsRequest>,
    ) -> Result<Response<pb::ScoreGraspsResponse>, Status> {
        let context = CallContext::of(&request);
        let mut request = request.into_inner();
        let recording = self.recorder.request(|| Recorded::Score(request.clone()));
        let (mut call, checked) = self.calls.open(std::mem::take(&mut request.request_id), context);
        let outcome = match checked {
            Ok(()) => self.scores(request, &mut call).await,
            Err(refusal) => Err(refusal),
        };
        let id = call.id.clone();
        let outcome = outcome.map_err(|refusal| call.end(refusal));
        recording.answered(&outcome, |response| Answer::Scores(response.clone()));
        outcome.map(Response::new).map_err(|refusal| refusal.status(&id))
    }

    async fn find_table(
        &self,
        request: Request<pb::FindTableRequest>,
    ) -> Result<Response<pb::FindTableResponse>, Status> {
        let context = CallContext::of(&request);
        let request = request.into_inner();
        let (mut call, checked) = self.calls.open(request.request_id.clone(), context);
        let found = match checked {
            Ok(()) => self.table(request, &mut call).await,
            Err(refusal) => Err(refusal),
        };
        let id = call.id.clone();
        call.finish_without_model(found).map(Response::new).map_err(|refusal| refusal.status(&id))
    }

    type DetectGraspsStreamStream = BoxStream<pb::DetectGraspsStreamResponse>;

    async fn detect_grasps_stream(
        &self,
        request: Request<Streaming<pb::DetectGraspsRequest>>,
    ) -> Result<Response<Self::DetectGraspsStreamStream>, Status> {
        self.answer_each(request)
    }

    type TrackGraspsStream = BoxStream<pb::DetectGraspsStreamResponse>;

    async fn track_grasps(
        &self,
        request: Request<Streaming<pb::TrackGraspsRequest>>,
    ) -> Result<Response<Self::TrackGraspsStream>, Status> {
        self.track(request)
    }

    async fn list_models(&self, _: Request<pb::ListModelsRequest>) -> Result<Response<pb::ListModelsResponse>, Status> {
        self.calls.check_started().map_err(|refusal| refusal.status(""))?;
        Ok(Response::new((&*self.models).into()))
    }
}
