use std::f64::consts::FRAC_PI_2;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

/// Which frame of the hand a grasp is told by.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Convention {
    /// Where the frame has its origin.
    pub origin: Origin,
    /// Along which of its axes the fingers close.
    pub closing: ClosingAxis,
}

/// Where on the hand a grasp's frame stands.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Origin {
    /// Between the fingers, where they begin.
    #[default]
    FingerBase,
    /// Between the fingertips: the tool centre point.
    Fingertips,
    /// At the link that carries the hand, in which the finger base's frame has this pose (`T_parent_grasp`): what MoveIt
    /// calls an end effector's parent.
    Parent(Isometry3<f64>),
}

/// Along which axis of a grasp's frame the fingers close; z is the approach in any case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ClosingAxis {
    /// ±y, as in VGN's code and here.
    #[default]
    Y,
    /// ±x, as in GraspNet's and Isaac's.
    X,
}

impl Convention {
    /// The pose of this convention's frame for a hand with fingers of `depth` metres at a grasp's `pose`.
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
}

/// Where the hand goes with what it holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Retreat {
    /// Metres.
    pub distance: f64,
    /// In the grasp's frame of reference; back along the approach, where it is `None`.
    pub direction: Option<Unit<Vector3<f64>>>,
}

impl Retreat {
    /// Where a hand ends that held something at `pose`.
    #[must_use]
    pub fn from(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        match self.direction {
            Some(direction) => Translation3::from(direction.into_inner() * self.distance) * pose,
            None => before(pose, self.distance),
        }
    }
}

/// The grasp's pose moved back along its approach by `distance` metres: the pre-grasp.
#[must_use]
pub fn before(pose: &Isometry3<f64>, distance: f64) -> Isometry3<f64> {
    pose * Translation3::new(0.0, 0.0, -distance)
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn every_convention_is_the_same_hand() {
        let pose = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(2.0, -1.0, 0.5));
        let told = |origin, closing| Convention { origin, closing }.pose(&pose, 0.05);
        assert_eq!(told(Origin::FingerBase, ClosingAxis::Y), pose);

        // A finger stands at ±0.04 along the closing axis; its tip 0.05 further along the approach.
        let tip = pose * Point3::new(0.0, 0.04, 0.05);
        let same = |pose: Isometry3<f64>, point: Point3<f64>| assert!((pose * point - tip).norm() < 1e-12);
        same(told(Origin::FingerBase, ClosingAxis::X), Point3::new(0.04, 0.0, 0.05));
        same(told(Origin::Fingertips, ClosingAxis::Y), Point3::new(0.0, 0.04, 0.0));
        same(told(Origin::Fingertips, ClosingAxis::X), Point3::new(0.04, 0.0, 0.0));
        let parent_from_grasp = Isometry3::new(Vector3::new(0.0, 0.0, 0.0584), Vector3::new(0.0, 0.0, 0.785));
        same(told(Origin::Parent(parent_from_grasp), ClosingAxis::Y), parent_from_grasp * Point3::new(0.0, 0.04, 0.05));
        same(before(&pose, 0.1), Point3::new(0.0, 0.04, 0.15));
    }
}
