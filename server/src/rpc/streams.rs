//! The methods of `grasp.v1` with a stream of requests.

use std::sync::Arc;

use grasp_proto::pb;
use grasp_proto::pb::detect_grasps_stream_response::Outcome;
use grasp_proto::pb::recording::Request as Recorded;
use grasp_proto::{DetectParams, FieldError};
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

use crate::readiness::draining;
use crate::rpc::call::{Call, CallContext};
use crate::rpc::grasp_service::{GraspRpc, PendingCall, blocking};
use crate::rpc::pending::{PendingReply, Prepared};
use crate::serving::observation::Observed;
use crate::serving::refusal::Refusal;
use crate::serving::tracking::{Start, Track, TrackPermit};
use crate::telemetry::recorder::Pending;

/// The responses of a stream.
type Responses = Result<Response<BoxStream<pb::DetectGraspsStreamResponse>>, Status>;

impl GraspRpc {
    /// Answers each request of a stream, in their order.
    pub(super) fn answer_each(&self, request: Request<Streaming<pb::DetectGraspsRequest>>) -> Responses {
        // Of the stream, and so of every request in it.
        let context = CallContext::of(&request);
        let mut requests = request.into_inner();
        let service = self.clone();
        let (pending, calls) = mpsc::channel(self.read_ahead);
        tokio::spawn(async move {
            // Reserves a slot before it reads a message, so that flow control keeps further messages at the client.
            while let Ok(slot) = pending.reserve().await {
                let message = tokio::select! {
                    message = requests.message() => message,
                    () = draining(service.calls.state()) => {
                        return slot.send(Err(service.refuse(Refusal::Draining, context)));
                    }
                };
                match message {
                    Ok(Some(mut request)) => {
                        let recording = service.recorder.request(|| Recorded::Volume(request.clone()));
                        let id = std::mem::take(&mut request.request_id);
                        let submit = async |call: &mut Call| service.submit(request, call).await;
                        tokio::select! {
                            // Polls the request first, so that it is opened and counted.
                            biased;
                            call = service.begin(id, context.clone(), recording, submit) => slot.send(Ok(call)),
                            // The client has closed the stream; the call counts as cancelled.
                            () = pending.closed() => return,
                        }
                    }
                    Ok(None) => return,
                    // Too large or malformed: the framing of messages is lost, so the stream ends with this status.
                    Err(status) => return slot.send(Err(service.calls.unreadable(status))),
                }
            }
        });
        let replies = ReceiverStream::new(calls).then(async |pending: Result<PendingCall, Status>| {
            let pending = pending?;
            let id = pending.call.id.clone();
            Ok(response(id, pending.finish().await, false))
        });
        Ok(Response::new(Box::pin(replies)))
    }

    /// Adds the views of each request to the stream's volume, and answers it.
    pub(super) fn track(&self, request: Request<Streaming<pb::TrackGraspsRequest>>) -> Responses {
        let context = CallContext::of(&request);
        let mut requests = request.into_inner();
        let service = self.clone();
        let permit = self.tracked_volumes.acquire().map_err(|refusal| self.refuse(refusal, context.clone()))?;
        let (replies, sent) = mpsc::channel(2);
        // One of the two slots is reserved for the status that ends the stream, in case the client reads no replies.
        let Ok(end) = replies.clone().try_reserve_owned() else {
            return Err(Status::internal("cannot reserve a slot in a new channel"));
        };
        tokio::spawn(async move {
            // Released when the stream ends, with the volumes.
            let mut permit = permit;
            let mut track = None;
            let ended = loop {
                let next = async {
                    // Reserves the reply's slot before it reads a message, so that unread replies stop further reading.
                    let reply = replies.reserve().await.ok()?;
                    Some((reply, requests.message().await))
                };
                let (reply, message) = tokio::select! {
                    next = next => match next {
                        Some(next) => next,
                        None => return,
                    },
                    () = draining(service.calls.state()) => break service.refuse(Refusal::Draining, context),
                    refusal = service.tracked_volumes.expired() => break service.refuse(refusal, context),
                };
                let mut request = match message {
                    Ok(Some(request)) => request,
                    Ok(None) => return,
                    Err(status) => break service.calls.unreadable(status),
                };
                let id = std::mem::take(&mut request.request_id);
                let result = async {
                    let mut views_added = false;
                    let submit = async |call: &mut Call| {
                        service.submit_track(request, &mut track, &mut permit, &mut views_added, call).await
                    };
                    // A request cannot be repeated without those before it.
                    let pending = service.begin(id, context.clone(), Pending::none(), submit).await;
                    let id = pending.call.id.clone();
                    response(id, pending.finish().await, views_added)
                };
                tokio::select! {
                    // Polls the request first, so that it is opened and counted.
                    biased;
                    result = result => reply.send(Ok(result)),
                    // The client has closed the stream; the call counts as cancelled.
                    () = replies.closed() => return,
                }
            };
            end.send(Err(ended));
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(sent))))
    }

    /// Integrates the views of a request into the stream's volume, and queues the scene. A request that is refused later
    /// leaves `views_added` true.
    async fn submit_track(
        &self,
        request: pb::TrackGraspsRequest,
        track: &mut Option<Track>,
        volumes: &mut TrackPermit,
        views_added: &mut bool,
        call: &mut Call,
    ) -> Result<PendingReply, Refusal> {
        let pb::TrackGraspsRequest { mut views, workspace, options, half_life, stamp, .. } = request;
        let before = track.as_ref().map(|track| track.params.clone());
        let params = match (options, before) {
            (None, Some(before)) => before,
            (options, _) => DetectParams::try_from(&options.unwrap_or_default())?,
        };
        let engine = self.models.select(&params.model, &params.version, None)?;
        call.set_model(&engine);
        if let (None, Some(half_life)) = (&workspace, half_life) {
            return Err(FieldError::new("half_life", half_life, "must be absent without a workspace").into());
        }
        let start = workspace.map(|workspace| Start::checked(workspace, half_life)).transpose()?;
        let (turn, waited) = self.conversions.of_request(&engine, call.ticket(params.priority)).await?;
        if let Some(start) = &start {
            // Not fewer: if the request fails, the stream keeps its volumes.
            let needed = start.volumes(&engine, &params)?.max(volumes.count());
            self.tracked_volumes.resize(volumes, needed)?;
        }
        let (selected, old, of_request) = (Arc::clone(&engine), track.take(), params.clone());
        // The volume is returned in any case, so an invalid view does not lose it.
        let (new, fused) = blocking(turn, call.deadline, move |is_wanted| {
            Ok(Track::integrate(old, &selected, of_request, start, &mut views, stamp, is_wanted))
        })
        .await?;
        (*track, *views_added) = (new, fused.is_ok());
        self.tracked_volumes.resize(volumes, track.as_ref().map_or(1, Track::volumes))?;
        let ((scenes, observed), origin) = fused?;
        let observed = Observed { waited, ..observed };
        PendingReply::detect(call, Prepared { engine, scenes, observed, origin }, params)
    }
}

/// One response of a stream. The stream continues after a refusal.
fn response(
    request_id: String,
    outcome: Result<pb::DetectGraspsResponse, Refusal>,
    views_added: bool,
) -> pb::DetectGraspsStreamResponse {
    let outcome = match outcome {
        Ok(response) => Outcome::Response(response),
        Err(refusal) => Outcome::Error(pb::Error { views_added, ..(&refusal).into() }),
    };
    pb::DetectGraspsStreamResponse { request_id, outcome: Some(outcome) }
}
