//! The sampled pixels of an image, and the connected parts of them.

use grasp::DepthImage;
use nalgebra::{Isometry3, Point3, Vector3};

use super::hull::Hull;
use super::walls::WALL_TOLERANCE;
use super::{OVERHANG, Object};

/// Pixels are sampled down to about this number.
const PIXELS: f64 = 80_000.0;

/// Heights above the table of what stands on it, metres.
const LOWEST: f64 = 0.006;
const HIGHEST: f64 = 0.45;

/// Noise of a depth at 1 m, metres; it grows with the square of the depth.
pub(super) const NOISE: f64 = 0.004;

/// Neighbouring pixels are on one surface if their depths differ by less than this many pixel widths plus [`STEP`]
/// metres: on a surface at 80° to the image the depth changes by six widths.
const SLOPE: f64 = 6.0;
pub(super) const STEP: f64 = 0.002;

/// Smallest visible area, m², number of pixels, and height of an object, metres. What is smaller is noise.
const AREA: f64 = 3e-4;
const FEWEST: usize = 15;
const HEIGHT: f64 = 0.01;

/// Parts of the table in the image that are smaller than this share of its largest part may be something else.
const TABLE_PART: f64 = 0.05;

/// Things this near to other things in the image, metres, are beside them.
const BESIDE_OTHERS: f64 = 0.02;

/// A thing with this many neighbouring pixels below the table is not on the table.
const HANGING: usize = 10;

/// Largest number of pixels at which a thing continues beside the table, divided by the square root of its number of
/// pixels. With more it is part of something that does not stand on the table.
const EDGE: f64 = 1.5;

/// Largest share of a thing that is not over the visible part of the table.
const BESIDE: f64 = 0.7;

/// Width of the border of the image, as a fraction of the image: things that reach into it count as cut off. Depths
/// that are registered to a colour image often end before its border.
const BORDER: f64 = 0.0125;

/// Standard deviation of the weight of pixels around the middle, as a fraction of half the diagonal.
const MIDDLE: f64 = 0.45;

/// Sampled pixels of an image.
pub(super) struct Grid {
    pub width: usize,
    pub step: usize,
    /// With depth; in the camera frame, metres.
    pub points: Vec<Option<Point3<f64>>>,
    /// In the frame of the table: z is the height above it, metres.
    pub on_table: Vec<Point3<f64>>,
    /// Width of a pixel at a depth of 1 m, metres.
    pixel: f64,
    /// The visible part of the table.
    table: Hull,
    /// Columns and rows that are not at the border of the image.
    inner: [std::ops::Range<usize>; 2],
}

impl Grid {
    pub fn new(image: &DepthImage, camera_from_table: &Isometry3<f64>) -> Self {
        let camera = image.intrinsics();
        let step = ((image.depth().len() as f64 / PIXELS).sqrt().round() as usize).max(1);
        let [width, height] = [camera.width, camera.height].map(|edge| edge.div_ceil(step));
        let table_from_camera = camera_from_table.inverse();
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| (u * step, v * step)));
        let points: Vec<_> = pixels.map(|(u, v)| image.point(u, v)).collect();
        let far = Point3::new(0.0, 0.0, f64::INFINITY);
        let on_table = points.iter().map(|point| point.map_or(far, |point| table_from_camera * point)).collect();
        let inner = [width, height].map(|edge| {
            let border = ((BORDER * edge as f64) as usize).max(1);
            border..edge.saturating_sub(border)
        });
        let table = Hull::default();
        let grid = Self { width, step, points, on_table, pixel: step as f64 / camera.fx, table, inner };
        Self { table: grid.visible_table(), ..grid }
    }

    /// Whether the height of a pixel is that of something on the table.
    pub fn is_above_table(&self, index: usize) -> bool {
        let heights = |point: Point3<f64>| LOWEST + NOISE * point.z * point.z..HIGHEST;
        self.points[index].is_some_and(|point| heights(point).contains(&self.on_table[index].z))
    }

    /// Whether a pixel is over the visible part of the table, or at most `margin` beside it, metres.
    pub fn is_over_table(&self, index: usize, margin: f64) -> bool {
        let at = &self.on_table[index];
        self.table.contains([at.x, at.y], margin)
    }

    /// The visible part of the table: the hull of its large parts.
    fn visible_table(&self) -> Hull {
        let is_on = |&index: &usize| {
            let depth = self.points[index].map_or(0.0, |point| point.z);
            self.on_table[index].z.abs() <= LOWEST + NOISE * depth * depth
        };
        let mut parts = self.connected((0..self.points.len()).filter(is_on).collect());
        let largest = parts.first().map_or(0, Vec::len);
        parts.retain(|part| part.len() as f64 >= TABLE_PART * largest as f64);
        Hull::new(parts.iter().flatten().map(|&index| [self.on_table[index].x, self.on_table[index].y]).collect())
    }

    /// The neighbours of a pixel to the right and below, and with `all` also to the left and above.
    fn neighbours(&self, index: usize, all: bool) -> impl Iterator<Item = usize> {
        let (u, width, count) = (index % self.width, self.width, self.points.len());
        let right = (u + 1 < width).then(|| index + 1);
        let below = (index + width < count).then(|| index + width);
        let diagonal = [(u + 1 < width).then(|| index + width + 1), (u > 0).then(|| index + width - 1)];
        let left = (all && u > 0).then(|| index - 1);
        let above = (all && index >= width).then(|| index - width);
        [right, below, left, above].into_iter().chain(diagonal).flatten().filter(move |index| *index < count)
    }

    /// Whether two neighbouring pixels show the same surface.
    fn are_connected(&self, a: usize, b: usize) -> bool {
        let (Some(a), Some(b)) = (&self.points[a], &self.points[b]) else { return false };
        (a.z - b.z).abs() < SLOPE * self.pixel * a.z.min(b.z) + STEP
    }

    /// The connected parts of a set of pixels, largest first.
    fn connected(&self, pixels: Vec<usize>) -> Vec<Vec<usize>> {
        const NONE: usize = usize::MAX;
        let mut part_of = vec![NONE; self.points.len()];
        let mut is_open = vec![false; self.points.len()];
        pixels.iter().for_each(|&index| is_open[index] = true);
        // Each pixel points to another of its part, the first one to itself.
        let mut parents: Vec<usize> = Vec::new();
        fn root(parents: &mut [usize], mut part: usize) -> usize {
            while parents[part] != part {
                parents[part] = parents[parents[part]];
                part = parents[part];
            }
            part
        }
        for &index in &pixels {
            if part_of[index] == NONE {
                part_of[index] = parents.len();
                parents.push(parents.len());
            }
            for neighbour in self.neighbours(index, false) {
                if !is_open[neighbour] || !self.are_connected(index, neighbour) {
                    continue;
                }
                let own = root(&mut parents, part_of[index]);
                if part_of[neighbour] == NONE {
                    part_of[neighbour] = own;
                } else {
                    let other = root(&mut parents, part_of[neighbour]);
                    parents[own.max(other)] = own.min(other);
                }
            }
        }
        let mut parts: Vec<Vec<usize>> = vec![Vec::new(); parents.len()];
        for index in pixels {
            parts[root(&mut parents, part_of[index])].push(index);
        }
        parts.sort_by_key(|part| std::cmp::Reverse(part.len()));
        parts
    }

    /// The connected parts of a set of pixels that are large enough for an object.
    pub fn things(&self, pixels: Vec<usize>) -> Vec<Vec<usize>> {
        let mut parts = self.connected(pixels);
        parts.retain(|part| part.len() >= FEWEST && self.area(part) >= AREA && self.height(part) >= HEIGHT);
        parts
    }

    /// Visible area of a pixel, m², as if it faced the camera.
    pub fn area_of(&self, index: usize) -> f64 {
        self.points[index].map_or(0.0, |point| (self.pixel * point.z).powi(2))
    }

    pub fn area(&self, pixels: &[usize]) -> f64 {
        pixels.iter().map(|&index| self.area_of(index)).sum()
    }

    /// Height above the table that 90 % of the pixels do not exceed, metres.
    fn height(&self, pixels: &[usize]) -> f64 {
        let mut heights: Vec<f64> = pixels.iter().map(|&index| self.on_table[index].z).collect();
        let index = heights.len() * 9 / 10;
        *heights.select_nth_unstable_by(index, f64::total_cmp).1
    }

    /// Largest edge of the box around pixels, metres.
    pub fn length(&self, pixels: &[usize]) -> f64 {
        let [low, high] = bounds(pixels.iter().map(|&index| self.on_table[index].coords));
        (high - low).max()
    }

    /// Whether a thing is on the table, and not cut off by the border of the image.
    pub fn is_whole(&self, pixels: &[usize]) -> bool {
        let is_inside = |&index: &usize| {
            let at = [index % self.width, index / self.width];
            self.inner.iter().zip(at).all(|(inner, at)| inner.contains(&at))
        };
        let is_below = |&index: &usize| {
            let depth = self.points[index].map_or(0.0, |point| point.z);
            self.on_table[index].z < -(0.015 + NOISE * depth * depth)
        };
        let below = pixels.iter().flat_map(|&index| {
            self.neighbours(index, true).filter(move |&other| self.are_connected(index, other)).filter(is_below)
        });
        // A rim continues beside the table.
        let goes_on = |&index: &usize| {
            self.neighbours(index, true).any(|other| {
                self.is_above_table(other) && !self.is_over_table(other, OVERHANG) && self.are_connected(index, other)
            })
        };
        let edge = pixels.iter().copied().filter(goes_on).count() as f64;
        let beside = pixels.iter().filter(|index| !self.is_over_table(**index, -WALL_TOLERANCE)).count() as f64;
        let count = pixels.len() as f64;
        pixels.iter().all(is_inside)
            && below.take(HANGING).count() < HANGING
            && edge <= EDGE * count.sqrt()
            && beside <= BESIDE * count
    }

    /// Whether a thing is beside pixels of other things in the image.
    pub fn is_near(&self, thing: &[usize], is_other: &[bool]) -> bool {
        let (width, height) = (self.width as isize, (self.points.len() / self.width) as isize);
        thing.iter().any(|&index| {
            let depth = self.points[index].map_or(f64::INFINITY, |point| point.z);
            let reach = ((BESIDE_OTHERS / (self.pixel * depth)) as isize).min(40);
            let (u, v) = ((index % self.width) as isize, (index / self.width) as isize);
            let directions = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)];
            directions
                .iter()
                .flat_map(|(x, y)| (1..=reach).map(move |step| (u + x * step, v + y * step)))
                .any(|(u, v)| (0..width).contains(&u) && (0..height).contains(&v) && is_other[(v * width + u) as usize])
        })
    }

    pub fn object(&self, pixels: &[usize]) -> Object {
        let rows = self.points.len() / self.width;
        let half = [self.width, rows].map(|edge| edge as f64 / 2.0);
        let radius = MIDDLE * half[0].hypot(half[1]);
        let point = |&index: &usize| {
            let (u, v) = ((index % self.width) as f64, (index / self.width) as f64);
            let from_middle = (u - half[0]).hypot(v - half[1]) / radius;
            let at = &self.on_table[index];
            ([at.x, at.y], self.area_of(index) * (-0.5 * from_middle * from_middle).exp())
        };
        Object { points: pixels.iter().map(point).collect() }
    }
}

/// The corners of the box around points.
pub(super) fn bounds(points: impl Iterator<Item = Vector3<f64>>) -> [Vector3<f64>; 2] {
    let empty = [Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)];
    points.fold(empty, |[low, high], at| [low.inf(&at), high.sup(&at)])
}
