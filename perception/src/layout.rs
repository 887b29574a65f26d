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
    /// Smallest sensible distance of the inner part from the sides of its cube, metres. An object that a side cuts looks like a thinner
    /// one: of grasps within 5 cm of a side, more than half were bad.
    pub const MARGIN: f64 = 0.05;

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

/// The fewest evenly spaced intervals of `size` whose inner parts cover those from 0 to `extent`.
fn intervals(extent: f64, size: f64, margin: f64) -> Vec<Interval> {
    let count = count(extent, size, margin);
    let part = extent / count;
    let interval = |index: u32| {
        let inner = [f64::from(index), f64::from(index + 1)].map(|i| i * part);
        Interval { corner: (inner[0] + inner[1] - size) / 2.0, inner }
    };
    (0..count as u32).map(interval).collect()
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
}
