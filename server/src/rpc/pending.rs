//! Queued requests, and their responses from the results of the sessions.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::try_join_all;
use grasp::Warning;
use grasp_proto::{Candidate, DetectParams, pb};

use crate::rpc::call::Call;
use crate::serving::cubes::CubeScene;
use crate::serving::detection::{Detection, Score};
use crate::serving::engine::Engine;
use crate::serving::frame_stamp::FrameStamp;
use crate::serving::job::{EngineError, Reply, SessionOutput, Tensors};
use crate::serving::observation::Observed;
use crate::serving::refusal::Refusal;
use crate::telemetry::recent::{Outcome, Shown};
use crate::telemetry::timings::StageTimings;

/// A checked request: the scenes for a model.
pub(crate) struct Prepared {
    pub engine: Arc<Engine>,
    pub scenes: Vec<CubeScene>,
    pub observed: Observed,
    pub origin: FrameStamp,
}

/// A queued request: the pending results of its cubes, and what the response needs besides them.
pub(crate) struct PendingReply<T = Detection> {
    replies: Vec<Reply<T>>,
    params: DetectParams,
    /// The smallest quality of a grasp.
    threshold: f32,
    /// Time until the scenes were queued, without the fusion and the waiting for it.
    preprocessing: Duration,
    observed: Observed,
    origin: FrameStamp,
}

impl<T> PendingReply<T> {
    /// Checks the table in the scenes and queues them with `push`.
    fn queue(
        call: &Call,
        prepared: Prepared,
        params: DetectParams,
        push: impl FnOnce(&Engine, Vec<CubeScene>) -> Result<Vec<Reply<T>>, EngineError>,
    ) -> Result<Self, Refusal> {
        let Prepared { engine, scenes, mut observed, origin } = prepared;
        observed.warnings.extend(params.table.and_then(|expected| table_warning(&scenes, expected)));
        let others = observed.fusion.unwrap_or_default() + observed.waited;
        let preprocessing = call.elapsed().saturating_sub(others);
        let threshold = params.decode_params(engine.source.decode_params()).threshold;
        Ok(Self { replies: push(&engine, scenes)?, params, threshold, preprocessing, observed, origin })
    }
}

impl PendingReply {
    /// Queues the scenes for grasp detection.
    pub fn detect(call: &Call, prepared: Prepared, params: DetectParams) -> Result<Self, Refusal> {
        prepared.engine.check_cubes(prepared.scenes.len())?;
        let ticket = call.ticket(params.priority);
        Self::queue(call, prepared, params, |engine, scenes| engine.detect(scenes, ticket, call.span()))
    }

    /// Waits for the grasps, and records the success.
    pub async fn response(self, call: &mut Call) -> Result<pb::DetectGraspsResponse, Refusal> {
        let Self { replies, params, threshold, preprocessing, observed, origin } = self;
        let Observed { waited, fusion, warnings, table, depth_factors } = observed;
        let (cubes, stages) = all(replies, call).await?;
        let Detection { grasps: found, dropped, over_limit, volumes } = Detection::merged(cubes, &params, threshold);

        let grasps: Vec<_> = found
            .iter()
            .map(|detected| {
                let [pose, pregrasp, retreat] = params.poses(&detected.grasp.pose).map(|pose| Some((&pose).into()));
                pb::Grasp {
                    pose,
                    width: detected.grasp.width,
                    quality: detected.grasp.quality,
                    pregrasp,
                    retreat,
                    collides: detected.collides,
                    object: detected.object.map(u32::from),
                    open_width: detected.open_width,
                }
            })
            .collect();
        // Fits: there is at most one grasp per voxel.
        let over_limit = over_limit as u32;
        let dropped = (params.explain || grasps.is_empty()).then(|| pb::Dropped { over_limit, ..(&dropped).into() });

        let finger_depth = params.hand.map_or(grasp::FINGER_DEPTH, |hand| hand.depth);
        let warnings = call.warned(&warnings);
        let messages = warnings.iter().map(|warning| warning.message.clone()).collect();
        let queue = waited + stages.queue;
        let timings = StageTimings { queue, preprocessing, fusion, total: call.elapsed(), ..stages };
        let shown = Shown::new(timings, volumes, found, finger_depth, messages);
        call.succeeded(&timings, grasps.len(), Outcome::Detected(Box::new(shown)));
        Ok(pb::DetectGraspsResponse {
            request_id: call.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            grasps,
            model: call.name.clone(),
            version: call.version.clone(),
            latency: Some((&timings).into()),
            dropped,
            warnings,
            table,
            depth_factors,
        })
    }
}

impl PendingReply<Vec<Score>> {
    /// Queues the scenes, whose candidates are to be scored.
    pub fn score(
        call: &Call,
        prepared: Prepared,
        params: DetectParams,
        candidates: &[Candidate],
    ) -> Result<Self, Refusal> {
        let ticket = call.ticket(params.priority);
        Self::queue(call, prepared, params, |engine, scenes| engine.score(scenes, candidates, ticket, call.span()))
    }

    /// Waits for the scores, and records the success.
    pub async fn response(self, call: &mut Call) -> Result<pb::ScoreGraspsResponse, Refusal> {
        let Self { replies, preprocessing, observed, origin, .. } = self;
        let Observed { waited, fusion, warnings, table, depth_factors } = observed;
        let (values, stages) = all(replies, call).await?;
        let warnings = call.warned(&warnings);
        let queue = waited + stages.queue;
        let timings = StageTimings { queue, preprocessing, fusion, total: call.elapsed(), ..stages };
        call.succeeded(&timings, 0, Outcome::Scored(timings));
        Ok(pb::ScoreGraspsResponse {
            request_id: call.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            scores: values.iter().flatten().map(Into::into).collect(),
            model: call.name.clone(),
            version: call.version.clone(),
            latency: Some((&timings).into()),
            warnings,
            table,
            depth_factors,
        })
    }
}

/// Waits for the maps of each volume, and records the success. The timings are those of the slowest volume. `waited` is the
/// time that the request waited for its conversion.
pub(super) async fn maps(
    call: &mut Call,
    replies: Vec<Reply<Tensors>>,
    waited: Duration,
) -> Result<(Vec<Tensors>, StageTimings), Refusal> {
    let preprocessing = call.elapsed().saturating_sub(waited);
    let mut maps = Vec::with_capacity(replies.len());
    let mut timings = StageTimings { preprocessing, ..StageTimings::default() };
    for output in outputs(replies, call).await? {
        let SessionOutput { value, queue, inference, postprocessing, .. } = output;
        maps.push(value);
        if queue + inference >= timings.queue + timings.inference {
            timings = StageTimings { queue, inference, postprocessing, ..timings };
        }
    }
    timings.queue += waited;
    timings.total = call.elapsed();
    call.succeeded(&timings, 0, Outcome::Inferred(timings));
    Ok((maps, timings))
}

/// Waits for the results of all cubes. The timings of the sessions are those from the first cube to the last: the cubes
/// are computed in parallel, and one after another.
async fn all<T>(replies: Vec<Reply<T>>, call: &Call) -> Result<(Vec<T>, StageTimings), EngineError> {
    let mut values = Vec::with_capacity(replies.len());
    // When the first cube was taken from the queue, and the last one had passed each stage.
    let mut taken = Duration::MAX;
    let (mut inferred, mut evaluated, mut decoded) = (Duration::ZERO, None, Duration::ZERO);
    for output in outputs(replies, call).await? {
        let SessionOutput { value, queue, inference, evaluation, postprocessing } = output;
        values.push(value);
        taken = taken.min(queue);
        inferred = inferred.max(queue + inference);
        evaluated = evaluated.max(evaluation.map(|evaluation| queue + inference + evaluation));
        decoded = decoded.max(queue + inference + evaluation.unwrap_or_default() + postprocessing);
    }
    let stages = StageTimings {
        queue: taken,
        inference: inferred.saturating_sub(taken),
        evaluation: evaluated.map(|evaluated| evaluated.saturating_sub(inferred)),
        postprocessing: decoded.saturating_sub(evaluated.unwrap_or(inferred)),
        ..StageTimings::default()
    };
    Ok((values, stages))
}

/// Waits for all results of a request. The first error ends the waiting, and the other scenes leave the queue.
async fn outputs<T>(replies: Vec<Reply<T>>, call: &Call) -> Result<Vec<SessionOutput<T>>, EngineError> {
    try_join_all(replies.into_iter().map(|reply| reply.wait(call.deadline))).await
}

/// The warning about the table, unless it is as expected in one of the cubes.
fn table_warning(scenes: &[CubeScene], expected: f64) -> Option<Warning> {
    let mut warnings = scenes.iter().map(|scene| Warning::of_table(&scene.scene.volume, expected));
    let first = warnings.next()??;
    warnings.all(|warning| warning.is_some()).then_some(first)
}
