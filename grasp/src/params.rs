use std::collections::BTreeSet;

use nalgebra::Isometry3;

use crate::{
    Clearance, Constraints, Convention, DecodeParams, FINGER_DEPTH, Hand, Region, RequestError, Retreat, pregrasp,
};

/// Height of the table in training, metres above the volume's bottom.
pub const TABLE_HEIGHT: f64 = 0.05;

/// What a caller asks for.
#[derive(Clone, Debug)]
pub struct DetectParams {
    /// Name of the model; empty for the default.
    pub model: String,
    /// Version of the model; empty for the newest.
    pub version: String,
    /// Smallest quality; `None` means the threshold of the model.
    pub threshold: Option<f32>,
    /// Smallest quality of the single best grasp if no grasp reaches the threshold; `None` disables it.
    pub force: Option<f32>,
    /// Largest number of grasps.
    pub max_grasps: usize,
    /// Largest number of grasps on one object.
    pub max_grasps_per_object: usize,
    /// Labels of the objects to grasp; empty means all surfaces.
    pub objects: BTreeSet<u16>,
    /// Smallest distance of the fingertips from the sides of the cube, metres.
    pub margin: f64,
    /// The place in the queue.
    pub priority: Priority,
    /// Whether to report the dropped grasps.
    pub explain: bool,
    /// Region, approach and height.
    pub constraints: Constraints,
    /// The hand; `None` means the Panda hand.
    pub hand: Option<Hand>,
    /// Mode of the collision check; `None` means the default of the input: to drop grasps if there are views, else no check.
    pub collision: Option<Collision>,
    /// Height of the table above the volume's bottom, metres; `None` without a table.
    pub table: Option<f64>,
    /// Smallest distance between the hand and the obstacles, metres.
    pub clearance: f64,
    /// Whether space behind a surface counts as an obstacle.
    pub hidden: bool,
    /// Frame of the hand in which poses are reported.
    pub convention: Convention,
    /// Distance from the pre-grasp to the grasp, metres.
    pub pregrasp: f64,
    /// Motion of the hand after the grasp.
    pub retreat: Retreat,
}

/// The order in which requests are served.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Priority {
    /// A robot waits for it.
    Normal,
    /// It may wait until no normal request does.
    Batch,
}

/// Mode of the collision check of the open hand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Collision {
    /// No check.
    Off,
    /// Grasps in collision are flagged.
    Flag,
    /// Grasps in collision are dropped.
    Filter,
}

/// A grasp that the caller proposes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// `T_frame_grasp`, with the origin at the finger base and the fingers closing along ±y.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers when the object is held, metres, if it is known.
    pub width: Option<f64>,
}

impl DetectParams {
    /// The decoding parameters of a planner, overridden by the caller's. `workspace` is the part of the volume whose grasps
    /// are wanted, if it is not the whole.
    #[must_use]
    pub fn decode_params(&self, own: DecodeParams, workspace: Option<Region>) -> DecodeParams {
        DecodeParams {
            threshold: self.threshold.unwrap_or(own.threshold),
            force: self.force.or(own.force),
            constraints: Constraints { workspace, ..self.constraints },
            hand: self.hand,
            clearance: (self.collision == Some(Collision::Filter)).then(|| self.clearance()),
            ..own
        }
    }

    /// The parameters for depth images and point clouds, in which the geometry of the scene is known.
    #[must_use]
    pub fn with_views(self) -> Self {
        Self { collision: self.collision.or(Some(Collision::Filter)), ..self }
    }

    /// Whether collisions are checked.
    #[must_use]
    pub fn checks_collisions(&self) -> bool {
        self.collision.is_some_and(|mode| mode != Collision::Off)
    }

    /// Parameters of the collision check.
    #[must_use]
    pub fn clearance(&self) -> Clearance {
        let Self { pregrasp: from, table, clearance: margin, hidden, .. } = *self;
        Clearance { hand: self.hand(), from, table, margin, hidden, ..Clearance::default() }
    }

    /// The hand that executes the grasps.
    #[must_use]
    pub fn hand(&self) -> Hand {
        self.hand.unwrap_or(Hand::PANDA)
    }

    /// Length of the fingers, metres.
    #[must_use]
    pub fn finger_depth(&self) -> f64 {
        self.hand.map_or(FINGER_DEPTH, |hand| hand.depth)
    }

    /// Refuses options that need views, for a request with a volume.
    ///
    /// # Errors
    /// [`RequestError`] names the option.
    pub fn check_without_views(&self) -> Result<(), RequestError> {
        if self.hidden {
            let needed = "needs depth images or point clouds: a volume does not distinguish hidden from free space";
            return Err(RequestError::invalid("options.collision.hidden", true, needed));
        }
        self.check_objects(false, false)
    }

    /// Refuses options about objects if no view has labels. `are_found` tells whether objects were found without labels.
    ///
    /// # Errors
    /// [`RequestError`] names the option.
    pub fn check_objects(&self, is_labelled: bool, are_found: bool) -> Result<(), RequestError> {
        const NEEDED: &str = "needs views with labels";
        if is_labelled {
            return Ok(());
        }
        if let Some(first) = self.objects.first() {
            return Err(RequestError::refused("options.objects", format_args!("object {first} {NEEDED}")));
        }
        if !are_found && self.max_grasps_per_object < usize::MAX {
            return Err(RequestError::invalid("options.max_grasps_per_object", self.max_grasps_per_object, NEEDED));
        }
        Ok(())
    }

    /// The reported poses of a grasp: grasp, pre-grasp and retreat, in the requested convention.
    #[must_use]
    pub fn poses(&self, grasp: &Isometry3<f64>) -> [Isometry3<f64>; 3] {
        let depth = self.finger_depth();
        [*grasp, pregrasp(grasp, self.pregrasp), self.retreat.pose(grasp)]
            .map(|pose| self.convention.pose(&pose, depth))
    }
}
