use std::collections::{BTreeMap, BTreeSet};

use crate::segmentation::Object;

/// Distance of objects from the sides of their cube, metres.
pub(crate) const OBJECT_MARGIN: f64 = 0.05;

/// One of the cubes that cover a workspace which is larger than a network's volume. Lengths in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Part {
    /// x and y of the cube's corner in the frame of the workspace.
    pub corner: [f64; 2],
    /// The part of the workspace whose grasps come from this cube: smallest and largest x and y. The parts of all cubes
    /// cover the workspace and do not overlap.
    pub inner: [[f64; 2]; 2],
}

impl Part {
    /// Smallest sensible distance of the inner part from the sides of its cube, metres. An object that a side cuts
    /// looks like a thinner one: of grasps within 5 cm of a side, more than half were bad.
    pub const MARGIN: f64 = OBJECT_MARGIN;

    /// The number of cubes that [`cover`](Self::cover) returns. It is not an integer type, because it may be huge if
    /// `margin` is almost half of `size`.
    #[must_use]
    pub fn count(extent: [f64; 2], size: f64, margin: f64) -> f64 {
        extent.map(|extent| count(extent, size, margin)).iter().product()
    }

    /// The cubes with an edge of `size` that cover a workspace from (0, 0) to `extent`. Their inner parts are at least
    /// `margin` from their sides, so the outer cubes extend beyond the workspace. `margin` is less than half of `size`.
    #[must_use]
    pub fn cover(extent: [f64; 2], size: f64, margin: f64) -> Vec<Part> {
        let [along_x, along_y] = extent.map(|extent| intervals(extent, size, margin));
        let part = |x: &Interval, y: &Interval| Part {
            corner: [x.corner, y.corner],
            inner: [[x.inner[0], y.inner[0]], [x.inner[1], y.inner[1]]],
        };
        along_x.iter().flat_map(|x| along_y.iter().map(move |y| part(x, y))).collect()
    }
}

struct Interval {
    corner: f64,
    inner: [f64; 2],
}

/// The number of [`intervals`].
fn count(extent: f64, size: f64, margin: f64) -> f64 {
    let length = size - 2.0 * margin;
    // The tolerance keeps an extent of exactly n parts from needing n + 1.
    (extent / length - 1e-9).ceil().max(1.0)
}

/// The fewest evenly spaced intervals of `size` whose inner parts cover the interval from 0 to `extent`.
fn intervals(extent: f64, size: f64, margin: f64) -> Vec<Interval> {
    let count = count(extent, size, margin);
    let part = extent / count;
    let interval = |index: u32| {
        let inner = [f64::from(index), f64::from(index + 1)].map(|i| i * part);
        Interval { corner: (inner[0] + inner[1] - size) / 2.0, inner }
    };
    (0..count as u32).map(interval).collect()
}

/// Covers the objects on a table, with a margin around them, with about the fewest cubes with an edge of `size`.
/// Returns the corners of at most `limit` cubes, the most valuable first, and the number of objects of which no part is
/// in a cube. Lengths in metres.
///
/// Objects that are too large for one cube are divided among several.
pub(crate) fn cover_objects(objects: &[Object], size: f64, margin: f64, limit: usize) -> (Vec<[f64; 2]>, usize) {
    let length = size - 2.0 * margin;
    let mut open: Vec<(usize, Unit)> = objects
        .iter()
        .enumerate()
        .flat_map(|(index, object)| units(object, length).map(move |unit| (index, unit)))
        .collect();
    open.sort_by(|(_, a), (_, b)| b.weight.total_cmp(&a.weight));
    open.truncate(MAX_UNITS);
    let mut corners = Vec::new();
    let mut left_out: BTreeSet<usize> = (0..objects.len()).collect();
    while corners.len() < limit {
        // The best square can be moved until units touch its lower sides.
        let lowest = open.iter().flat_map(|(_, a)| open.iter().map(|(_, b)| [a.low[0], b.low[1]]));
        let held = |low: &[f64; 2]| {
            open.iter().filter(|(_, unit)| unit.is_in(low, length)).map(|(_, unit)| unit.weight).sum::<f64>()
        };
        let Some(best) = lowest.map(|low| (held(&low), low)).max_by(|(a, _), (b, _)| a.total_cmp(b)) else { break };
        let (_, low) = best;
        let (inside, outside): (Vec<_>, Vec<_>) = open.into_iter().partition(|(_, unit)| unit.is_in(&low, length));
        open = outside;
        left_out.retain(|object| !inside.iter().any(|(of, _)| of == object));
        let middle = |axis: usize| {
            let low = inside.iter().map(|(_, unit)| unit.low[axis]).fold(f64::INFINITY, f64::min);
            let high = inside.iter().map(|(_, unit)| unit.high[axis]).fold(f64::NEG_INFINITY, f64::max);
            (low + high) / 2.0
        };
        corners.push([middle(0) - size / 2.0, middle(1) - size / 2.0]);
    }
    (corners, left_out.len())
}

/// Maximum number of parts that are distributed among cubes, which bounds the time.
const MAX_UNITS: usize = 128;

/// Edge of the parts of large objects, metres.
const UNIT: f64 = 0.05;

/// A part of the table that one cube holds.
struct Unit {
    low: [f64; 2],
    high: [f64; 2],
    weight: f64,
}

impl Unit {
    fn is_in(&self, low: &[f64; 2], length: f64) -> bool {
        (0..2).all(|axis| self.low[axis] >= low[axis] - 1e-9 && self.high[axis] <= low[axis] + length + 1e-9)
    }
}

/// An object as one part, or those of its parts that have points.
fn units(object: &Object, length: f64) -> impl Iterator<Item = Unit> {
    let unit = |points: &mut dyn Iterator<Item = &([f64; 2], f64)>| {
        let empty = Unit { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2], weight: 0.0 };
        points.fold(empty, |unit, (at, weight)| Unit {
            low: [0, 1].map(|axis| unit.low[axis].min(at[axis])),
            high: [0, 1].map(|axis| unit.high[axis].max(at[axis])),
            weight: unit.weight + weight,
        })
    };
    let whole = unit(&mut object.points.iter());
    if (0..2).all(|axis| whole.high[axis] - whole.low[axis] <= length) {
        return vec![whole].into_iter();
    }
    let edge = UNIT.min(length);
    let cell = |at: &[f64; 2]| at.map(|c| (c / edge).floor() as i64);
    let mut cells: BTreeMap<[i64; 2], Vec<&([f64; 2], f64)>> = BTreeMap::new();
    object.points.iter().for_each(|point| cells.entry(cell(&point.0)).or_default().push(point));
    cells.values().map(|points| unit(&mut points.iter().copied())).collect::<Vec<_>>().into_iter()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_inner_parts_cover_the_workspace_once_and_keep_the_margin() {
        for extent in [[0.9, 0.6], [0.3, 0.3], [0.2, 2.0], [0.05, 0.41]] {
            let parts = Part::cover(extent, 0.3, Part::MARGIN);
            let area: f64 =
                parts.iter().map(|Part { inner: [low, high], .. }| (high[0] - low[0]) * (high[1] - low[1])).sum();
            assert!((area - extent[0] * extent[1]).abs() < 1e-9, "{extent:?}");
            for Part { corner, inner: [low, high] } in &parts {
                for axis in 0..2 {
                    assert!(low[axis] >= -1e-12 && high[axis] <= extent[axis] + 1e-12);
                    assert!(low[axis] - corner[axis] >= Part::MARGIN - 1e-9);
                    assert!(corner[axis] + 0.3 - high[axis] >= Part::MARGIN - 1e-9);
                }
            }
        }
        assert_eq!(Part::cover([0.9, 0.6], 0.3, Part::MARGIN).len(), 15);
        assert_eq!(Part::cover([0.2, 0.2], 0.3, Part::MARGIN).len(), 1);
        assert_eq!(Part::count([0.9, 0.6], 0.3, Part::MARGIN), 15.0);
        assert!(Part::count([2.0, 2.0], 0.1001, Part::MARGIN) > 1e8);
    }

    /// An object of `size` metres with its lower corner at `low`.
    fn object(low: [f64; 2], size: [f64; 2]) -> Object {
        let steps = |length: f64| (0..=(length / 0.01).round() as usize).map(|step| step as f64 * 0.01);
        let points = steps(size[0]).flat_map(|x| steps(size[1]).map(move |y| ([low[0] + x, low[1] + y], 1e-4)));
        Object { points: points.collect() }
    }

    fn holds(corner: &[f64; 2], object: &Object) -> bool {
        let is_in = |at: &[f64; 2]| (0..2).all(|axis| (0.049..0.251).contains(&(at[axis] - corner[axis])));
        object.points.iter().all(|(at, _)| is_in(at))
    }

    #[test]
    fn objects_are_held_by_few_cubes_that_keep_the_margin() {
        let near = [object([0.0, 0.0], [0.05, 0.05]), object([0.1, 0.08], [0.06, 0.1])];
        let far = [object([0.5, 0.0], [0.05, 0.05]), object([-0.4, 0.3], [0.18, 0.02])];
        let objects = [near, far].concat();
        let (corners, left_out) = cover_objects(&objects, 0.3, OBJECT_MARGIN, 12);
        assert_eq!((corners.len(), left_out), (3, 0), "{corners:?}");
        for object in &objects {
            assert!(corners.iter().any(|corner| holds(corner, object)), "{corners:?}");
        }
        // The most valuable first.
        let (corners, left_out) = cover_objects(&objects, 0.3, OBJECT_MARGIN, 1);
        assert!(left_out == 2 && holds(&corners[0], &objects[0]) && holds(&corners[0], &objects[1]));
        assert_eq!(cover_objects(&[], 0.3, OBJECT_MARGIN, 12), (vec![], 0));
    }

    #[test]
    fn a_large_object_is_divided_among_cubes() {
        let pile = [object([0.0, 0.0], [0.5, 0.3])];
        let (corners, left_out) = cover_objects(&pile, 0.3, OBJECT_MARGIN, 12);
        assert!(left_out == 0 && (6..=9).contains(&corners.len()), "{corners:?}");
        for (at, _) in &pile[0].points {
            let point = Object { points: vec![(*at, 1.0)] };
            assert!(corners.iter().any(|corner| holds(corner, &point)), "{at:?}: {corners:?}");
        }
    }
}
