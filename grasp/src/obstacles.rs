use nalgebra::{Isometry3, Point3};

use crate::{Hand, Volume, pregrasp};

/// Parameters of the collision check between the open hand and the observed surfaces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearance {
    /// The open hand.
    pub hand: Hand,
    /// Distance from the pre-grasp to the grasp along the approach, metres. The check covers this motion.
    pub from: f64,
    /// Depth behind a surface at which a voxel becomes an obstacle, as a fraction of the truncation distance. It
    /// tolerates noise of the observed surface.
    pub behind: f32,
    /// Height of the table, metres above the volume's bottom; `None` without a table.
    pub table: Option<f64>,
    /// Smallest distance between the hand and the obstacles, metres.
    pub margin: f64,
    /// Whether voxels that lie behind a surface in a view and were not measured by any view are obstacles, too.
    pub hidden: bool,
}

impl Default for Clearance {
    /// The Panda hand and the pre-grasp distance of the benchmark.
    fn default() -> Self {
        Self { hand: Hand::PANDA, from: 0.05, behind: 0.25, table: None, margin: 0.0, hidden: false }
    }
}

/// Edge of a block in voxels. Blocks are tested before their points.
const BLOCK: usize = 4;

/// A group of neighbouring points.
#[derive(Clone, Debug)]
struct Block {
    centre: Point3<f64>,
    /// Radius of a sphere around the centre that contains all points, metres.
    radius: f64,
    points: Vec<Point3<f64>>,
}

/// Obstacles for the hand: voxels at or behind the observed surfaces of a volume, the table, and on request the hidden
/// voxels. Other unobserved space counts as free.
#[derive(Clone, Debug)]
pub struct Obstacles {
    clearance: Clearance,
    /// The hand, grown by the margin.
    hand: Hand,
    blocks: Vec<Block>,
    /// Pose of the volume.
    pose: Isometry3<f64>,
}

impl Obstacles {
    /// The obstacles in `volume` and around it. Hidden voxels are known only in a volume that was fused from views.
    #[must_use]
    pub fn observed(volume: &Volume, clearance: Clearance) -> Self {
        let pose = *volume.pose();
        let volume = volume.observed();
        let (n, size) = (volume.resolution(), volume.voxel_size());
        let behind = 0.5 - clearance.behind / 2.0;
        let place = |cell: [f64; 3]| volume.pose() * Point3::from(cell.map(|c| c * size));
        let side = n.div_ceil(BLOCK);
        let mut blocks = vec![Vec::new(); side.pow(3)];
        let hidden = volume.hidden().filter(|_| clearance.hidden);
        for (index, &value) in volume.values().iter().enumerate() {
            if value > 0.0 && value <= behind || hidden.is_some_and(|hidden| hidden[index]) {
                let cell = [index / (n * n), index / n % n, index % n];
                let [x, y, z] = cell.map(|c| c / BLOCK);
                blocks[(x * side + y) * side + z].push(place(cell.map(|c| c as f64 + 0.5)));
            }
        }
        let block = |(index, points): (usize, Vec<Point3<f64>>)| Block {
            centre: place(
                [index / (side * side), index / side % side, index % side].map(|c| (c as f64 + 0.5) * BLOCK as f64),
            ),
            radius: 0.5 * 3.0_f64.sqrt() * BLOCK as f64 * size,
            points,
        };
        let blocks = blocks.into_iter().enumerate().filter(|(_, points)| !points.is_empty()).map(block).collect();
        let hand = clearance.hand.grown(clearance.margin);
        Self { clearance, hand, blocks, pose }
    }

    /// Whether the open hand collides on its way from the pre-grasp to `pose` (frame of the volume's pose).
    #[must_use]
    pub fn collides(&self, pose: &Isometry3<f64>) -> bool {
        self.meet_table(pose, &self.hand)
            || self.near(pose).any(|point| self.hand.collides(&point, self.clearance.from))
    }

    /// The largest opening with which the hand is free of collisions on its way to `pose`, metres: at most that of the
    /// hand, and more than `width`, the size of the object. `None` if there is none.
    #[must_use]
    pub fn opening(&self, pose: &Isometry3<f64>, width: f64) -> Option<f64> {
        let Clearance { hand: of_request, from, margin, .. } = self.clearance;
        let (breadth, thickness) = (self.hand.height / 2.0, self.hand.finger_width);
        // Distances from the middle of the hand of the points that the fingers meet at some opening.
        let mut blocking = Vec::new();
        for point in self.near(pose) {
            if self.hand.palm_meets_on_way(&point, from) {
                return None;
            }
            if point.x.abs() <= breadth && (-from..=self.hand.depth).contains(&point.z) {
                blocking.push(point.y.abs());
            }
        }
        blocking.sort_by(|a, b| b.total_cmp(a));
        let mut inner = self.hand.half_opening();
        for distance in blocking {
            if distance >= inner && distance <= inner + thickness {
                // Just free of this point.
                inner = distance - thickness - 1e-6;
            }
        }
        let half = inner + margin;
        let is_free = 2.0 * half > width && !self.meet_table(pose, &of_request.opened_to(half).grown(margin));
        is_free.then_some(2.0 * half)
    }

    /// Whether the hand meets the table on its way to `pose`.
    fn meet_table(&self, pose: &Isometry3<f64>, hand: &Hand) -> bool {
        let Clearance { from, table, .. } = self.clearance;
        // The motion is straight, so the lowest point is at one of its ends.
        let is_low =
            |pose: &Isometry3<f64>| table.is_some_and(|table| hand.lowest_point(&(self.pose.inverse() * pose)) < table);
        is_low(pose) || is_low(&pregrasp(pose, from))
    }

    /// The obstacles near the hand on its way to `pose`, in the frame of the hand.
    fn near(&self, pose: &Isometry3<f64>) -> impl Iterator<Item = Point3<f64>> {
        let from = self.clearance.from;
        // A matrix rotates the thousands of points faster than a quaternion.
        let turn = pose.rotation.inverse().to_rotation_matrix();
        let origin = pose.translation.vector;
        let in_hand = move |point: &Point3<f64>| Point3::from(turn * (point.coords - origin));
        let is_near = move |block: &&Block| self.hand.comes_near(&in_hand(&block.centre), from, block.radius);
        self.blocks.iter().filter(is_near).flat_map(|block| &block.points).map(in_hand)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    use super::*;

    const N: usize = 40;
    const SIZE: f64 = 0.0075;

    /// A wall with its face in the plane x = 0.15, observed from in front of it to 0.03 m behind it. The volume's
    /// corner is at (1, 2, 3).
    fn wall() -> Volume {
        let value = |index: usize| {
            let behind = (index / (N * N)) as f64 + 0.5 - 20.0;
            if behind < 4.0 { (0.5 - behind / 8.0).clamp(0.0, 1.0) as f32 } else { 0.0 }
        };
        Volume::new(N, SIZE, Isometry3::translation(1.0, 2.0, 3.0), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    /// A hand that points straight down and closes along x, its base at (x, 0.15, z) from the volume's corner.
    fn down(x: f64, z: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        Isometry3::from_parts(Translation3::new(1.0 + x, 2.15, 3.0 + z), turn)
    }

    fn points(obstacles: &Obstacles) -> Vec<Point3<f64>> {
        obstacles.blocks.iter().flat_map(|block| block.points.clone()).collect()
    }

    #[test]
    fn testing_blocks_first_does_not_change_the_result() {
        let obstacles = Obstacles::observed(&wall(), Clearance::default());
        let all = points(&obstacles);
        let Clearance { hand, from, .. } = obstacles.clearance;
        let mut met = 0;
        for step in 0..400 {
            let f = f64::from(step);
            let turn = UnitQuaternion::from_euler_angles(0.7 * f, 1.3 * f, 2.1 * f);
            let at = Translation3::new(1.0 + (0.37 * f) % 0.3, 2.0 + (0.11 * f) % 0.3, 3.0 + (0.23 * f) % 0.4);
            let pose = Isometry3::from_parts(at, turn);
            let meets = all.iter().any(|point| hand.collides(&pose.inverse_transform_point(point), from));
            assert_eq!(obstacles.collides(&pose), meets, "{pose}");
            met += usize::from(meets);
        }
        assert!((100..300).contains(&met), "{met} of 400 poses collide");
    }

    #[test]
    fn a_hand_collides_with_observed_surfaces_only() {
        let meet = |clearance: Clearance, x, z| Obstacles::observed(&wall(), clearance).collides(&down(x, z));
        let clearance = Clearance { behind: 0.0, ..Clearance::default() };
        // The palm reaches 0.1 m to each side.
        assert!(!meet(clearance, 0.04, 0.15) && meet(clearance, 0.06, 0.15) && meet(clearance, 0.15, 0.15));
        // Above the wall the hand is free.
        assert!(!meet(clearance, 0.06, 0.36) && !meet(Clearance { from: 0.0, ..clearance }, 0.06, 0.31));
        assert!(meet(Clearance { from: 0.1, ..clearance }, 0.06, 0.15));
    }

    #[test]
    fn a_hand_collides_with_the_table_at_the_grasp_and_at_the_pre_grasp() {
        let meet = |table, pose: &Isometry3<f64>| {
            Obstacles::observed(&wall(), Clearance { table, behind: 1.0, ..Clearance::default() }).collides(pose)
        };
        // The fingertips are 0.1 - 0.0502 m above the volume's bottom.
        let pose = down(0.04, 0.1);
        assert!(!meet(None, &pose) && !meet(Some(0.049), &pose) && meet(Some(0.051), &pose));
        // An approach from below: the pre-grasp is lower than the grasp.
        let up = Isometry3::translation(1.04, 2.15, 3.2);
        assert!(
            !meet(Some(0.06), &up) && meet(Some(0.07), &up),
            "the back of the palm is 0.088 m below the base, and 0.05 m lower at the pre-grasp"
        );
    }

    #[test]
    fn hidden_voxels_are_obstacles_on_request() {
        // The wall is 0.03 m thick in the volume; what is behind is hidden.
        let hidden = (0..N.pow(3)).map(|index| index / (N * N) >= 24).collect();
        let volume = wall().with_hidden(hidden);
        let meet = |hidden, x| {
            Obstacles::observed(&volume, Clearance { hidden, ..Clearance::default() }).collides(&down(x, 0.15))
        };
        assert!(!meet(false, 0.3) && meet(true, 0.3), "the palm reaches 0.1 m to each side");
        assert!(!meet(true, 0.04));
    }

    #[test]
    fn a_margin_keeps_the_hand_away_from_surfaces() {
        let meet = |margin, x| {
            let clearance = Clearance { behind: 0.0, margin, ..Clearance::default() };
            Obstacles::observed(&wall(), clearance).collides(&down(x, 0.15))
        };
        // The first voxel of the wall is at 0.15375.
        assert!(!meet(0.0, 0.05) && !meet(0.003, 0.05) && meet(0.005, 0.05));
    }

    #[test]
    fn the_hand_is_opened_as_far_as_obstacles_permit() {
        let hand = Hand { palm: [[-0.03, -0.03, -0.088], [0.03, 0.03, 0.004]], ..Hand::PANDA };
        let opening = |margin, x, width| {
            let clearance = Clearance { hand, behind: 0.0, margin, table: Some(0.05), ..Clearance::default() };
            Obstacles::observed(&wall(), clearance).opening(&down(x, 0.15), width)
        };
        let is_near = |opening: Option<f64>, expected| opening.is_some_and(|o| f64::abs(o - expected) < 1e-5);
        assert!(is_near(opening(0.0, 0.05, 0.02), 0.08), "nothing is near");
        // The first voxel of the wall is at 0.15375, and a finger is 0.0264 thick.
        assert!(is_near(opening(0.0, 0.1, 0.02), 2.0 * (0.05375 - 0.0264)));
        assert!(is_near(opening(0.005, 0.1, 0.02), 2.0 * (0.05375 - 0.0264 - 0.005)));
        assert_eq!(opening(0.0, 0.1, 0.06), None, "the object is wider");
        assert_eq!(opening(0.0, 0.14, 0.02), None, "the palm meets the wall");
    }

    #[test]
    fn voxels_just_behind_the_surface_can_be_ignored() {
        let count = |behind| {
            let clearance = Clearance { behind, ..Clearance::default() };
            points(&Obstacles::observed(&wall(), clearance)).len() / (N * N)
        };
        // The voxels are 0.5, 1.5, 2.5 and 3.5 behind the surface; the truncation distance is 4.
        assert_eq!([0.0, 0.25, 0.5, 0.875, 0.9].map(count), [4, 3, 2, 1, 0]);
        let points = points(&Obstacles::observed(&wall(), Clearance { behind: 0.0, ..Clearance::default() }));
        assert!(
            points.iter().all(|p| (1.15..1.18).contains(&p.x) && p.y > 2.0 && p.z > 3.0),
            "points are in the frame of the volume's pose"
        );
    }
}
