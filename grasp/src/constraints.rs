use nalgebra::{Isometry3, Point3, Unit, Vector3};

use crate::Hand;

/// What is asked of a grasp besides its quality, in the frame of the volume's pose. By default nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Constraints {
    /// The cube that was asked about, where the volume reaches beyond it.
    pub workspace: Option<Region>,
    /// Where the point between the fingertips must lie.
    pub region: Option<Region>,
    /// Where the hand must come from.
    pub approach: Option<Cone>,
    /// How low the lowest corner of the open hand may be, metres above the frame's z = 0.
    pub min_height: Option<f64>,
}

/// A box, its edges along the axes of a frame of its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// The box's frame in that of the volume's pose.
    pub frame: Isometry3<f64>,
    /// Smallest coordinates, metres.
    pub lower: [f64; 3],
    /// Largest coordinates, metres.
    pub upper: [f64; 3],
}

/// Directions about an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// The direction in its middle.
    pub axis: Unit<Vector3<f64>>,
    /// The largest angle to it, radians.
    pub angle: f64,
}

/// What a grasp violates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Violation {
    /// It is outside of the workspace or the region.
    Region,
    /// It comes from elsewhere.
    Approach,
    /// The hand would be too low.
    Height,
}

impl Constraints {
    /// The first thing that a grasp violates, if it does, executed by `hand`.
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

    /// Straight down but for `tilt`, its fingertips 5 cm below (0.1, 0.2, 0.3).
    fn down(tilt: f64) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI - tilt);
        Isometry3::from_parts(Translation3::new(0.1, 0.2, 0.3), rotation)
    }

    #[test]
    fn each_constraint_is_kept() {
        let hand = Hand::GPD;
        let violation = |constraints: Constraints| constraints.violation(&down(0.0), &hand);
        assert_eq!(violation(Constraints::default()), None);

        let frame = Isometry3::translation(0.0, 0.2, 0.0);
        let around = |z: f64| Region { frame, lower: [0.0, -0.01, z], upper: [0.2, 0.01, z + 0.02] };
        assert_eq!(violation(Constraints { region: Some(around(0.24)), ..Default::default() }), None);
        // It is the fingertips that count, not where the hand begins.
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
