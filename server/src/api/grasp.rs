//! `grasp.v1.GraspService`.

mod replies;
mod streams;

use std::sync::Arc;
use std::time::Duration;

use ::grasp::{DetectParams, Priority, RequestError, TABLE_HEIGHT, Volume, WORKSPACE_SIZE};
use grasp_engine::{FairSemaphore, Model, ModelRegistry};
use grasp_perception::{FoundTable, Frames, Scene, Scenes, Workspace, check_margin, perceive};
use grasp_proto::pb::find_table_request::Observation as Seen;
use grasp_proto::pb::grasp_service_server::GraspService;
use grasp_proto::pb::recording::{Answer as Recorded, Request as Recording};
use grasp_proto::{FrameStamp, candidates, check_views, cloud, clouds, frame, frames, pb, resolution};
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

use crate::api::blocking::blocking;
use crate::api::call::{Call, CallContext, Calls};
use crate::open_streams::OpenStreams;
use crate::telemetry::recent::Outcome;
use crate::telemetry::recorder::{self, Recorder};
use crate::tracked_volumes::TrackedVolumes;
use replies::SceneRequest;

pub(crate) use replies::outputs;

/// Largest volume that is converted on the async runtime's thread, bytes. The conversion takes tens of microseconds, as
/// long as passing it to another thread.
const INLINE_BYTES: usize = 1 << 20;

/// `grasp.v1.GraspService`.
#[derive(Clone)]
pub(crate) struct GraspApi {
    pub models: Arc<ModelRegistry>,
    pub calls: Calls,
    pub tracked_volumes: Arc<TrackedVolumes>,
    pub recorder: Recorder,
    pub streams: OpenStreams,
    /// Time in which a client must read a reply of a stream.
    pub stall: Duration,
    /// Requests of one stream that are in progress at the same time.
    pub read_ahead: usize,
    /// Permits of the requests that are converted and fused.
    pub conversions: FairSemaphore,
}

/// The views of a request, before they are decoded.
enum Views {
    Depth(Vec<pb::DepthView>),
    Clouds(Vec<pb::CloudView>),
}

impl Views {
    fn decode(&self) -> Result<Frames, RequestError> {
        Ok(match self {
            Self::Depth(views) => Frames::Depth(frames(views)?),
            Self::Clouds(views) => Frames::Clouds(clouds(views)?),
        })
    }

    /// Checks that there are views, but not too many.
    fn check(&self) -> Result<(), RequestError> {
        check_views(match self {
            Self::Depth(views) => views.len(),
            Self::Clouds(views) => views.len(),
        })
    }
}

impl GraspApi {
    async fn detect(
        &self,
        request: pb::DetectGraspsRequest,
        call: &mut Call,
    ) -> Result<(pb::DetectGraspsResponse, Option<Outcome>), RequestError> {
        let pb::DetectGraspsRequest { volume, options, .. } = request;
        let volume = volume.ok_or_else(|| RequestError::invalid("volume", "absent", "must be given"))?;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let model = self.models.select(&params.model, &params.version, Some(resolution(&volume)?))?;
        self.of_volume(volume, model, params, call).await?.detect(call).await
    }

    async fn detect_in_views(
        &self,
        views: Views,
        workspace: Option<pb::Workspace>,
        options: Option<pb::Options>,
        call: &mut Call,
    ) -> Result<(pb::DetectGraspsResponse, Option<Outcome>), RequestError> {
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let model = self.models.select(&params.model, &params.version, None)?;

        self.of_views(views, workspace, true, model, params, call).await?.detect(call).await
    }

    /// Converts a volume for a model, which accepts its resolution.
    async fn of_volume(
        &self,
        mut volume: pb::Volume,
        model: Arc<Model>,
        params: DetectParams,
        call: &mut Call,
    ) -> Result<SceneRequest, RequestError> {
        let origin = FrameStamp::checked("volume.frame_id", std::mem::take(&mut volume.frame_id), volume.stamp)?;
        params.check_without_views()?;
        call.set_model(&model);
        let request = call.metadata(params.priority);
        model.check_capacity(1, request)?;
        let (volume, waited) = if volume.data.len() <= INLINE_BYTES {
            (Volume::try_from(&volume)?, Duration::ZERO)
        } else {
            let (permit, waited) = self.conversions.acquire(&model, request).await?;
            model.check_capacity(1, request)?;
            (blocking(permit, call.deadline, move |_| Volume::try_from(&volume)).await?, waited)
        };
        model.check_voxel_size(&volume)?;
        check_margin(params.margin, volume.resolution() as f64 * volume.voxel_size())?;
        let region = (params.margin > 0.0).then(|| volume.within(params.margin));
        let scenes = Scenes { scenes: vec![Scene { region, ..volume.into() }], ..Scenes::default() };
        Ok(SceneRequest { model, params: params.into(), scenes, origin, waited })
    }

    /// Decodes views, and fuses them for a model. If the table is to be found, `find_objects` says whether to find the
    /// objects on it, too.
    async fn of_views(
        &self,
        views: Views,
        workspace: Option<pb::Workspace>,
        find_objects: bool,
        model: Arc<Model>,
        params: DetectParams,
        call: &mut Call,
    ) -> Result<SceneRequest, RequestError> {
        views.check()?;
        let (workspace, origin) = workspace_of(workspace)?;
        let find_objects = find_objects.then(|| model.capacity().max(1));
        let (workspace, params) = (Workspace { find_objects, ..workspace }, params.with_views());
        call.set_model(&model);
        let request = call.metadata(params.priority);
        model.check_capacity(1, request)?;
        let (permit, waited) = self.conversions.acquire(&model, request).await?;
        model.check_capacity(1, request)?;
        let (reader, params) = (Arc::clone(&model), Arc::new(params));
        let asked = Arc::clone(&params);
        let scenes = blocking(permit, call.deadline, move |is_wanted| {
            perceive(views.decode()?, workspace, &reader.input, &asked, is_wanted)
        });
        Ok(SceneRequest { scenes: scenes.await?, model, params, origin, waited })
    }

    /// Scores the candidates of a request.
    async fn score(
        &self,
        request: pb::ScoreGraspsRequest,
        call: &mut Call,
    ) -> Result<(pb::ScoreGraspsResponse, Option<Outcome>), RequestError> {
        use pb::score_grasps_request::Scene as Message;
        let pb::ScoreGraspsRequest { candidates: messages, scene, options, .. } = request;
        let params = DetectParams::try_from(&options.unwrap_or_default())?;
        let candidates = candidates(&messages, &params)?;
        let resolution = match &scene {
            Some(Message::Volume(volume)) => Some(resolution(volume)?),
            _ => None,
        };
        let model = self.models.select(&params.model, &params.version, resolution)?;
        if model.spec.network().is_none() {
            let value = format_args!("`{}`", model.spec.name());
            return Err(RequestError::invalid("options.model", value, "which has no network and cannot score"));
        }
        let in_views = async |views: Views, workspace: Option<pb::Workspace>, message: &str, call: &mut Call| {
            if workspace.as_ref().is_some_and(|workspace| workspace.extent.is_some()) {
                let field = format!("{message}.workspace.extent");
                return Err(RequestError::invalid(field, "given", "must be absent"));
            }
            let scene_request = self.of_views(views, workspace, false, Arc::clone(&model), params.clone(), call).await;
            scene_request
                .map_err(|error| if error.field().starts_with("options") { error } else { error.inside(message) })
        };
        let scene_request = match scene {
            None => {
                let needed = "volume, depth or clouds must be given";
                return Err(RequestError::invalid("scene", "absent", needed));
            }
            Some(Message::Volume(volume)) => self.of_volume(volume, Arc::clone(&model), params.clone(), call).await?,
            Some(Message::Depth(pb::DepthViews { views, workspace })) => {
                in_views(Views::Depth(views), workspace, "depth", call).await?
            }
            Some(Message::Clouds(pb::CloudViews { views, workspace })) => {
                in_views(Views::Clouds(views), workspace, "clouds", call).await?
            }
        };
        scene_request.score(candidates, call).await
    }

    /// Finds the table in a view.
    async fn table(
        &self,
        request: pb::FindTableRequest,
        call: &mut Call,
    ) -> Result<(pb::FindTableResponse, Option<Outcome>), RequestError> {
        let pb::FindTableRequest { observation, workspace, table_height, .. } = request;
        let observation =
            observation.ok_or_else(|| RequestError::invalid("view", "absent", "must be given, or cloud"))?;
        let height = table_height.unwrap_or(TABLE_HEIGHT);
        if !(0.0..=WORKSPACE_SIZE).contains(&height) {
            let needed = format_args!("must be from 0 to {WORKSPACE_SIZE} m");
            return Err(RequestError::invalid("table_height", height, needed));
        }
        let workspace = pb::Workspace { find_table: true, ..workspace.unwrap_or_default() };
        let (mut workspace, FrameStamp { frame_id, stamp }) = workspace_of(Some(workspace))?;
        // The retry hint of a refusal is that of the default model.
        let model = self.models.select("", "", None)?;
        let (permit, _) = self.conversions.acquire(&model, call.metadata(Priority::Normal)).await?;
        let edge = workspace.size.unwrap_or(WORKSPACE_SIZE);
        let find = move |_: &dyn Fn() -> bool| match observation {
            Seen::View(view) => {
                let found =
                    frame(&view).and_then(|mut frame| workspace.find_table_in_frame(&mut frame, true, height, edge));
                found.map_err(|error| error.inside("view"))
            }
            Seen::Cloud(view) => {
                let found = cloud(&view).and_then(|cloud| workspace.find_table_in_cloud(&cloud, height, edge));
                found.map_err(|error| error.inside("cloud"))
            }
        };
        let table: FoundTable = blocking(permit, call.deadline, find).await?;
        let table = Some((&table).into());
        Ok((pb::FindTableResponse { request_id: call.id.clone(), frame_id, stamp, table }, None))
    }
}

/// The checked workspace of a message, and its frame and time stamp.
fn workspace_of(message: Option<pb::Workspace>) -> Result<(Workspace, FrameStamp), RequestError> {
    let mut message = message.unwrap_or_default();
    let frame_id = std::mem::take(&mut message.frame_id);
    let origin = FrameStamp::checked("workspace.frame_id", frame_id, message.stamp)?;
    Ok((Workspace::try_from(message)?, origin))
}

#[tonic::async_trait]
impl GraspService for GraspApi {
    async fn detect_grasps(
        &self,
        request: Request<pb::DetectGraspsRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::new(&request);
        let mut request = request.into_inner();
        let recording = self.recorder.request(|| Recording::Volume(request.clone()), grasps);
        let id = std::mem::take(&mut request.request_id);
        self.calls.run(id, context, recording, async |call| self.detect(request, call).await).await.into_response()
    }

    async fn detect_grasps_from_depth(
        &self,
        request: Request<pb::DetectGraspsFromDepthRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::new(&request);
        let request = request.into_inner();
        let recording = self.recorder.request(|| Recording::Depth(request.clone()), grasps);
        let pb::DetectGraspsFromDepthRequest { request_id, views, workspace, options } = request;
        let work = async |call: &mut Call| self.detect_in_views(Views::Depth(views), workspace, options, call).await;
        self.calls.run(request_id, context, recording, work).await.into_response()
    }

    async fn detect_grasps_from_cloud(
        &self,
        request: Request<pb::DetectGraspsFromCloudRequest>,
    ) -> Result<Response<pb::DetectGraspsResponse>, Status> {
        let context = CallContext::new(&request);
        let request = request.into_inner();
        let recording = self.recorder.request(|| Recording::Cloud(request.clone()), grasps);
        let pb::DetectGraspsFromCloudRequest { request_id, views, workspace, options } = request;
        let work = async |call: &mut Call| self.detect_in_views(Views::Clouds(views), workspace, options, call).await;
        self.calls.run(request_id, context, recording, work).await.into_response()
    }

    async fn score_grasps(
        &self,
        request: Request<pb::ScoreGraspsRequest>,
    ) -> Result<Response<pb::ScoreGraspsResponse>, Status> {
        let context = CallContext::new(&request);
        let mut request = request.into_inner();
        let answer = |response: &pb::ScoreGraspsResponse| Recorded::Scores(response.clone());
        let recording = self.recorder.request(|| Recording::Score(request.clone()), answer);
        let id = std::mem::take(&mut request.request_id);
        self.calls.run(id, context, recording, async |call| self.score(request, call).await).await.into_response()
    }

    async fn find_table(
        &self,
        request: Request<pb::FindTableRequest>,
    ) -> Result<Response<pb::FindTableResponse>, Status> {
        let context = CallContext::new(&request);
        let mut request = request.into_inner();
        let id = std::mem::take(&mut request.request_id);
        let work = async |call: &mut Call| self.table(request, call).await;
        self.calls.run(id, context, recorder::Recording::none(), work).await.into_response()
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
        self.calls.check_started().map_err(|error| crate::api::status::status(&error, ""))?;
        let models = self.models.now().iter().map(|model| description(model)).collect();
        Ok(Response::new(pb::ListModelsResponse { models }))
    }
}

/// The recorded answer of a detection.
fn grasps(response: &pb::DetectGraspsResponse) -> Recorded {
    Recorded::Grasps(response.clone())
}

fn description(model: &Model) -> pb::Model {
    let spec = &model.spec;
    let network = spec.network().map(|entry| &entry.metadata);
    pb::Model {
        name: spec.name().to_owned(),
        version: spec.version().to_owned(),
        // Fits: the warm-up fails for networks larger than `Volume::MAX_RESOLUTION`.
        resolution: network.map_or(0, |metadata| metadata.resolution as u32),
        voxel_size: network.map_or(0.0, |metadata| metadata.voxel_size),
        threshold: spec.decode_params().threshold,
        sha256: spec.sha256().to_owned(),
        provider: model.backend.provider.to_string(),
        precision: model.backend.precision.to_string(),
        provenance: spec.provenance().into_iter().collect(),
        voxel_origin: network.map_or("", |metadata| metadata.voxel_origin.name()).to_owned(),
        camera_azimuth: network.and_then(|metadata| metadata.camera_azimuth),
    }
}
