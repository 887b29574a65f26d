//! The shape of the Panda hand: the convex parts in `sim/hand`, which the PyBullet simulator loads too.

use std::sync::LazyLock;

use nalgebra::{Isometry3, Point3, Vector3};
use rapier3d::math::Vector;
use rapier3d::prelude::SharedShape;

use super::world::{SCALE, vector};

/// Height of the grasp frame above the hand's own frame, along the approach (VGN's TCP).
const TCP: f64 = 0.062;

/// Height of the fingers' frames above the hand's own, as in `hand.urdf`.
const FINGER_ROOT: f64 = 0.0584;

/// Travel of each finger, metres.
pub(super) const FINGER_TRAVEL: f64 = grasp::MAX_OPENING / 2.0;

/// A convex part of the hand in a frame: for the open hand the grasp frame, whose z is the approach and ±y the closing
/// axis.
#[derive(Clone)]
pub struct HandPart {
    corners: Vec<Point3<f64>>,
    pub(super) shape: SharedShape,
}

/// The palm in the grasp frame.
pub(super) static PALM: LazyLock<HandPart> =
    LazyLock::new(|| HandPart::of_file(include_str!("../../hand/palm.obj"), |p| p - Vector3::z() * TCP));

/// The left (+y) and the right finger, in frames that coincide with the grasp frame when the hand is closed.
pub(super) static FINGERS: LazyLock<[HandPart; 2]> = LazyLock::new(|| {
    [1.0, -1.0].map(|side| {
        HandPart::of_file(include_str!("../../hand/finger.obj"), |p| {
            Point3::new(side * p.x, side * p.y, p.z + FINGER_ROOT - TCP)
        })
    })
});

/// The Panda hand, fully open.
pub static OPEN_HAND: LazyLock<Vec<HandPart>> = LazyLock::new(|| {
    let [left, right] = &*FINGERS;
    let open = Vector3::new(0.0, FINGER_TRAVEL, 0.0);
    vec![left.moved(&open), right.moved(&-open), PALM.clone()]
});

impl HandPart {
    /// The convex hull of these corners, metres.
    ///
    /// # Panics
    /// If the corners enclose no volume.
    #[must_use]
    pub fn new(corners: Vec<Point3<f64>>) -> Self {
        let points: Vec<Vector> = corners.iter().map(|p| vector(&(p.coords * SCALE))).collect();
        let shape = SharedShape::convex_hull(&points).expect("the corners of a part of the hand enclose a volume");
        Self { corners, shape }
    }

    /// The mesh of an OBJ file of the hand.
    fn of_file(text: &str, place: impl Fn(Point3<f64>) -> Point3<f64>) -> Self {
        let corner = |line: &str| {
            let mut numbers =
                line.split(' ').map(|number| number.parse().expect("the files of the repository are valid"));
            place(Point3::from(Vector3::from_fn(|_, _| numbers.next().expect("vertices have three coordinates"))))
        };
        Self::new(text.lines().filter_map(|line| line.strip_prefix("v ")).map(corner).collect())
    }

    fn moved(&self, by: &Vector3<f64>) -> Self {
        Self::new(self.corners.iter().map(|corner| corner + by).collect())
    }

    /// The convex hull of the part's motion along the approach, starting `distance` metres back.
    #[must_use]
    pub fn swept(&self, distance: f64) -> Self {
        let back = Vector3::z() * distance;
        Self::new(self.corners.iter().flat_map(|corner| [*corner, corner - back]).collect())
    }

    /// Height of the part's lowest corner when its frame stands at `pose`.
    #[must_use]
    pub fn lowest_point(&self, pose: &Isometry3<f64>) -> f64 {
        self.corners.iter().map(|corner| (pose * corner).z).fold(f64::INFINITY, f64::min)
    }
}
