use std::collections::{BTreeMap, BTreeSet, HashMap};

use foldhash::fast::RandomState;
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

use crate::{Grasp, Hand};

/// Which object the observed surfaces belong to, as a segmentation of the images says. Label 0 is no object.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectMap {
    /// `T_map_frame`: maps points of the frame of the grasps into that of the cells.
    map_from_frame: Isometry3<f64>,
    /// Label of the cells with observed points of an object. A fast hash, because each of thousands of poses looks up
    /// hundreds of cells.
    cells: HashMap<[i32; 3], u16, RandomState>,
    /// The objects to grasp; `None` means all surfaces, also those of no object.
    wanted: Option<BTreeSet<u16>>,
}

/// Edge of a cell, metres: that of a voxel of VGN's volumes.
const CELL: f64 = 0.0075;

impl ObjectMap {
    /// A map from labelled points of the task frame. `frame_from_task` is its pose in the frame of the grasps. `wanted` is
    /// `None` if all surfaces are to be grasped.
    #[must_use]
    pub fn new(
        points: impl Iterator<Item = (Point3<f64>, u16)>,
        frame_from_task: &Isometry3<f64>,
        wanted: Option<BTreeSet<u16>>,
    ) -> Self {
        // Sorted, which needs less memory than a map of maps for a cloud of millions of points.
        let mut votes: Vec<([i32; 3], u16)> = points.map(|(point, label)| (cell(&point), label)).collect();
        votes.sort_unstable();
        let of_cell = |votes: &[([i32; 3], u16)]| {
            let most = votes.chunk_by(|(_, a), (_, b)| a == b).max_by_key(|same| same.len())?;
            most.first().copied().filter(|(_, label)| *label > 0)
        };
        let cells = votes.chunk_by(|(a, _), (b, _)| a == b).filter_map(of_cell).collect();
        Self { map_from_frame: frame_from_task.inverse(), cells, wanted }
    }

    /// A wanted object that was not observed.
    #[must_use]
    pub fn missing(&self) -> Option<u16> {
        let observed: BTreeSet<u16> = self.cells.values().copied().collect();
        self.wanted.iter().flatten().copied().find(|label| !observed.contains(label))
    }

    /// The object between the open fingers of a hand at `pose`: the one that fills the largest part of the space between
    /// them; `None` if there is none.
    #[must_use]
    pub fn object(&self, pose: &Isometry3<f64>, hand: &Hand) -> Option<u16> {
        /// Most steps between the points along an axis. It bounds the time for large hands; the Panda's has 11.
        const STEPS: f64 = 16.0;
        let steps = |length: f64| (length / CELL).ceil().clamp(1.0, STEPS);
        // In cells, because hundreds of points are looked up: where the first one is, and the steps along the axes.
        let map_from_hand = self.map_from_frame * pose;
        let first = Point3::new(-hand.height / 2.0, -hand.half_opening(), 0.0);
        let extent = Vector3::new(hand.height, 2.0 * hand.half_opening(), hand.depth);
        let count = extent.map(steps);
        let axes =
            map_from_hand.rotation.to_rotation_matrix() * Matrix3::from_diagonal(&extent.component_div(&count)) / CELL;
        let first = (map_from_hand * first).coords / CELL;
        let mut votes = BTreeMap::new();
        for x in 0..=count.x as u32 {
            for y in 0..=count.y as u32 {
                let line = first + axes * Vector3::new(f64::from(x), f64::from(y), 0.0);
                for z in 0..=count.z as u32 {
                    let cell: [i32; 3] = (line + axes.column(2) * f64::from(z)).map(floor).into();
                    if let Some(label) = self.cells.get(&cell) {
                        *votes.entry(*label).or_default() += 1;
                    }
                }
            }
        }
        most(votes)
    }

    /// Whether a grasp holds an object that is wanted.
    #[must_use]
    pub fn accepts(&self, pose: &Isometry3<f64>, hand: &Hand) -> bool {
        let Some(wanted) = &self.wanted else { return true };
        self.object(pose, hand).is_some_and(|object| wanted.contains(&object))
    }

    /// The grasps, best first, without those beyond the best `limit` of their object.
    #[must_use]
    pub fn limited(&self, grasps: Vec<Grasp>, hand: &Hand, limit: usize) -> Vec<Grasp> {
        if limit >= grasps.len() {
            return grasps;
        }
        let mut counts = BTreeMap::<Option<u16>, usize>::new();
        let mut is_within = |grasp: &Grasp| {
            let count = counts.entry(self.object(&grasp.pose, hand)).or_default();
            *count += 1;
            *count <= limit
        };
        grasps.into_iter().filter(|grasp| is_within(grasp)).collect()
    }
}

fn cell(point: &Point3<f64>) -> [i32; 3] {
    point.coords.map(|c| floor(c / CELL)).into()
}

/// The largest integer that is not larger; faster than a call of the C library. Saturates far outside of every workspace.
fn floor(value: f64) -> i32 {
    let truncated = value as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > value))
}

/// The label with the most votes, of several the largest.
fn most(votes: BTreeMap<u16, u32>) -> Option<u16> {
    votes.into_iter().max_by_key(|&(_, count)| count).map(|(label, _)| label)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// Two boxes of 4 cm on a table at z = 0.05, at x = 0.1 (label 3) and x = 0.2 (label 7), seen from above.
    fn points() -> impl Iterator<Item = (Point3<f64>, u16)> {
        let step = |c: usize| (c as f64 + 0.5) * 0.003;
        (0..100).flat_map(move |x| (0..100).map(move |y| (step(x), step(y)))).map(|(x, y)| {
            let on = |centre: f64| (x - centre).abs() < 0.02 && (y - 0.15).abs() < 0.02;
            let (z, label) = if on(0.1) {
                (0.09, 3)
            } else if on(0.2) {
                (0.09, 7)
            } else {
                (0.05, 0)
            };
            (Point3::new(x, y, z), label)
        })
    }

    fn over(x: f64, frame_from_task: &Isometry3<f64>) -> Isometry3<f64> {
        frame_from_task * Isometry3::new(Vector3::new(x, 0.15, 0.12), Vector3::x() * PI)
    }

    #[test]
    fn a_grasp_is_on_the_object_between_its_fingers() {
        let frame_from_task = Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.0, 0.0, 0.7));
        let map = ObjectMap::new(points(), &frame_from_task, None);
        let object = |x| map.object(&over(x, &frame_from_task), &Hand::PANDA);
        assert_eq!([0.1, 0.2, 0.15].map(object), [Some(3), Some(7), None]);
        assert!(map.accepts(&over(0.15, &frame_from_task), &Hand::PANDA), "all grasps are wanted");

        let map = ObjectMap::new(points(), &frame_from_task, Some([7].into()));
        let admits = |x| map.accepts(&over(x, &frame_from_task), &Hand::PANDA);
        assert_eq!([0.1, 0.2, 0.15].map(admits), [false, true, false]);
        assert_eq!(map.missing(), None);
        assert_eq!(ObjectMap::new(points(), &frame_from_task, Some([7, 9].into())).missing(), Some(9));
    }

    #[test]
    fn each_object_keeps_its_best_grasps() {
        let frame = Isometry3::identity();
        let map = ObjectMap::new(points(), &frame, None);
        let grasp = |x, quality| Grasp { pose: over(x, &frame), width: 0.04, quality };
        let grasps = vec![grasp(0.1, 0.9), grasp(0.1, 0.8), grasp(0.2, 0.7), grasp(0.1, 0.6), grasp(0.2, 0.5)];
        let qualities: Vec<f32> = map.limited(grasps, &Hand::PANDA, 1).iter().map(|grasp| grasp.quality).collect();
        assert_eq!(qualities, [0.9, 0.7]);
    }
}
