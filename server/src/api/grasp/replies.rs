//! Responses from the results of the sessions.

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::try_join_all;
use grasp::{Candidate, DetectParams, RequestError};
use grasp_engine::{Detection, Model, Reply, Score, Scores, SessionOutput, StageTimings, Violation};
use grasp_perception::{Scenes, Warning, table_warning};
use grasp_proto::{FrameStamp, pb};
use tokio::task::spawn_blocking;

use crate::api::call::Call;
use crate::telemetry::recent::{Outcome, Shown};

/// A checked request: the scenes for a model.
pub(crate) struct SceneRequest {
    pub model: Arc<Model>,
    pub params: Arc<DetectParams>,
    pub scenes: Scenes,
    pub origin: FrameStamp,
    /// The time that the request waited for its conversion and fusion.
    pub waited: Duration,
}

/// What the response to a request contains besides the results.
struct Context {
    params: Arc<DetectParams>,
    /// Without the scenes.
    seen: Scenes,
    origin: FrameStamp,
    waited: Duration,
    /// Time until the scenes were queued, without the fusion and the wait for it.
    preprocessing: Duration,
}

impl SceneRequest {
    /// Detects grasps in the scenes.
    pub async fn detect(self, call: &mut Call) -> Result<(pb::DetectGraspsResponse, Option<Outcome>), RequestError> {
        let request = call.metadata(self.params.priority);
        let model = Arc::clone(&self.model);
        model.check_cubes(self.scenes.scenes.len())?;
        let (scenes, context) = self.split(call);
        let params = &context.params;
        let replies = model.detect(scenes, params, request, call.span())?;
        let (cubes, stages) = all(replies, call.deadline).await?;
        let threshold = params.decode_params(model.spec.decode_params(), None).threshold;
        let detection = merged(cubes, params, threshold).await?;
        Ok(context.detected(call, &model, detection, stages))
    }

    /// Scores candidates in the scenes.
    pub async fn score(
        self,
        candidates: Vec<Candidate>,
        call: &mut Call,
    ) -> Result<(pb::ScoreGraspsResponse, Option<Outcome>), RequestError> {
        let request = call.metadata(self.params.priority);
        let model = Arc::clone(&self.model);
        let (scenes, context) = self.split(call);
        let replies = model.score(scenes, &candidates.into(), &context.params, request, call.span())?;
        let (scores, stages) = all(replies, call.deadline).await?;
        Ok(context.scored(call, &model, &scores, stages))
    }

    fn split(self, call: &Call) -> (Vec<grasp_perception::Scene>, Context) {
        let Self { params, mut scenes, origin, waited, .. } = self;
        let others = scenes.fusion.unwrap_or_default() + waited;
        let preprocessing = call.elapsed().saturating_sub(others);
        (std::mem::take(&mut scenes.scenes), Context { params, seen: scenes, origin, waited, preprocessing })
    }
}

impl Context {
    /// The warnings of the request, and the one about the table in its volumes. A table that was found determined the
    /// pose of the workspace, so there is no warning about it.
    fn warnings(&self, call: &Call, table: Option<Warning>) -> Vec<pb::GeometryWarning> {
        let table = table.filter(|_| self.seen.table.is_none());
        call.warn(&self.seen.warnings.iter().copied().chain(table).collect::<Vec<_>>())
    }

    fn timings(&self, call: &Call, stages: StageTimings) -> StageTimings {
        let Self { seen, waited, preprocessing, .. } = self;
        StageTimings {
            queue: *waited + stages.queue,
            preprocessing: *preprocessing,
            fusion: seen.fusion,
            total: call.elapsed(),
            ..stages
        }
    }

    fn detected(
        self,
        call: &Call,
        model: &Model,
        detection: Detection,
        stages: StageTimings,
    ) -> (pb::DetectGraspsResponse, Option<Outcome>) {
        let Detection { grasps: found, dropped, over_limit, volumes, table } = detection;
        let warnings = self.warnings(call, table);
        let grasps: Vec<_> = found
            .iter()
            .map(|detected| {
                let [pose, pregrasp, retreat] =
                    self.params.poses(&detected.grasp.pose).map(|pose| Some((&pose).into()));
                pb::Grasp {
                    pose,
                    width: rounded(detected.grasp.width),
                    quality: detected.grasp.quality,
                    pregrasp,
                    retreat,
                    collides: detected.collides,
                    object: detected.object.map(u32::from),
                    open_width: detected.open_width.map(rounded),
                }
            })
            .collect();
        // Fits: there is at most one grasp per voxel.
        let over_limit = over_limit as u32;
        let timings = self.timings(call, stages);
        let Self { params, seen, origin, .. } = self;
        let dropped = (params.explain || grasps.is_empty()).then(|| pb::Dropped { over_limit, ..(&dropped).into() });
        let messages = warnings.iter().map(|warning| warning.message.clone()).collect();
        let shown = Shown::new(timings, volumes, found, params.finger_depth(), messages);
        let response = pb::DetectGraspsResponse {
            request_id: call.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            grasps,
            model: model.spec.name().to_owned(),
            version: model.spec.version().to_owned(),
            latency: Some(latency(&timings)),
            dropped,
            warnings,
            table: seen.table.as_ref().map(Into::into),
            depth_factors: seen.depth_factors,
        };
        (response, Some(Outcome::Detected(Box::new(shown))))
    }

    fn scored(
        self,
        call: &Call,
        model: &Model,
        scores: &[Scores],
        stages: StageTimings,
    ) -> (pb::ScoreGraspsResponse, Option<Outcome>) {
        let warnings = self.warnings(call, table_warning(scores.iter().map(|scores| scores.table)));
        let timings = self.timings(call, stages);
        let Self { seen, origin, .. } = self;
        let response = pb::ScoreGraspsResponse {
            request_id: call.id.clone(),
            frame_id: origin.frame_id,
            stamp: origin.stamp,
            scores: scores.iter().flat_map(|scores| &scores.scores).map(score).collect(),
            model: model.spec.name().to_owned(),
            version: model.spec.version().to_owned(),
            latency: Some(latency(&timings)),
            warnings,
            table: seen.table.as_ref().map(Into::into),
            depth_factors: seen.depth_factors,
        };
        (response, Some(Outcome::Scored(timings)))
    }
}

fn score(score: &Score) -> pb::Score {
    let violation = |violation: &Violation| match violation {
        Violation::Quality => pb::score::Violation::Quality,
        Violation::Width => pb::score::Violation::Width,
        Violation::Region => pb::score::Violation::Region,
        Violation::Approach => pb::score::Violation::Approach,
        Violation::Height => pb::score::Violation::Height,
        Violation::Object => pb::score::Violation::Object,
        Violation::Collision => pb::score::Violation::Collision,
    };
    pb::Score {
        quality: score.quality,
        violations: score.violations.iter().map(|found| violation(found).into()).collect(),
        object: score.object.map(u32::from),
        open_width: score.open_width.map(rounded),
    }
}

/// A width without the digits that are noise of the networks' 32-bit floats.
fn rounded(width: f64) -> f64 {
    (width * 1e8).round() / 1e8
}

fn latency(timings: &StageTimings) -> pb::Latency {
    pb::Latency {
        queue: timings.queue.as_secs_f64(),
        preprocessing: timings.preprocessing.as_secs_f64(),
        fusion: timings.fusion.unwrap_or_default().as_secs_f64(),
        inference: timings.inference.as_secs_f64(),
        evaluation: timings.evaluation.unwrap_or_default().as_secs_f64(),
        postprocessing: timings.postprocessing.as_secs_f64(),
        total: timings.total.as_secs_f64(),
    }
}

/// The grasps of all cubes. Those of several are compared with each other, which may take milliseconds.
async fn merged(
    mut cubes: Vec<Detection>,
    params: &Arc<DetectParams>,
    threshold: f32,
) -> Result<Detection, RequestError> {
    if cubes.len() == 1 {
        return Ok(cubes.pop().unwrap_or_default());
    }
    let params = Arc::clone(params);
    let merged = spawn_blocking(move || Detection::merged(cubes, &params, threshold)).await;
    merged.map_err(|panic| RequestError::new(grasp::Code::Internal, format!("merging the cubes panicked: {panic}")))
}

/// Waits for the results of all cubes. The timings of the sessions are those from the first cube to the last: the cubes
/// are computed in parallel or one after another.
async fn all<T>(replies: Vec<Reply<T>>, deadline: Option<Instant>) -> Result<(Vec<T>, StageTimings), RequestError> {
    let mut values = Vec::with_capacity(replies.len());
    // When the first cube was taken from the queue, and the last one had passed each stage.
    let mut taken = Duration::MAX;
    let (mut inferred, mut evaluated, mut decoded) = (Duration::ZERO, None, Duration::ZERO);
    for output in outputs(replies, deadline).await? {
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

/// Waits for all results of a request. The first error ends the wait, and the other scenes leave the queue.
pub(crate) async fn outputs<T>(
    replies: Vec<Reply<T>>,
    deadline: Option<Instant>,
) -> Result<Vec<SessionOutput<T>>, RequestError> {
    try_join_all(replies.into_iter().map(|reply| reply.wait(deadline))).await
}
