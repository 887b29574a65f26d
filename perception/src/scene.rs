use std::time::Duration;

use grasp::{Region, SurfacePoint, Volume};

use crate::{FoundTable, Warning};

/// Input of a planner.
#[derive(Debug)]
pub struct Scene {
    /// The volume: input of networks and of the collision check.
    pub volume: Volume,
    /// The observed surface in the volume's own frame (metres), if it is known at a higher resolution than the
    /// volume's.
    pub points: Option<Vec<SurfacePoint>>,
    /// The part of the volume whose grasps are wanted, if it is not the whole.
    pub region: Option<Region>,
}

/// The scenes of a request, and what was noticed about its geometry.
#[derive(Debug, Default)]
pub struct Scenes {
    /// At least one.
    pub scenes: Vec<Scene>,
    /// Signs that the geometry of the request is wrong.
    pub warnings: Vec<Warning>,
    /// The table that determined the workspace.
    pub table: Option<FoundTable>,
    /// Factors by which the depths of the views were multiplied; empty if they were not to be corrected.
    pub depth_factors: Vec<f64>,
    /// The time that the fusion took; `None` for a volume.
    pub fusion: Option<Duration>,
}

impl From<Volume> for Scene {
    fn from(volume: Volume) -> Self {
        Self { volume, points: None, region: None }
    }
}
