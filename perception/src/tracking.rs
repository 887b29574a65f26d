use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Instant;

use grasp::{DetectParams, RequestError};

use crate::cubes::Cubes;
use crate::{Frames, InputGrid, Scenes, Workspace};

/// The field of a stream of requests, each of which adds views.
#[derive(Debug)]
pub struct Track {
    cubes: Cubes,
    /// The parameters of the latest request.
    pub params: Arc<DetectParams>,
}

/// The start of a new field.
#[derive(Clone, Debug)]
pub struct Start {
    workspace: Workspace,
    /// Half-life of the measurements, views.
    half_life: Option<f64>,
}

/// Shortest and longest half-life, views.
const HALF_LIFE: RangeInclusive<f64> = 0.5..=10_000.0;

impl Start {
    /// Checks the half-life of the measurements, views.
    ///
    /// # Errors
    /// [`RequestError`] if it is out of range.
    pub fn new(workspace: Workspace, half_life: Option<f64>) -> Result<Self, RequestError> {
        match half_life {
            Some(half_life) if !HALF_LIFE.contains(&half_life) => {
                let needed = format_args!("must be from {} to {} views", HALF_LIFE.start(), HALF_LIFE.end());
                Err(RequestError::invalid("half_life", half_life, needed))
            }
            half_life => Ok(Self { workspace, half_life }),
        }
    }

    /// The number of volumes that the field of a planner has.
    ///
    /// # Errors
    /// [`RequestError`] if the planner cannot use the size of the cubes, or there are too many.
    pub fn volumes(&self, input: &InputGrid, params: &DetectParams) -> Result<usize, RequestError> {
        Cubes::count(input, &self.workspace, params.margin)
    }
}

impl Track {
    /// A field with the views of `track` and those of a request, or a new field with only the latter if `start` is
    /// given. All of them are integrated, or none: after an error `track` is as before. Stops when `is_wanted` returns
    /// false.
    ///
    /// # Errors
    /// [`RequestError`] names the invalid field, or says that the result is no longer wanted.
    pub fn add(
        track: Option<&Self>,
        start: Option<Start>,
        frames: Frames,
        input: &InputGrid,
        params: Arc<DetectParams>,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<(Self, Scenes), RequestError> {
        let started = Instant::now();
        let (mut cubes, observation, table) = match (start, track) {
            (Some(Start { workspace, half_life }), _) => {
                let (cubes, observation, table) = Cubes::placed(workspace, frames, input, &params)?;
                (cubes.tracked(half_life), observation, table)
            }
            (None, Some(track)) => {
                track.cubes.check(input)?;
                (track.cubes.clone(), frames.in_task(track.cubes.frame_from_task())?, None)
            }
            (None, None) => {
                let needed = "must be given in the first request of a stream";
                return Err(RequestError::invalid("workspace", "absent", needed));
            }
        };
        let scenes = cubes.fuse(observation, &params, is_wanted)?;
        Ok((Self { cubes, params }, Scenes { table, fusion: Some(started.elapsed()), ..scenes }))
    }

    /// Number of volumes.
    #[must_use]
    pub fn volumes(&self) -> usize {
        self.cubes.len()
    }
}
