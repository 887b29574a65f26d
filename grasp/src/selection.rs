use nalgebra::Isometry3;

use crate::{Constraints, DecodeParams, Grasp, Hand, Obstacles, Violation, Volume};

/// How many voxels were dropped, each counted once, under the first reason that applied in this order.
///
/// Together with the grasps they make up every voxel of the volume.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// The smoothed quality is below the threshold.
    pub below_threshold: usize,
    /// Inside an object, or too far from any observed surface.
    pub mask: usize,
    /// The width is not one that is believed.
    pub width: usize,
    /// At the border of the cube.
    pub border: usize,
    /// Outside of the region that was asked for.
    pub region: usize,
    /// From where the hand was not asked to come.
    pub approach: usize,
    /// The hand would be too low.
    pub height: usize,
    /// The open hand would meet what was observed.
    pub collision: usize,
    /// A better grasp is near.
    pub suppressed: usize,
}

/// What [`decode`](crate::decode) or [`select`] found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decoded {
    /// In the volume's frame, best first.
    pub grasps: Vec<Grasp>,
    /// Why the other voxels hold none.
    pub dropped: Dropped,
}

impl Decoded {
    /// The best of them; the others it suppresses.
    pub(crate) fn best_alone(mut self) -> Self {
        self.dropped.suppressed += self.grasps.len().saturating_sub(1);
        self.grasps.truncate(1);
        self
    }
}

/// What is asked of each grasp besides its quality.
pub(crate) struct Selection {
    constraints: Constraints,
    hand: Hand,
    obstacles: Option<Obstacles>,
}

impl Selection {
    pub fn new(volume: &Volume, params: &DecodeParams) -> Self {
        Self {
            constraints: params.constraints,
            hand: params.hand.unwrap_or(Hand::PANDA),
            obstacles: params.clearance.map(|clearance| Obstacles::observed(volume, clearance)),
        }
    }

    /// Whether a grasp is as it was asked for. One that is not is counted.
    pub fn keeps(&self, pose: &Isometry3<f64>, dropped: &mut Dropped) -> bool {
        let count = match self.constraints.violation(pose, &self.hand) {
            Some(Violation::Region) => &mut dropped.region,
            Some(Violation::Approach) => &mut dropped.approach,
            Some(Violation::Height) => &mut dropped.height,
            None if self.obstacles.as_ref().is_some_and(|obstacles| obstacles.meet(pose)) => &mut dropped.collision,
            None => return true,
        };
        *count += 1;
        false
    }
}

/// Of grasps that a planner without a network found in the frame of `volume`'s pose, best first, those that are asked
/// for. The hand is theirs already.
#[must_use]
pub fn select(grasps: &[Grasp], volume: &Volume, params: &DecodeParams) -> Decoded {
    let selection = Selection::new(volume, params);
    let above = |threshold: f32| {
        let mut decoded = Decoded::default();
        for grasp in grasps {
            if grasp.quality < threshold {
                decoded.dropped.below_threshold += 1;
            } else if selection.keeps(&grasp.pose, &mut decoded.dropped) {
                decoded.grasps.push(*grasp);
            }
        }
        decoded
    };
    let decoded = above(params.threshold);
    match params.floor() {
        Some(floor) if decoded.grasps.is_empty() => above(floor).best_alone(),
        _ => decoded,
    }
}
