use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3};

use crate::{Hand, Volume, before};

/// How a hand must keep clear of what was observed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearance {
    /// Open, on its way.
    pub hand: Hand,
    /// From so far back along the approach, metres: the pre-grasp.
    pub from: f64,
    /// How far behind a surface something is in the way, as a share of the distance at which the field is truncated: a
    /// noisy surface is not everywhere where it was seen.
    pub behind: f32,
    /// Height of a table that the hand must not touch either, metres above the volume's bottom.
    pub table: Option<f64>,
}

impl Default for Clearance {
    /// The Panda hand from the benchmark's pre-grasp on.
    fn default() -> Self {
        Self { hand: Hand::PANDA, from: 0.05, behind: 0.25, table: None }
    }
}

/// Voxels along the edge of a block, which is looked at before its points are.
const BLOCK: usize = 4;

/// Points that lie together.
#[derive(Clone, Debug)]
struct Block {
    centre: Point3<f64>,
    /// Of a ball around the centre in which all of them lie, metres.
    radius: f64,
    points: Vec<Point3<f64>>,
}

/// What was observed and a hand must not touch: points at or behind the surfaces of a volume, and the table. Space that
/// nothing observed is taken to be free.
#[derive(Clone, Debug)]
pub struct Obstacles {
    clearance: Clearance,
    blocks: Vec<Block>,
    /// The volume's.
    pose: Isometry3<f64>,
}

impl Obstacles {
    /// The voxels of `volume` that are in the way.
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

    /// Whether the hand meets one of them on its way to `pose`.
    #[must_use]
    pub fn meet(&self, pose: &Isometry3<f64>) -> bool {
        let Clearance { hand, from, table, .. } = self.clearance;
        // It moves straight: nowhere on its way is it lower than at both ends.
        let low =
            |pose: &Isometry3<f64>| table.is_some_and(|table| hand.lowest_point(&(self.pose.inverse() * pose)) < table);
        if low(pose) || low(&before(pose, from)) {
            return true;
        }
        // As a matrix: there are thousands of points.
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

    /// A wall whose face is the plane x = 0.15, seen from in front of it to 0.03 m behind, with the volume's corner at
    /// (1, 2, 3).
    fn wall() -> Volume {
        let value = |index: usize| {
            let behind = (index / (N * N)) as f64 + 0.5 - 20.0;
            if behind < 4.0 { (0.5 - behind / 8.0).clamp(0.0, 1.0) as f32 } else { 0.0 }
        };
        Volume::new(N, SIZE, Isometry3::translation(1.0, 2.0, 3.0), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    /// A hand straight down whose fingers close along x, its base at (x, 0.15, z) from the volume's corner.
    fn down(x: f64, z: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        Isometry3::from_parts(Translation3::new(1.0 + x, 2.15, 3.0 + z), turn)
    }

    fn points(obstacles: &Obstacles) -> Vec<Point3<f64>> {
        obstacles.blocks.iter().flat_map(|block| block.points.clone()).collect()
    }

    #[test]
    fn looking_at_blocks_first_changes_nothing() {
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
        assert!((100..300).contains(&met), "some do and some do not: {met}");
    }

    #[test]
    fn a_hand_meets_what_was_seen_and_nothing_else() {
        let meet = |clearance: Clearance, x, z| Obstacles::observed(&wall(), clearance).meet(&down(x, z));
        let clearance = Clearance { behind: 0.0, ..Clearance::default() };
        // From the middle of the palm to its end are 0.1 m.
        assert!(!meet(clearance, 0.04, 0.15) && meet(clearance, 0.06, 0.15) && meet(clearance, 0.15, 0.15));
        // Past the wall's top by the hand's height, but for the way.
        assert!(!meet(clearance, 0.06, 0.36) && !meet(Clearance { from: 0.0, ..clearance }, 0.06, 0.31));
        assert!(meet(Clearance { from: 0.1, ..clearance }, 0.06, 0.15));
    }

    #[test]
    fn a_hand_meets_the_table_at_the_grasp_and_before_it() {
        let meet = |table, pose: &Isometry3<f64>| {
            Obstacles::observed(&wall(), Clearance { table, behind: 1.0, ..Clearance::default() }).meet(pose)
        };
        // Fingertips at 0.1 - 0.0502 above the volume's bottom.
        let pose = down(0.04, 0.1);
        assert!(!meet(None, &pose) && !meet(Some(0.049), &pose) && meet(Some(0.051), &pose));
        // From below: on its way it is lower than in the end.
        let up = Isometry3::translation(1.04, 2.15, 3.2);
        assert!(!meet(Some(0.06), &up) && meet(Some(0.07), &up), "the palm's back, 0.088 below, and 0.05 further back");
    }

    #[test]
    fn what_lies_just_behind_the_surface_may_be_spared() {
        let count = |behind| {
            let clearance = Clearance { behind, ..Clearance::default() };
            points(&Obstacles::observed(&wall(), clearance)).len() / (N * N)
        };
        // Voxels 0.5, 1.5, 2.5 and 3.5 behind, of a truncation of four.
        assert_eq!([0.0, 0.25, 0.5, 0.875, 0.9].map(count), [4, 3, 2, 1, 0]);
        let points = points(&Obstacles::observed(&wall(), Clearance { behind: 0.0, ..Clearance::default() }));
        assert!(points.iter().all(|p| (1.15..1.18).contains(&p.x) && p.y > 2.0 && p.z > 3.0), "in the volume's frame");
    }
}
