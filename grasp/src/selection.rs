use std::ops::AddAssign;

use nalgebra::Isometry3;

use crate::{Constraints, DecodeParams, Grasp, Hand, ObjectMap, Obstacles, Violation, Volume};

/// Numbers of dropped voxels, each counted once, under the first reason that applied in this order.
///
/// Together with the grasps they add up to all voxels of the volume.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// The smoothed quality is below the threshold.
    pub below_threshold: usize,
    /// Inside an object, or too far from any observed surface.
    pub mask: usize,
    /// The width is outside the valid range.
    pub width: usize,
    /// At the border of the volume.
    pub border: usize,
    /// Outside the requested workspace or region.
    pub region: usize,
    /// The approach direction is outside the requested cone.
    pub approach: usize,
    /// The hand is below the requested height.
    pub height: usize,
    /// Not on an object that is wanted.
    pub object: usize,
    /// The open hand collides with an observed surface or the table.
    pub collision: usize,
    /// Suppressed by a better grasp nearby.
    pub suppressed: usize,
}

impl AddAssign for Dropped {
    fn add_assign(&mut self, other: Self) {
        self.below_threshold += other.below_threshold;
        self.mask += other.mask;
        self.width += other.width;
        self.border += other.border;
        self.region += other.region;
        self.approach += other.approach;
        self.height += other.height;
        self.object += other.object;
        self.collision += other.collision;
        self.suppressed += other.suppressed;
    }
}

/// Result of [`decode`](crate::decode) or [`Selection::select`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decoded {
    /// Grasps in the frame of the volume's pose, best first.
    pub grasps: Vec<Grasp>,
    /// Reasons why the other voxels hold no grasp.
    pub dropped: Dropped,
}

impl Decoded {
    /// Keeps the best grasp and counts the others as suppressed.
    pub(crate) fn best_alone(mut self) -> Self {
        self.dropped.suppressed += self.grasps.len().saturating_sub(1);
        self.grasps.truncate(1);
        self
    }
}

/// Checks on grasps besides their quality.
pub struct Selection<'a> {
    constraints: Constraints,
    hand: Hand,
    objects: Option<&'a ObjectMap>,
    obstacles: Option<Obstacles>,
}

impl<'a> Selection<'a> {
    /// The checks of `params` in a volume.
    #[must_use]
    pub fn new(volume: &'a Volume, params: &DecodeParams) -> Self {
        Self {
            constraints: params.constraints,
            hand: params.hand.unwrap_or(Hand::PANDA),
            objects: volume.objects(),
            obstacles: params.clearance.map(|clearance| Obstacles::observed(volume, clearance)),
        }
    }

    /// Whether a grasp passes all checks.
    #[must_use]
    pub fn accepts(&self, pose: &Isometry3<f64>) -> bool {
        self.keeps(pose, &mut Dropped::default())
    }

    /// The grasps that reach the threshold of `params` and pass all checks, for grasps that are not decoded from maps. `grasps`
    /// are in the frame of the volume's pose, best first, and already planned for the hand of `params`.
    #[must_use]
    pub fn select(&self, grasps: &[Grasp], params: &DecodeParams) -> Decoded {
        let above = |threshold: f32| {
            let mut decoded = Decoded::default();
            for grasp in grasps {
                if grasp.quality < threshold {
                    decoded.dropped.below_threshold += 1;
                } else if self.keeps(&grasp.pose, &mut decoded.dropped) {
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

    /// Whether a grasp passes all checks. Otherwise counts the reason in `dropped`.
    pub(crate) fn keeps(&self, pose: &Isometry3<f64>, dropped: &mut Dropped) -> bool {
        let count = match self.constraints.violation(pose, &self.hand) {
            Some(Violation::Region) => &mut dropped.region,
            Some(Violation::Approach) => &mut dropped.approach,
            Some(Violation::Height) => &mut dropped.height,
            None if self.objects.is_some_and(|objects| !objects.accepts(pose, &self.hand)) => &mut dropped.object,
            None if self.obstacles.as_ref().is_some_and(|obstacles| obstacles.collides(pose)) => &mut dropped.collision,
            None => return true,
        };
        *count += 1;
        false
    }
}
