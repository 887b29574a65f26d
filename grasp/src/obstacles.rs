use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3};

use crate::{Hand, Volume, before};

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
}

impl Default for Clearance {
    /// The Panda hand and the pre-grasp distance of the benchmark.
    fn default() -> Self {
        Self { hand: Hand::PANDA, from: 0.05, behind: 0.25, table: None }
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

/// Obstacles for the hand: voxels at or behind the observed surfaces of a volume, and the table. Unobserved space
/// counts as free.
#[derive(Clone, Debug)]
pub struct Obstacles {
    clearance: Clearance,
    blocks: Vec<Block>,
    /// Pose of the volume.
    pose: Isometry3<f64>,
}

impl Obstacles {
    /// The obstacles in `volume`.
    #[must_use]
    pub fn observed(volume: &Volume, clearance: Clearance) -> Self {
        let (n, size) = (volume.resolution(), volume.voxel_size());
        let behind = 0.5 - clearance.behind / 2.0;
        let place = |cell: [f64; 3]| volume.pose() * Point3::from(cell.map(|c| c * size));
        let mut blocks = BTreeMap::<[usize; 3], Vec<Point3<f64>>>::new();
        for (index, &value) in volume.values().iter().enumerate() {
            if value > 0.0 && value <= behind {
                let cell = [index / (n * n), index / n % n, index % n];
                blocks.entry(cell.map(|c| c / BLOCK)).or_default().push(place(cell.map(|c| c as f64 + 0.5)));
            }
        }
        let block = |(block, points): ([usize; 3], _)| Block {
            centre: place(block.map(|c| (c as f64 + 0.5) * BLOCK as f64)),
            radius: 0.5 * 3.0_f64.sqrt() * BLOCK as f64 * size,
            points,
        };
        Self { clearance, blocks: blocks.into_iter().map(block).collect(), pose: *volume.pose() }
    }

    /// Whether the open hand collides on its way from the pre-grasp to `pose` (frame of the volume's pose).
    #[must_use]
    pub fn meet(&self, pose: &Isometry3<f64>) -> bool {
        let Clearance { hand, from, table, .. } = self.clearance;
        // The motion is straight, so the lowest point is at one of its ends.
        let low =
            |pose: &Isometry3<f64>| table.is_some_and(|table| hand.lowest_point(&(self.pose.inverse() * pose)) < table);
        if low(pose) || low(&before(pose, from)) {
            return true;
        }
        // A matrix rotates the thousands of points faster than a quaternion.
        let turn = pose.rotation.inverse().to_rotation_matrix();
        let in_hand = |point: &Point3<f64>| Point3::from(turn * (point.coords - pose.translation.vector));
        let near = |block: &&Block| hand.comes_near(&in_hand(&block.centre), from, block.radius);
        self.blocks.iter().filter(near).flat_map(|block| &block.points).any(|point| hand.meets(&in_hand(point), from))
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
            let meets = all.iter().any(|point| hand.meets(&pose.inverse_transform_point(point), from));
            assert_eq!(obstacles.meet(&pose), meets, "{pose}");
            met += usize::from(meets);
        }
        assert!((100..300).contains(&met), "{met} of 400 poses collide");
    }

    #[test]
    fn a_hand_collides_with_observed_surfaces_only() {
        let meet = |clearance: Clearance, x, z| Obstacles::observed(&wall(), clearance).meet(&down(x, z));
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
            Obstacles::observed(&wall(), Clearance { table, behind: 1.0, ..Clearance::default() }).meet(pose)
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
