use std::num::NonZero;
use std::sync::Arc;
use std::thread;
use std::time::Instant;

use grasp::{View, Volume};
use grasp_proto::pb::detect_grasps_stream_response::Outcome;
use grasp_proto::pb::grasp_service_server::GraspService;
use grasp_proto::{DetectParams, FieldError, Workspace, check_count, cloud_view, depth_view, pb, resolution};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::timeout_at;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

use crate::readiness::draining;
use crate::rpc::call::{Call, CallContext, Calls, FrameStamp, PendingReply};
use crate::rpc::refusal::Refusal;
use crate::serving::engine::{Engine, EngineError};
use crate::serving::registry::{ModelRegistry, check_voxel_size};
use crate::serving::scene::{FusionGrid, eyes, rendered, size};
use crate::serving::tracking::{Track, TrackedVolumes};
use crate::transport::deadline::Deadline;
use grasp_planner::Scene;

/// Requests of one stream that wait behind the one being answered: enough that no session waits for the next volume,
/// and few enough that a stream alone never fills a queue.
const READ_AHEAD: usize = 1;

/// Bytes of a volume that are converted where they arrive, in tens of microseconds: handing them to another thread would
/// take as long.
const AT_ONCE: usize = 1 << 20;

/// grasp.v1.GraspService.
#[derive(Clone)]
pub(crate) struct GraspRpc {
    models: Arc<ModelRegistry>,
    calls: Calls,
    tracked_volumes: Arc<TrackedVolumes>,
    /// As many requests as there are processors convert and fuse at a time...
    fusion_permits: Arc<Semaphore>,
    /// ... and as many more as a model's queue takes wait for that: a crowd of them would fill the memory.
    conversion_permits: Arc<Semaphore>,
}

/// A request that was taken, or refused without anyone having been told yet.
struct PendingCall {
    call: Call,
    work: Result<PendingReply, Refusal>,
}

impl PendingCall {
    async fn finish(self) -> Result<pb::DetectGraspsResponse, Refusal> {
        self.call.finish(self.work).await
    }

    async fn respond(self) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let id = self.call.id.clone();
        self.finish().await.map(Response::new).map_err(|refusal| refusal.status(&id))
    }
}

impl GraspRpc {
    /// `queue` requests may wait to be converted and fused.
    pub fn new(models: Arc<ModelRegistry>, calls: Calls, tracked_volumes: TrackedVolumes, queue: usize) -> Self {
        let processors = thread::available_parallelism().map_or(1, NonZero::get);
        let semaphore = |places: usize| Arc::new(Semaphore::new(places.min(Semaphore::MAX_PERMITS)));
        let (fusion_permits, conversion_permits) = (semaphore(processors), semaphore(processors.saturating_add(queue)));
        Self { models, calls, tracked_volumes: Arc::new(tracked_volumes), fusion_permits, conversion_permits }
    }

    /// Opens a call and submits what it asks for. What is wrong with it comes out of [`PendingCall::finish`], like the answer.
    async fn begin(
        &self,
        request_id: String,
        caller: CallContext,
        submit: impl AsyncFnOnce(&mut Call) -> Result<PendingReply, Refusal>,
    ) -> PendingCall {
        let (mut call, checked) = self.calls.open(request_id, caller);
        let work = match checked {
            Ok(()) => submit(&mut call).await,
            Err(refusal) => Err(refusal),
        };
        PendingCall { call, work }
    }

    async fn submit(&self, request: pb::DetectGraspsRequest, call: &mut Call) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsRequest { volume, options, .. } = request;
        let mut volume = volume.ok_or_else(|| FieldError::new("volume", "absent", "must be given"))?;
        let origin = FrameStamp::checked("volume.frame_id", std::mem::take(&mut volume.frame_id), volume.stamp)?;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        // The model before the data: nothing is converted that no model takes.
        let engine = self.models.select(&params.model, &params.version, Some(resolution(&volume)?))?;
        call.by(&engine);
        let checked = if volume.data.len() <= AT_ONCE {
            Volume::try_from(&volume)?
        } else {
            let held = (self.conversion_permit(&engine)?, self.fusion_permit(call).await?);
            engine.check_place()?;
            blocking(held, move || Ok(Volume::try_from(&volume)?)).await?
        };
        check_voxel_size(&checked, &engine)?;
        call.submit(&engine, Scene { volume: checked, points: None }, params, origin, None)
    }

    async fn submit_depth(
        &self,
        request: pb::DetectGraspsFromDepthRequest,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsFromDepthRequest { views, workspace, options, .. } = request;
        let count = views.len();
        let seen = move |workspace: &Workspace, _: f64| -> Result<Vec<View>, FieldError> {
            let views = views.iter().enumerate();
            views.map(|(index, view)| depth_view(view, index, &workspace.frame_from_task)).collect()
        };
        self.submit_views(count, workspace, options, call, seen).await
    }

    async fn submit_cloud(
        &self,
        request: pb::DetectGraspsFromCloudRequest,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::DetectGraspsFromCloudRequest { views, workspace, options, .. } = request;
        let count = views.len();
        let seen = move |workspace: &Workspace, size: f64| -> Result<Vec<View>, FieldError> {
            let views = views.iter().enumerate();
            let clouds = views.map(|(index, view)| cloud_view(view, index, &workspace.frame_from_task));
            rendered(&clouds.collect::<Result<Vec<_>, _>>()?, size)
        };
        self.submit_views(count, workspace, options, call, seen).await
    }

    /// Fuses so many views, which are `seen` in a workspace and a cube of that size, and queues what they show.
    async fn submit_views(
        &self,
        count: usize,
        workspace: Option<pb::Workspace>,
        options: Option<pb::Options>,
        call: &mut Call,
        seen: impl FnOnce(&Workspace, f64) -> Result<Vec<View>, FieldError> + Send + 'static,
    ) -> Result<PendingReply, Refusal> {
        check_count(count)?;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let mut workspace = Workspace::try_from(workspace.unwrap_or_default())?;
        let origin =
            FrameStamp::checked("workspace.frame_id", std::mem::take(&mut workspace.frame_id), workspace.stamp)?;
        let engine = self.models.select(&params.model, &params.version, None)?;
        call.by(&engine);
        let held = (self.conversion_permit(&engine)?, self.fusion_permit(call).await?);
        engine.check_place()?;
        let from = Arc::clone(&engine);
        let fused = blocking(held, move || {
            let views = seen(&workspace, size(&from.source, &workspace))?;
            fuse(&from, params, &workspace, &views)
        });
        let (scene, params, fusion) = fused.await?;
        call.submit(&engine, scene, params, origin, Some(fusion))
    }

    /// Ends a stream, and counts and tells that.
    fn refuse(&self, refusal: Refusal, caller: CallContext) -> Status {
        let (call, _) = self.calls.open(String::new(), caller);
        let id = call.id.clone();
        call.end(refusal).status(&id)
    }

    /// A turn to convert and fuse, or a refusal at once: where too many wait already, or the planner has no place.
    fn conversion_permit(&self, engine: &Engine) -> Result<OwnedSemaphorePermit, Refusal> {
        engine.check_place()?;
        let conversion_permit = Arc::clone(&self.conversion_permits).try_acquire_owned();
        Ok(conversion_permit
            .map_err(|_| engine.overloaded("too many requests wait to be converted and fused".to_owned()))?)
    }

    /// Waits for a place to do it, but no longer than anybody waits for the reply.
    async fn fusion_permit(&self, call: &Call) -> Result<OwnedSemaphorePermit, Refusal> {
        let place = Arc::clone(&self.fusion_permits).acquire_owned();
        let place = match call.deadline {
            None => place.await,
            Some(Deadline(deadline)) => timeout_at(deadline.into(), place).await.map_err(|_| EngineError::Expired)?,
        };
        // Nobody closes it.
        place.map_err(|_| EngineError::Gone.into())
    }

    /// Integrates what came into the volume that is kept, and queues that.
    async fn submit_track(
        &self,
        request: pb::TrackGraspsRequest,
        track: &mut Option<Track>,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::TrackGraspsRequest { views, workspace, options, .. } = request;
        let before = track.as_ref().map(|track| track.params.clone());
        let params = match (options, before) {
            (None, Some(before)) => before,
            (options, _) => DetectParams::try_from(&options.unwrap_or_default())?,
        };
        let engine = self.models.select(&params.model, &params.version, None)?;
        call.by(&engine);
        // Without a turn: there are no more of these than volumes that are kept.
        let place = self.fusion_permit(call).await?;
        let (from, old) = (Arc::clone(&engine), track.take());
        // It comes back in any case: what is wrong with a view does not cost the volume.
        let (kept, fused) =
            blocking(place, move || Ok(Track::integrate(old, &from, params, workspace, &views))).await?;
        *track = kept;
        let (scene, params, origin, fusion) = fused?;
        call.submit(&engine, scene, params, origin, Some(fusion))
    }
}

/// Views into a volume, and how long that took.
fn fuse(
    engine: &Engine,
    mut params: DetectParams,
    workspace: &Workspace,
    views: &[View],
) -> Result<(Scene, DetectParams, std::time::Duration), Refusal> {
    let started = Instant::now();
    let grid = FusionGrid::of(&engine.source, workspace, &eyes(views))?;
    let mut fusion = grid.fusion();
    let sights = grid.integrate(&mut fusion, views)?;
    params.constraints = grid.within(params.constraints);
    Ok((grid.scene(&fusion, Some(sights))?, params, started.elapsed()))
}

/// On a thread that may take its time; those that move messages must not.
async fn blocking<T: Send + 'static>(
    place: impl Send + 'static,
    work: impl FnOnce() -> Result<T, Refusal> + Send + 'static,
) -> Result<T, Refusal> {
    // The place is given back when the work is done, whether or not anybody still waits for it.
    let work = move || {
        let _place = place;
        work()
    };
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|panic| Err(EngineError::Panic(panic.to_string()).into()))
}

#[tonic::async_trait]
impl GraspService for GraspRpc {
    async fn detect_grasps(
        &self,
        request: Request<pb::DetectGraspsRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let caller = CallContext::of(&request);
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, caller, async |call| self.submit(request, call).await).await.respond().await
    }

    async fn detect_grasps_from_depth(
        &self,
        request: Request<pb::DetectGraspsFromDepthRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let caller = CallContext::of(&request);
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, caller, async |call| self.submit_depth(request, call).await).await.respond().await
    }

    async fn detect_grasps_from_cloud(
        &self,
        request: Request<pb::DetectGraspsFromCloudRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let caller = CallContext::of(&request);
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.request_id);
        self.begin(id, caller, async |call| self.submit_cloud(request, call).await).await.respond().await
    }

    type DetectGraspsStreamStream = BoxStream<pb::DetectGraspsStreamResponse>;

    async fn detect_grasps_stream(
        &self,
        request: Request<Streaming<pb::DetectGraspsRequest>>,
    ) -> Result<Response<Self::DetectGraspsStreamStream>, Status> {
        // The stream's, hence that of every request in it.
        let caller = CallContext::of(&request);
        let mut requests = request.into_inner();
        let service = self.clone();
        let (pending, calls) = mpsc::channel(READ_AHEAD);
        tokio::spawn(async move {
            // A place first, then the next message: what is read is in flight, the rest waits with the client.
            while let Ok(place) = pending.reserve().await {
                let message = tokio::select! {
                    message = requests.message() => message,
                    () = draining(service.calls.state()) => return place.send(Err(service.refuse(Refusal::Draining, caller))),
                };
                match message {
                    Ok(Some(mut request)) => {
                        let id = std::mem::take(&mut request.request_id);
                        let submit = async |call: &mut Call| service.submit(request, call).await;
                        place.send(Ok(service.begin(id, caller.clone(), submit).await));
                    }
                    Ok(None) => return,
                    // Too large, or no message at all: HTTP/2's framing is lost, so the stream ends with this status.
                    Err(status) => return place.send(Err(service.calls.unreadable(status))),
                }
            }
        });
        let replies = ReceiverStream::new(calls).then(async |pending: Result<PendingCall, Status>| {
            let pending = pending?;
            let id = pending.call.id.clone();
            Ok(response(id, pending.finish().await))
        });
        Ok(Response::new(Box::pin(replies)))
    }

    type TrackGraspsStream = BoxStream<pb::DetectGraspsStreamResponse>;

    async fn track_grasps(
        &self,
        request: Request<Streaming<pb::TrackGraspsRequest>>,
    ) -> Result<Response<Self::TrackGraspsStream>, Status> {
        let caller = CallContext::of(&request);
        let mut requests = request.into_inner();
        let service = self.clone();
        let place = self.tracked_volumes.place().map_err(|refusal| self.refuse(refusal, caller.clone()))?;
        let (replies, sent) = mpsc::channel(2);
        // Half of it is for what ends the stream, which must not wait for who reads nothing.
        let Ok(end) = replies.clone().try_reserve_owned() else {
            return Err(Status::internal("a channel is full from the beginning"));
        };
        tokio::spawn(async move {
            // Given back when the stream ends, with the volume.
            let _place = place;
            let mut track = None;
            let ended = loop {
                let next = async {
                    // A place for the reply first: what is not read holds up what comes after it.
                    let reply = replies.reserve().await.ok()?;
                    Some((reply, requests.message().await))
                };
                let (reply, message) = tokio::select! {
                    next = next => match next {
                        Some(next) => next,
                        None => return,
                    },
                    () = draining(service.calls.state()) => break service.refuse(Refusal::Draining, caller),
                    refusal = service.tracked_volumes.expired() => break service.refuse(refusal, caller),
                };
                let mut request = match message {
                    Ok(Some(request)) => request,
                    Ok(None) => return,
                    Err(status) => break service.calls.unreadable(status),
                };
                let id = std::mem::take(&mut request.request_id);
                let answer = async {
                    let submit = async |call: &mut Call| service.submit_track(request, &mut track, call).await;
                    let pending = service.begin(id, caller.clone(), submit).await;
                    let id = pending.call.id.clone();
                    response(id, pending.finish().await)
                };
                tokio::select! {
                    // What was read is opened first, and counted.
                    biased;
                    answer = answer => reply.send(Ok(answer)),
                    // Who has gone wants none; the call counts as cancelled.
                    () = replies.closed() => return,
                }
            };
            end.send(Err(ended));
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(sent))))
    }

    async fn list_models(&self, _: Request<pb::ListModelsRequest>) -> Result<Response<pb::ListModelsResponse>, Status> {
        Ok(Response::new((&*self.models).into()))
    }
}

/// An answer of a stream, which goes on after a refusal.
fn response(request_id: String, outcome: Result<pb::DetectGraspsResponse, Refusal>) -> pb::DetectGraspsStreamResponse {
    let outcome = match outcome {
        Ok(response) => Outcome::Response(response),
        Err(refusal) => Outcome::Error(refusal.into()),
    };
    pb::DetectGraspsStreamResponse { request_id, outcome: Some(outcome) }
}
