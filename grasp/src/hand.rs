use nalgebra::{Isometry3, Point3, Vector3};
use thiserror::Error;

use crate::{FINGER_DEPTH, MAX_OPENING};

/// An open parallel-jaw hand as boxes: two fingers and a palm. Metres, in the grasp frame (z the approach, ±y the
/// closing axis, origin at the finger base).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hand {
    /// Thickness of a finger along the closing axis (GPD: `finger_width`).
    pub finger_width: f64,
    /// Distance between the outer sides of the open fingers (GPD: `hand_outer_diameter`).
    pub outer_diameter: f64,
    /// Length of the fingers (GPD: `hand_depth`).
    pub depth: f64,
    /// Breadth of the fingers along x, centred on 0 (GPD: `hand_height`).
    pub height: f64,
    /// Box of the palm: smallest and largest coordinates. Both are the same for a hand without a palm.
    pub palm: [[f64; 3]; 2],
}

/// A dimension of a hand is invalid.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{field} is {value} m, must be {needed}")]
pub struct HandError {
    /// Name of the dimension: `max_opening`, `finger_depth`, `finger_width`, `finger_breadth` or `palm`.
    pub field: &'static str,
    /// Its value, metres.
    pub value: f64,
    /// Requirement on the value.
    pub needed: &'static str,
}

impl Hand {
    /// A hand whose fingers open to `max_opening`, are `depth` long, `width` thick along the closing axis and `breadth`
    /// broad across it. `palm` is the box behind the fingers: smallest and largest coordinates in the grasp frame.
    /// Metres.
    ///
    /// # Errors
    /// [`HandError`] names the first invalid dimension.
    pub fn new(max_opening: f64, depth: f64, width: f64, breadth: f64, palm: [[f64; 3]; 2]) -> Result<Self, HandError> {
        const LENGTH: &str = "above 0 and at most 0.5";
        let named = [
            ("max_opening", max_opening),
            ("finger_depth", depth),
            ("finger_width", width),
            ("finger_breadth", breadth),
        ];
        for (field, value) in named {
            // Written so that NaN fails.
            if !(value > 0.0 && value <= 0.5) {
                return Err(HandError { field, value, needed: LENGTH });
            }
        }
        for (lower, upper) in palm[0].into_iter().zip(palm[1]) {
            if !(lower.abs() <= 1.0 && upper.abs() <= 1.0) {
                let value = if lower.abs() <= 1.0 { upper } else { lower };
                return Err(HandError { field: "palm", value, needed: "within 1 m of the finger base" });
            }
            if lower > upper {
                return Err(HandError {
                    field: "palm",
                    value: lower,
                    needed: "at most the same coordinate of the upper corner",
                });
            }
        }
        if palm[1][2] >= depth {
            return Err(HandError { field: "palm", value: palm[1][2], needed: "behind the fingertips" });
        }
        Ok(Self { finger_width: width, outer_diameter: max_opening + 2.0 * width, depth, height: breadth, palm })
    }

    /// The Panda hand, with the boxes of VGN's URDF.
    pub const PANDA: Self = Self {
        finger_width: 0.0264,
        outer_diameter: MAX_OPENING + 2.0 * 0.0264,
        depth: 0.0502,
        height: 0.021,
        palm: [[-0.0316, -0.10, -0.088], [0.0316, 0.10, 0.004]],
    };

    /// The Panda hand with the fingers of GPD, which also open to [`MAX_OPENING`]. GPD's hand has no palm, so its
    /// candidates from the side would put the palm into the table.
    pub const GPD: Self =
        Self { finger_width: 0.015, outer_diameter: 0.11, depth: FINGER_DEPTH, height: 0.02, ..Self::PANDA };

    /// The hand with boxes that are larger by `margin` on every side.
    #[must_use]
    pub fn grown(self, margin: f64) -> Self {
        let palm = match self.palm {
            [lower, upper] if lower == upper => self.palm,
            [lower, upper] => [lower.map(|c| c - margin), upper.map(|c| c + margin)],
        };
        Self {
            finger_width: self.finger_width + 2.0 * margin,
            outer_diameter: self.outer_diameter + 2.0 * margin,
            depth: self.depth + margin,
            height: self.height + 2.0 * margin,
            palm,
        }
    }

    /// The hand opened by less: half of the opening is `half_opening`, metres.
    #[must_use]
    pub fn opened_to(self, half_opening: f64) -> Self {
        Self { outer_diameter: 2.0 * (half_opening + self.finger_width), ..self }
    }

    /// Half of the opening between the fingers, metres.
    #[must_use]
    pub fn half_opening(&self) -> f64 {
        self.outer_diameter / 2.0 - self.finger_width
    }

    /// Whether a finger hits a point of the grasp frame on an approach from any distance.
    #[must_use]
    pub fn finger_collides(&self, point: &Point3<f64>) -> bool {
        point.x.abs() <= self.height / 2.0
            && (self.half_opening()..=self.outer_diameter / 2.0).contains(&point.y.abs())
            && point.z <= self.depth
    }

    /// Whether the open hand hits a point of the grasp frame on an approach from `from` metres back.
    #[must_use]
    pub fn collides(&self, point: &Point3<f64>, from: f64) -> bool {
        let at_fingers = point.x.abs() <= self.height / 2.0
            && (self.half_opening()..=self.outer_diameter / 2.0).contains(&point.y.abs())
            && (-from..=self.depth).contains(&point.z);
        at_fingers || self.palm_meets_on_way(point, from)
    }

    /// Whether the palm hits a point of the grasp frame on an approach from `from` metres back.
    pub(crate) fn palm_meets_on_way(&self, point: &Point3<f64>, from: f64) -> bool {
        let [lower, upper] = self.palm;
        (0..2).all(|axis| (lower[axis]..=upper[axis]).contains(&point[axis]))
            && (lower[2] - from..=upper[2]).contains(&point.z)
    }

    /// Whether a sphere around a point of the grasp frame may contain a point that the hand [meets](Self::meets).
    pub(crate) fn comes_near(&self, centre: &Point3<f64>, from: f64, radius: f64) -> bool {
        let [lower, upper] = self.palm;
        let (x, y) = (self.height / 2.0, self.outer_diameter / 2.0);
        let box_of_all = [
            lower[0].min(-x)..=upper[0].max(x),
            lower[1].min(-y)..=upper[1].max(y),
            lower[2].min(0.0) - from..=upper[2].max(self.depth),
        ];
        centre.iter().zip(box_of_all).all(|(c, side)| (side.start() - radius..=side.end() + radius).contains(c))
    }

    /// Whether a point of the grasp frame is inside the palm.
    #[must_use]
    pub fn palm_collides(&self, point: &Point3<f64>) -> bool {
        let [lower, upper] = self.palm;
        (0..3).all(|axis| (lower[axis]..=upper[axis]).contains(&point[axis]))
    }

    /// Whether a point of the grasp frame is between the fingers.
    #[must_use]
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        point.x.abs() <= self.height / 2.0
            && point.y.abs() <= self.half_opening()
            && (0.0..=self.depth).contains(&point.z)
    }

    /// Height of the lowest corner of the open hand at `pose`, metres along z of the frame of `pose`.
    #[must_use]
    pub fn lowest_point(&self, pose: &Isometry3<f64>) -> f64 {
        let (x, y) = (self.height / 2.0, self.outer_diameter / 2.0);
        let fingers = [[-x, -y, 0.0], [x, y, self.depth]];
        let up = pose.rotation.inverse() * Vector3::z();
        let lowest = |[lower, upper]: [[f64; 3]; 2]| -> f64 {
            (0..3).map(|axis| (up[axis] * lower[axis]).min(up[axis] * upper[axis])).sum()
        };
        pose.translation.z + lowest(fingers).min(lowest(self.palm))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    #[test]
    fn points_are_assigned_to_fingers_palm_and_opening() {
        let hand = Hand::GPD;
        assert!((2.0 * hand.half_opening() - MAX_OPENING).abs() < 1e-12);
        let between = Point3::new(0.0, 0.0, 0.03);
        assert!(hand.contains(&between) && !hand.finger_collides(&between) && !hand.palm_collides(&between));
        for y in [-0.045, 0.045] {
            assert!(hand.finger_collides(&Point3::new(0.005, y, 0.03)));
            assert!(hand.finger_collides(&Point3::new(0.005, y, -0.1)), "during the approach");
            assert!(
                !hand.finger_collides(&Point3::new(0.02, y, 0.03)) && !hand.finger_collides(&Point3::new(0.0, y, 0.06))
            );
        }
        assert!(hand.palm_collides(&Point3::new(0.03, 0.09, -0.05)));
        assert!(
            hand.collides(&Point3::new(0.005, 0.045, -0.05), 0.05)
                && !hand.collides(&Point3::new(0.0, 0.0, 0.03), 0.05)
        );
        assert!(
            hand.collides(&Point3::new(0.0, 0.0, -0.13), 0.05) && !hand.collides(&Point3::new(0.0, 0.0, -0.13), 0.04)
        );
    }

    #[test]
    fn a_hand_without_a_palm_gets_none_by_a_margin() {
        let hand = Hand::new(0.1, 0.06, 0.01, 0.02, Default::default()).unwrap().grown(0.02);
        let between_the_fingers = Point3::new(0.0, 0.0, 0.01);
        assert!(!hand.collides(&between_the_fingers, 0.05));
        assert!(Hand::PANDA.grown(0.02).collides(&between_the_fingers, 0.05));
    }

    #[test]
    fn dimensions_of_a_hand_are_checked() {
        let Hand { finger_width, depth, height, palm, .. } = Hand::PANDA;
        assert_eq!(Hand::new(MAX_OPENING, depth, finger_width, height, palm), Ok(Hand::PANDA));
        let message = |hand: Result<Hand, HandError>| hand.unwrap_err().to_string();
        assert_eq!(
            message(Hand::new(-0.08, depth, finger_width, height, palm)),
            "max_opening is -0.08 m, must be above 0 and at most 0.5"
        );
        assert!(message(Hand::new(80.0, depth, finger_width, height, palm)).starts_with("max_opening is 80 m"));
        assert!(message(Hand::new(0.08, f64::NAN, finger_width, height, palm)).starts_with("finger_depth is NaN m"));
        let turned = [palm[1], palm[0]];
        assert!(message(Hand::new(0.08, depth, finger_width, height, turned)).starts_with("palm is 0.0316 m"));
        let long = [palm[0], [0.03, 0.1, 0.06]];
        assert!(message(Hand::new(0.08, depth, finger_width, height, long)).ends_with("behind the fingertips"));
    }

    #[test]
    fn the_lowest_point_is_a_fingertip_or_the_palm() {
        let hand = Hand::GPD;
        let at = |angle| {
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), angle);
            hand.lowest_point(&Isometry3::from_parts(Translation3::new(0.1, 0.1, 0.5), rotation))
        };
        assert!((at(PI) - 0.45).abs() < 1e-12, "straight down: the fingertips");
        assert!((at(FRAC_PI_2) - 0.40).abs() < 1e-12, "from the side, closing vertically: the palm");
        assert!((at(0.0) - (0.5 - 0.088)).abs() < 1e-12, "straight up: the back of the palm");
    }
}
