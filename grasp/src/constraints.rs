use nalgebra::{Isometry3, Point3, Unit, Vector3};

use crate::Hand;

/// Constraints on a grasp besides its quality, in the frame of the volume's pose. The default has none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Constraints {
    /// The requested workspace, if the volume is larger.
    pub workspace: Option<Region>,
    /// Region in which the point between the fingertips must lie.
    pub region: Option<Region>,
    /// Allowed approach directions.
    pub approach: Option<Cone>,
    /// Smallest allowed height of the lowest corner of the open hand, metres along z of the frame.
    pub min_height: Option<f64>,
}

/// A box aligned with the axes of its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Pose of the box's frame in the frame of the volume's pose.
    pub frame: Isometry3<f64>,
    /// Smallest coordinates, metres.
    pub lower: [f64; 3],
    /// Largest coordinates, metres.
    pub upper: [f64; 3],
}

/// A cone of directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// Centre direction.
    pub axis: Unit<Vector3<f64>>,
    /// Largest angle to the axis, radians.
    pub angle: f64,
}

/// The constraint that a grasp violates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Violation {
    /// The grasp is outside the workspace or the region.
    Region,
    /// The approach direction is outside the cone.
    Approach,
    /// The hand is too low.
    Height,
}

impl Constraints {
    /// The first constraint that a grasp at `pose` with `hand` violates, if any.
    #[must_use]
    pub fn violation(&self, pose: &Isometry3<f64>, hand: &Hand) -> Option<Violation> {
        let Self { workspace, region, approach, min_height } = self;
        let between = pose * Point3::new(0.0, 0.0, hand.depth);
        let outside = |region: &Option<Region>| region.is_some_and(|region| !region.contains(&between));
        if outside(workspace) || outside(region) {
            Some(Violation::Region)
        } else if approach.is_some_and(|cone| !cone.contains(&(pose.rotation * Vector3::z()))) {
            Some(Violation::Approach)
        } else if min_height.is_some_and(|height| hand.lowest_point(pose) < height) {
            Some(Violation::Height)
        } else {
            None
        }
    }
}

impl Region {
    fn contains(&self, point: &Point3<f64>) -> bool {
        let point = self.frame.inverse_transform_point(point);
        (0..3).all(|axis| (self.lower[axis]..=self.upper[axis]).contains(&point[axis]))
    }
}

impl Cone {
    fn contains(&self, direction: &Vector3<f64>) -> bool {
        self.axis.angle(direction) <= self.angle
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    /// Points straight down, tilted by `tilt`; the fingertips are 5 cm below (0.1, 0.2, 0.3).
    fn down(tilt: f64) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI - tilt);
        Isometry3::from_parts(Translation3::new(0.1, 0.2, 0.3), rotation)
    }

    #[test]
    fn each_constraint_is_enforced() {
        let hand = Hand::GPD;
        let violation = |constraints: Constraints| constraints.violation(&down(0.0), &hand);
        assert_eq!(violation(Constraints::default()), None);

        let frame = Isometry3::translation(0.0, 0.2, 0.0);
        let around = |z: f64| Region { frame, lower: [0.0, -0.01, z], upper: [0.2, 0.01, z + 0.02] };
        assert_eq!(violation(Constraints { region: Some(around(0.24)), ..Default::default() }), None);
        // The region applies to the fingertips, not to the finger base.
        let (region, workspace) = (Some(around(0.29)), Some(around(0.29)));
        assert_eq!(violation(Constraints { region, ..Default::default() }), Some(Violation::Region));
        assert_eq!(violation(Constraints { workspace, ..Default::default() }), Some(Violation::Region));

        let approach = Some(Cone { axis: -Vector3::z_axis(), angle: 0.3 });
        let constraints = Constraints { approach, ..Default::default() };
        assert_eq!(constraints.violation(&down(0.29), &hand), None);
        assert_eq!(constraints.violation(&down(-0.31), &hand), Some(Violation::Approach));

        assert_eq!(violation(Constraints { min_height: Some(0.249), ..Default::default() }), None);
        assert_eq!(violation(Constraints { min_height: Some(0.251), ..Default::default() }), Some(Violation::Height));
    }
}
