use std::f64::consts::FRAC_PI_2;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

/// The frame of the hand in which grasp poses are reported.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Convention {
    /// Origin of the frame.
    pub origin: Origin,
    /// Axis of the frame along which the fingers close.
    pub closing: ClosingAxis,
}

/// Position of the frame's origin on the hand.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Origin {
    /// Between the fingers at their base.
    #[default]
    FingerBase,
    /// Between the fingertips: the tool centre point.
    Fingertips,
    /// The link that carries the hand (MoveIt: the parent link of the end effector). The value is the pose of the
    /// finger base in this link (`T_parent_grasp`).
    Parent(Isometry3<f64>),
}

/// Axis of the grasp frame along which the fingers close. z is always the approach.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ClosingAxis {
    /// ±y, as in VGN's code and in this crate.
    #[default]
    Y,
    /// ±x, as in GraspNet and GraspGen.
    X,
}

impl Convention {
    /// The pose of this convention's frame for a grasp at `pose`, executed by a hand with fingers of `depth` metres.
    #[must_use]
    pub fn pose(&self, pose: &Isometry3<f64>, depth: f64) -> Isometry3<f64> {
        let turned = match self.closing {
            ClosingAxis::Y => *pose,
            ClosingAxis::X => pose * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2),
        };
        match &self.origin {
            Origin::FingerBase => turned,
            Origin::Fingertips => turned * Translation3::new(0.0, 0.0, depth),
            Origin::Parent(parent_from_grasp) => turned * parent_from_grasp.inverse(),
        }
    }

    /// The grasp whose frame in this convention is at `pose`: the inverse of [`pose`](Self::pose).
    #[must_use]
    pub fn grasp(&self, pose: &Isometry3<f64>, depth: f64) -> Isometry3<f64> {
        pose * self.pose(&Isometry3::identity(), depth).inverse()
    }
}

/// The motion of the hand after it has closed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Retreat {
    /// Length of the motion, metres.
    pub distance: f64,
    /// Direction in the frame of the grasp poses; `None` means back along the approach.
    pub direction: Option<Unit<Vector3<f64>>>,
}

impl Retreat {
    /// The pose of the hand after the retreat from a grasp at `pose`.
    #[must_use]
    pub fn pose(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        match self.direction {
            Some(direction) => Translation3::from(direction.into_inner() * self.distance) * pose,
            None => pregrasp(pose, self.distance),
        }
    }
}

/// The pre-grasp: `pose` moved back along its approach by `distance` metres.
#[must_use]
pub fn pregrasp(pose: &Isometry3<f64>, distance: f64) -> Isometry3<f64> {
    pose * Translation3::new(0.0, 0.0, -distance)
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn every_convention_describes_the_same_hand() {
        let pose = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(2.0, -1.0, 0.5));
        let converted = |origin, closing| Convention { origin, closing }.pose(&pose, 0.05);
        assert_eq!(converted(Origin::FingerBase, ClosingAxis::Y), pose);

        // The fingers are at ±0.04 along the closing axis, their tips 0.05 further along the approach.
        let tip = pose * Point3::new(0.0, 0.04, 0.05);
        let same = |pose: Isometry3<f64>, point: Point3<f64>| assert!((pose * point - tip).norm() < 1e-12);
        same(converted(Origin::FingerBase, ClosingAxis::X), Point3::new(0.04, 0.0, 0.05));
        same(converted(Origin::Fingertips, ClosingAxis::Y), Point3::new(0.0, 0.04, 0.0));
        same(converted(Origin::Fingertips, ClosingAxis::X), Point3::new(0.04, 0.0, 0.0));
        let parent_from_grasp = Isometry3::new(Vector3::new(0.0, 0.0, 0.0584), Vector3::new(0.0, 0.0, 0.785));
        same(
            converted(Origin::Parent(parent_from_grasp), ClosingAxis::Y),
            parent_from_grasp * Point3::new(0.0, 0.04, 0.05),
        );
        for origin in [Origin::FingerBase, Origin::Fingertips, Origin::Parent(parent_from_grasp)] {
            let convention = Convention { origin, closing: ClosingAxis::X };
            let back = convention.grasp(&convention.pose(&pose, 0.05), 0.05);
            assert!((back.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12);
        }
        same(pregrasp(&pose, 0.1), Point3::new(0.0, 0.04, 0.15));
    }
}
