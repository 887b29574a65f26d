//! The methods of `grasp.v1` with a stream of requests.

use std::sync::Arc;
use std::time::Duration;

use grasp::{Code, DetectParams, RequestError};
use grasp_perception::{Frames, Start, Track};
use grasp_proto::pb::detect_grasps_stream_response::Outcome as Message;
use grasp_proto::pb::recording::Request as Recorded;
use grasp_proto::{FrameStamp, check_views, frames, pb};
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::AbortOnDropHandle;
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};
use tracing::warn;

use super::replies::SceneRequest;
use super::{GraspApi, grasps, workspace_of};
use crate::api::blocking::blocking;
use crate::api::call::{Answer, Call, CallContext};
use crate::api::status;
use crate::readiness::draining;
use crate::telemetry::recent::Outcome;
use crate::telemetry::recorder::Recording;
use crate::tracked_volumes::TrackPermit;

/// The responses of a stream.
type Responses = Response<BoxStream<pb::DetectGraspsStreamResponse>>;

/// How long the server still reads what the client of an ended stream sends. A client that is sending may take the
/// reset of its stream for a broken connection, and not see the status.
const LINGER: Duration = Duration::from_secs(2);

/// The field of a `TrackGrasps` stream, and its frame and time.
type Tracked = (Arc<Track>, FrameStamp);

impl GraspApi {
    /// Answers the requests of a stream in order.
    pub(super) fn answer_each(
        &self,
        request: Request<Streaming<pb::DetectGraspsRequest>>,
    ) -> Result<Responses, Status> {
        // Of the stream, and so of every request in it.
        let context = CallContext::new(&request);
        let mut requests = request.into_inner();
        let open = match self.streams.open(context.caller()) {
            Ok(open) => open,
            Err(error) => {
                let status = self.calls.refuse(error, context);
                tokio::spawn(linger(requests));
                return Err(status);
            }
        };
        let api = self.clone();
        let (pending, mut answers) = mpsc::channel(self.read_ahead);
        let (replies, sent) = mpsc::channel(1);
        let stall = self.stall;
        tokio::spawn(async move {
            // Reserves a slot before it reads a message, so that flow control keeps further messages at the client.
            while let Ok(slot) = pending.reserve().await {
                let message = tokio::select! {
                    message = requests.message() => message,
                    () = draining(api.calls.state()) => {
                        slot.send(Err(api.calls.refuse(shutting_down(), context)));
                        return linger(requests).await;
                    }
                    // Its client reads no replies.
                    () = pending.closed() => return,
                };
                match message {
                    Ok(Some(request)) => {
                        // A task, because a stream is not polled while its client reads no replies. If the client
                        // closes the stream, the request counts as cancelled.
                        let answer = tokio::spawn(api.clone().answer(request, context.clone()));
                        slot.send(Ok(AbortOnDropHandle::new(answer)));
                    }
                    Ok(None) => return,
                    // Too large or malformed: the framing of messages is lost, so the stream ends with this status.
                    Err(status) => return slot.send(Err(api.calls.unreadable(status))),
                }
            }
        });
        tokio::spawn(async move {
            let _open = open;
            while let Some(answer) = answers.recv().await {
                let answer: Result<AbortOnDropHandle<_>, Status> = answer;
                let reply = match answer {
                    Ok(answer) => tokio::select! {
                        answer = answer => match answer {
                            Ok(answer) => Ok(response(answer, false)),
                            Err(panic) => Err(Status::internal(format!("the request panicked: {panic}"))),
                        },
                        () = replies.closed() => return,
                    },
                    Err(status) => Err(status),
                };
                if timeout(stall, replies.send(reply)).await.is_err() {
                    return warn!(?stall, "stream ended: its client does not read the replies (--stall-timeout)");
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(sent))))
    }

    async fn answer(
        self,
        mut request: pb::DetectGraspsRequest,
        context: CallContext,
    ) -> Answer<pb::DetectGraspsResponse> {
        let recording = self.recorder.request(|| Recorded::Volume(request.clone()), grasps);
        let id = std::mem::take(&mut request.request_id);
        self.calls.run(id, context, recording, async |call| self.detect(request, call).await).await
    }

    /// Adds the views of each request to the stream's volume, and answers it.
    pub(super) fn track(&self, request: Request<Streaming<pb::TrackGraspsRequest>>) -> Result<Responses, Status> {
        let context = CallContext::new(&request);
        let mut requests = request.into_inner();
        let permit = match self.tracked_volumes.acquire() {
            Ok(permit) => permit,
            Err(error) => {
                let status = self.calls.refuse(error, context);
                tokio::spawn(linger(requests));
                return Err(status);
            }
        };
        let api = self.clone();
        let (replies, sent) = mpsc::channel(2);
        tokio::spawn(async move {
            let ended = api.track_all(&mut requests, &replies, permit, context).await;
            if let Some(status) = ended {
                // Waits for a client that reads no replies, for a limited time.
                let _ = timeout(LINGER, replies.send(Err(status))).await;
                drop(replies);
                linger(requests).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(sent))))
    }

    /// Returns the status that ends the stream; None if the client has ended it. `permit` is released when the stream
    /// ends, with the volumes.
    async fn track_all(
        &self,
        requests: &mut Streaming<pb::TrackGraspsRequest>,
        replies: &mpsc::Sender<Result<pb::DetectGraspsStreamResponse, Status>>,
        mut permit: TrackPermit,
        context: CallContext,
    ) -> Option<Status> {
        let mut tracked = None;
        loop {
            let next = async {
                // Reserves the reply's slot before it reads a message, so that unread replies stop further reading.
                let reply = replies.reserve().await.ok()?;
                Some((reply, requests.message().await))
            };
            let (reply, message) = tokio::select! {
                next = next => next?,
                () = draining(self.calls.state()) => return Some(self.calls.refuse(shutting_down(), context)),
                error = self.tracked_volumes.expired() => return Some(self.calls.refuse(error, context)),
            };
            let mut request = match message {
                Ok(request) => request?,
                Err(status) => return Some(self.calls.unreadable(status)),
            };
            let id = std::mem::take(&mut request.request_id);
            let mut views_added = false;
            let work = async |call: &mut Call| {
                self.add_views(request, &mut tracked, &mut permit, &mut views_added, call).await
            };
            // Not recorded: a request cannot be repeated without those before it.
            let answer = self.calls.run(id, context.clone(), Recording::none(), work);
            tokio::select! {
                // Polls the request first, so that it is opened and counted.
                biased;
                answer = answer => reply.send(Ok(response(answer, views_added))),
                // The client has closed the stream; the call counts as cancelled.
                () = replies.closed() => return None,
            }
        }
    }

    /// Adds the views of a request to the stream's volume, and detects grasps in it. A request that is refused after
    /// that leaves `views_added` true.
    async fn add_views(
        &self,
        request: pb::TrackGraspsRequest,
        tracked: &mut Option<Tracked>,
        volumes: &mut TrackPermit,
        views_added: &mut bool,
        call: &mut Call,
    ) -> Result<(pb::DetectGraspsResponse, Option<Outcome>), RequestError> {
        let pb::TrackGraspsRequest { views, workspace, options, half_life, stamp, .. } = request;
        let params = match (options, &*tracked) {
            (None, Some((track, _))) => (*track.params).clone(),
            (options, _) => DetectParams::try_from(&options.unwrap_or_default())?,
        };
        let model = self.models.select(&params.model, &params.version, None)?;
        call.set_model(&model);
        if let (None, Some(half_life)) = (&workspace, half_life) {
            return Err(RequestError::invalid("half_life", half_life, "must be absent without a workspace"));
        }
        let (start, origin) = match workspace {
            None => (None, tracked.as_ref().map(|(_, origin)| origin.clone())),
            Some(workspace) => {
                check_views(views.len())?;
                let (workspace, origin) = workspace_of(Some(workspace))?;
                (Some(Start::new(workspace, half_life)?), Some(origin))
            }
        };
        let (permit, waited) = self.conversions.acquire(&model, call.metadata(params.priority)).await?;
        if let Some(start) = &start {
            // Not fewer: if the request fails, the stream keeps its volumes.
            let needed = start.volumes(&model.input, &params)?.max(volumes.count());
            self.tracked_volumes.resize(volumes, needed)?;
        }
        let before = tracked.as_ref().map(|(track, _)| Arc::clone(track));
        let (reader, params) = (Arc::clone(&model), Arc::new(params.with_views()));
        let asked = Arc::clone(&params);
        let added = blocking(permit, call.deadline, move |is_wanted| {
            let frames = Frames::Depth(frames(&views)?);
            Track::add(before.as_deref(), start, frames, &reader.input, asked, is_wanted)
        });
        let added = added.await;
        if let Ok((track, _)) = &added {
            self.tracked_volumes.resize(volumes, track.volumes())?;
        } else {
            let kept = tracked.as_ref().map_or(1, |(track, _)| track.volumes());
            self.tracked_volumes.resize(volumes, kept)?;
        }
        let (track, scenes) = added?;
        let mut origin = origin.unwrap_or_default();
        origin.stamp = stamp.or(origin.stamp);
        *tracked = Some((Arc::new(track), origin.clone()));
        *views_added = true;
        SceneRequest { model, params, scenes, origin, waited }.detect(call).await
    }
}

/// The error that ends the streams of a server that is shutting down.
fn shutting_down() -> RequestError {
    RequestError::new(Code::Unavailable, "the server is shutting down; retry on another replica")
}

/// Reads and drops what the client of an ended stream still sends, for a limited time.
async fn linger<T>(mut requests: Streaming<T>) {
    let _ = timeout(LINGER, async { while let Ok(Some(_)) = requests.message().await {} }).await;
}

/// One response of a stream. The stream continues after an error.
fn response(answer: Answer<pb::DetectGraspsResponse>, views_added: bool) -> pb::DetectGraspsStreamResponse {
    let Answer { request_id, outcome } = answer;
    let outcome = match outcome {
        Ok(response) => Message::Response(response),
        Err(error) => Message::Error(pb::Error { views_added, ..status::message(&error) }),
    };
    pb::DetectGraspsStreamResponse { request_id, outcome: Some(outcome) }
}
