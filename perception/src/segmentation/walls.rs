//! The walls and rims of bins.

use std::collections::HashSet;

use nalgebra::{Unit, Vector3};

use super::grid::{Grid, bounds};

/// Smallest length, metres, and visible area, m², of a wall or rim.
const WALL_LENGTH: f64 = 0.35;
const WALL_AREA: f64 = 0.006;

/// Distance of points from the plane of their wall, metres.
pub(super) const WALL_TOLERANCE: f64 = 0.01;

/// Maximum number of walls and rims that are taken off one thing.
const WALLS: usize = 6;

/// About this many pixels propose a wall.
const PROPOSALS: usize = 150;

impl Grid {
    /// Takes the walls and rims of bins off a thing. Returns them and the rest.
    pub fn without_walls(&self, mut rest: Vec<usize>) -> (Vec<Vec<usize>>, Vec<usize>) {
        let mut walls = Vec::new();
        while walls.len() < WALLS {
            let Some((normal, offset)) = self.largest_wall(&rest) else { break };
            let is_on = |index: &usize| {
                self.points[*index].is_some_and(|point| (normal.dot(&point.coords) - offset).abs() <= WALL_TOLERANCE)
            };
            let (wall, others): (Vec<_>, Vec<_>) = rest.into_iter().partition(is_on);
            walls.push(wall);
            rest = others;
        }
        (walls, rest)
    }

    /// The plane with the largest visible area of those that are as long as a wall.
    fn largest_wall(&self, pixels: &[usize]) -> Option<(Unit<Vector3<f64>>, f64)> {
        let baseline = (self.width / 30).max(2);
        let own: HashSet<usize> = pixels.iter().copied().collect();
        let at = |index: usize| own.contains(&index).then(|| self.points[index])?;
        let plane = |&index: &usize| {
            let corner = at(index)?.coords;
            let right = at(index + baseline).or_else(|| at(index.checked_sub(baseline)?))?.coords;
            let rows = baseline * self.width;
            let below = at(index + rows).or_else(|| at(index.checked_sub(rows)?))?.coords;
            let normal = Unit::try_new((right - corner).cross(&(below - corner)), 1e-12)?;
            Some((normal, normal.dot(&corner)))
        };
        let sampled: Vec<usize> = pixels.iter().copied().step_by(pixels.len().div_ceil(2000).max(1)).collect();
        let share = pixels.len() as f64 / sampled.len().max(1) as f64;
        let scored = pixels.iter().step_by(pixels.len().div_ceil(PROPOSALS).max(1)).filter_map(plane).map(|plane| {
            let (normal, offset) = plane;
            let is_on = |index: &&usize| {
                self.points[**index].is_some_and(|point| (normal.dot(&point.coords) - offset).abs() <= WALL_TOLERANCE)
            };
            let inliers = || sampled.iter().filter(is_on);
            let area = share * inliers().map(|&index| self.area_of(index)).sum::<f64>();
            // Walls and rims are around the visible part of the table.
            let beside = inliers().filter(|index| !self.is_over_table(**index, -WALL_TOLERANCE)).count();
            let area = if 2 * beside > inliers().count() { area } else { 0.0 };
            let [low, high] = bounds(inliers().map(|&index| self.on_table[index].coords));
            (area, (high - low).max(), plane)
        });
        let walls = scored.filter(|(area, length, _)| *area >= WALL_AREA && *length >= WALL_LENGTH);
        walls.max_by(|(a, ..), (b, ..)| a.total_cmp(b)).map(|(.., plane)| plane)
    }
}
