//! What stands on a table, divided into objects.

use std::collections::{BTreeSet, HashSet};

use grasp::DepthImage;
use nalgebra::{Isometry3, Point3, Unit, Vector3};

/// What stands on the table in a depth image. Objects that touch each other may be one.
#[derive(Clone, Debug)]
pub(crate) struct Segmentation {
    /// Objects that a hand may lift; the label of the first is 1.
    pub objects: Vec<Object>,
    /// Label of each sampled pixel, row by row: 0 is no object, and labels after those of the objects are other things: what
    /// the image cuts off, walls and rims of bins, and what hangs over the edge of the table.
    labels: Vec<u16>,
    /// Distance between sampled pixels.
    step: usize,
}

/// An object on a table.
#[derive(Clone, Debug)]
pub(crate) struct Object {
    /// Its points along the table, metres, with the weight of each: the area that the pixel shows, less for pixels that
    /// are far from the middle of the image.
    pub points: Vec<([f64; 2], f64)>,
}

/// Pixels are sampled down to about this number.
const PIXELS: f64 = 80_000.0;

/// Heights above the table of what stands on it, metres.
const LOWEST: f64 = 0.006;
const HIGHEST: f64 = 0.45;

/// Noise of a depth at 1 m, metres; it grows with the square of the depth.
const NOISE: f64 = 0.004;

/// Neighbouring pixels are of one surface if their depths differ by less than this many pixels' widths, and [`STEP`]
/// metres: on a surface at 80° to the image the depth changes by six widths.
const SLOPE: f64 = 6.0;
const STEP: f64 = 0.002;

/// Smallest visible area, m², number of pixels, and height of an object, metres. What is smaller is noise.
const AREA: f64 = 3e-4;
const FEWEST: usize = 15;
const HEIGHT: f64 = 0.01;

/// A thing with a smaller visible area, m², this near to other things in the image, metres, is a fragment of them: depth cameras
/// have holes at edges.
const FRAGMENT: f64 = 6e-4;
const BESIDE_OTHERS: f64 = 0.02;

/// Things longer than this, metres, may be a bin with objects that touch its walls.
const LONGEST: f64 = 0.5;

/// Smallest length, metres, and visible area, m², of a wall or rim.
const WALL_LENGTH: f64 = 0.35;
const WALL_AREA: f64 = 0.006;

/// Distance of points from the plane of their wall, metres.
const WALL_TOLERANCE: f64 = 0.01;

/// Most walls and rims that are taken off one thing.
const WALLS: usize = 6;

/// Parts of the table in the image that are smaller than this share of its largest part may be something else.
const TABLE_PART: f64 = 0.05;

/// Distance from the hull of the visible table within which things stand on it, metres.
const OVERHANG: f64 = 0.03;

/// Pixels that propose a wall, about.
const PROPOSALS: usize = 150;

/// Number of neighbouring pixels below the table with which a thing is not on the table.
const HANGING: usize = 10;

/// Number of pixels at which a thing goes on beside the table, divided by the root of its number of pixels, with which it is
/// part of something that does not stand on the table.
const EDGE: f64 = 1.5;

/// Largest share of a thing that is not over the visible part of the table.
const BESIDE: f64 = 0.7;

/// Width of the border of the image whose things are cut off, as a fraction of the image. Depths that are registered to a
/// colour image often end before its border.
const BORDER: f64 = 0.0125;

/// Standard deviation of the weight of pixels around the middle, as a fraction of half of the diagonal.
const MIDDLE: f64 = 0.45;

/// Sampled pixels of an image.
struct Grid {
    width: usize,
    step: usize,
    /// With depth; in the camera frame, metres.
    points: Vec<Option<Point3<f64>>>,
    /// In the frame of the table: z is the height above it, metres.
    on_table: Vec<Point3<f64>>,
    /// Width of a pixel at a depth of 1 m, metres.
    pixel: f64,
    /// The visible part of the table.
    table: Hull,
    /// Columns and rows that are not at the border of the image.
    inner: [std::ops::Range<usize>; 2],
}

impl Segmentation {
    /// Divides what stands on the table in an image. `camera_from_table` is the pose of a frame whose plane z = 0 is the
    /// table.
    pub fn of(image: &DepthImage, camera_from_table: &Isometry3<f64>) -> Self {
        let grid = Grid::of(image, camera_from_table);
        let stands = |index: &usize| grid.is_above_table(*index) && grid.is_over_table(*index, OVERHANG);
        let mut objects: Vec<Vec<usize>> = Vec::new();
        let mut others: Vec<Vec<usize>> = Vec::new();
        for thing in grid.things((0..grid.points.len()).filter(stands).collect()) {
            if grid.length(&thing) <= LONGEST {
                if grid.is_whole(&thing) {
                    objects.push(thing)
                } else {
                    others.push(thing)
                };
                continue;
            }
            let (walls, rest) = grid.without_walls(thing);
            others.extend(walls);
            let (whole, cut): (Vec<_>, Vec<_>) = grid.things(rest).into_iter().partition(|part| grid.is_whole(part));
            objects.extend(whole);
            others.extend(cut);
        }
        let mut is_other = vec![false; grid.points.len()];
        others.iter().flatten().for_each(|&index| is_other[index] = true);
        let (objects, fragments): (Vec<_>, Vec<_>) =
            objects.into_iter().partition(|thing| grid.area(thing) >= FRAGMENT || !grid.is_near(thing, &is_other));
        others.extend(fragments);
        let mut labels = vec![0; grid.points.len()];
        for (pixels, label) in objects.iter().chain(&others).zip(1..=u16::MAX) {
            pixels.iter().for_each(|&index| labels[index] = label);
        }
        let objects = objects.iter().map(|pixels| grid.object(pixels)).collect();
        Self { objects, labels, step: grid.step }
    }

    /// The objects in a frame whose axes are those of the table, moved by `offset` metres.
    pub fn moved(mut self, offset: [f64; 2]) -> Self {
        let points = self.objects.iter_mut().flat_map(|object| &mut object.points);
        points.for_each(|(at, _)| *at = [at[0] + offset[0], at[1] + offset[1]]);
        self
    }

    /// The labels of the objects.
    pub fn labels_of_objects(&self) -> BTreeSet<u16> {
        (1..=u16::MAX).take(self.objects.len()).collect()
    }

    /// The label of each pixel of the image, row by row.
    pub fn labels(&self, image: &DepthImage) -> Vec<u16> {
        let (width, depth) = (image.intrinsics().width, image.depth());
        let columns = width.div_ceil(self.step);
        let label = |(index, &own): (usize, &f32)| {
            let (u, v) = (index % width / self.step, index / width / self.step);
            let sampled = depth[v * self.step * width + u * self.step];
            // A pixel between two samples belongs to the first if it is on the same surface.
            let is_same = (own - sampled).abs() as f64 <= STEP + NOISE * f64::from(own);
            if is_same { self.labels[v * columns + u] } else { 0 }
        };
        depth.iter().enumerate().map(label).collect()
    }
}

impl Grid {
    fn of(image: &DepthImage, camera_from_table: &Isometry3<f64>) -> Self {
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
        let table = Hull(Vec::new());
        let grid = Self { width, step, points, on_table, pixel: step as f64 / camera.fx, table, inner };
        Self { table: grid.visible_table(), ..grid }
    }

    /// Whether the height of a pixel is that of something on the table.
    fn is_above_table(&self, index: usize) -> bool {
        let heights = |point: Point3<f64>| LOWEST + NOISE * point.z * point.z..HIGHEST;
        self.points[index].is_some_and(|point| heights(point).contains(&self.on_table[index].z))
    }

    /// Whether a pixel is over the visible part of the table, or at most `margin` beside it, metres.
    fn is_over_table(&self, index: usize, margin: f64) -> bool {
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
        Hull::of(parts.iter().flatten().map(|&index| [self.on_table[index].x, self.on_table[index].y]).collect())
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

    /// Whether two neighbouring pixels show one surface.
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
    fn things(&self, pixels: Vec<usize>) -> Vec<Vec<usize>> {
        let mut parts = self.connected(pixels);
        parts.retain(|part| part.len() >= FEWEST && self.area(part) >= AREA && self.height(part) >= HEIGHT);
        parts
    }

    /// Visible area of a pixel, m², as if it faced the camera.
    fn area_of(&self, index: usize) -> f64 {
        self.points[index].map_or(0.0, |point| (self.pixel * point.z).powi(2))
    }

    fn area(&self, pixels: &[usize]) -> f64 {
        pixels.iter().map(|&index| self.area_of(index)).sum()
    }

    /// Height above the table that 90 % of the pixels do not exceed, metres.
    fn height(&self, pixels: &[usize]) -> f64 {
        let mut heights: Vec<f64> = pixels.iter().map(|&index| self.on_table[index].z).collect();
        let index = heights.len() * 9 / 10;
        *heights.select_nth_unstable_by(index, f64::total_cmp).1
    }

    /// Largest edge of the box around pixels, metres.
    fn length(&self, pixels: &[usize]) -> f64 {
        let [low, high] = bounds(pixels.iter().map(|&index| self.on_table[index].coords));
        (high - low).max()
    }

    /// Whether a thing is on the table, and not cut off by the border of the image.
    fn is_whole(&self, pixels: &[usize]) -> bool {
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
        // A rim goes on beside the table.
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
    fn is_near(&self, thing: &[usize], is_other: &[bool]) -> bool {
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

    /// Takes the walls and rims of bins off a thing. Returns them and the rest.
    fn without_walls(&self, mut rest: Vec<usize>) -> (Vec<Vec<usize>>, Vec<usize>) {
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
            // Walls and rims are around what is visible of the table.
            let beside = inliers().filter(|index| !self.is_over_table(**index, -WALL_TOLERANCE)).count();
            let area = if 2 * beside > inliers().count() { area } else { 0.0 };
            let [low, high] = bounds(inliers().map(|&index| self.on_table[index].coords));
            (area, (high - low).max(), plane)
        });
        let walls = scored.filter(|(area, length, _)| *area >= WALL_AREA && *length >= WALL_LENGTH);
        walls.max_by(|(a, ..), (b, ..)| a.total_cmp(b)).map(|(.., plane)| plane)
    }

    fn object(&self, pixels: &[usize]) -> Object {
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

/// The convex hull of points on the table, counterclockwise.
struct Hull(Vec<[f64; 2]>);

impl Hull {
    fn of(mut points: Vec<[f64; 2]>) -> Self {
        points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        let half = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
            let mut hull: Vec<[f64; 2]> = Vec::new();
            for point in points {
                while let [.., a, b] = hull[..]
                    && left_of(a, b, *point) <= 0.0
                {
                    hull.pop();
                }
                hull.push(*point);
            }
            hull.pop();
            hull
        };
        let (lower, upper) = (half(&mut points.iter()), half(&mut points.iter().rev()));
        Self([lower, upper].concat())
    }

    /// Whether a point is in the hull, or at most `margin` outside.
    fn contains(&self, point: [f64; 2], margin: f64) -> bool {
        let next = self.0.iter().cycle().skip(1);
        self.0.iter().zip(next).all(|(a, b)| {
            let length = (b[0] - a[0]).hypot(b[1] - a[1]);
            left_of(*a, *b, point) >= -margin * length
        })
    }
}

/// Twice the area of a triangle: positive if `point` is on the left of the line from `a` to `b`.
fn left_of(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}

fn bounds(points: impl Iterator<Item = Vector3<f64>>) -> [Vector3<f64>; 2] {
    let empty = [Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)];
    points.fold(empty, |[low, high], at| [low.inf(&at), high.sup(&at)])
}

#[cfg(test)]
mod tests {
    use grasp::Intrinsics;

    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 320, height: 240, fx: 300.0, fy: 300.0, cx: 159.5, cy: 119.5 };

    /// Distance of the camera from the table below it, metres.
    const DISTANCE: f64 = 0.8;

    /// The image of boxes (lower and upper corner, metres) on a table straight below the camera, and what stands on it.
    fn segmentation(table: [[f64; 2]; 2], boxes: &[[[f64; 3]; 2]]) -> (Segmentation, Vec<u16>) {
        let depth = |index: usize| {
            let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
            let [x, y] = [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy];
            let over = |z: f64, low: [f64; 2], high: [f64; 2]| {
                let at = [x * z, y * z];
                (0..2).all(|axis| (low[axis]..high[axis]).contains(&at[axis]))
            };
            let tops = boxes.iter().filter_map(|[low, high]| {
                let z = DISTANCE - high[2];
                over(z, [low[0], low[1]], [high[0], high[1]]).then_some(z)
            });
            let below = if over(DISTANCE, table[0], table[1]) { DISTANCE } else { DISTANCE + 0.5 };
            tops.fold(below, f64::min) as f32
        };
        let depths: Vec<f32> = (0..CAMERA.width * CAMERA.height).map(depth).collect();
        let image = DepthImage::new(CAMERA, depths).unwrap();
        // z points to the camera.
        let down = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let camera_from_table = Isometry3::from_parts(nalgebra::Translation3::new(0.0, 0.0, DISTANCE), down);
        let segmentation = Segmentation::of(&image, &camera_from_table);
        let labels = segmentation.labels(&image);
        (segmentation, labels)
    }

    /// The label at a point of the table below the camera.
    fn label_at(labels: &[u16], [x, y]: [f64; 2], height: f64) -> u16 {
        let z = DISTANCE - height;
        let [u, v] = [x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy].map(f64::round);
        labels[v as usize * CAMERA.width + u as usize]
    }

    const EVERYWHERE: [[f64; 2]; 2] = [[-9.0; 2], [9.0; 2]];

    #[test]
    fn each_object_has_a_label() {
        let large = [[-0.2, -0.1, 0.0], [-0.1, 0.1, 0.08]];
        let small = [[0.1, 0.0, 0.0], [0.14, 0.03, 0.03]];
        let (segmentation, labels) = segmentation(EVERYWHERE, &[small, large]);
        assert_eq!(segmentation.labels_of_objects(), [1, 2].into());
        assert_eq!([[-0.15, 0.0], [0.12, 0.015], [0.0, 0.0]].map(|at| label_at(&labels, at, 0.0)), [1, 2, 0]);
        let points = &segmentation.objects[1].points;
        // y of the table is opposite to that of the image.
        assert!(
            points.iter().all(|([x, y], _)| (0.095..0.145).contains(x) && (-0.035..0.005).contains(y)),
            "{points:?}"
        );
    }

    #[test]
    fn what_the_image_cuts_off_and_what_is_beside_the_table_is_no_object() {
        let arm = [[0.1, -0.02, 0.0], [9.0, 0.04, 0.1]];
        let object = [[-0.1, -0.02, 0.0], [-0.04, 0.04, 0.1]];
        let (found, labels) = segmentation(EVERYWHERE, &[arm, object]);
        assert_eq!(found.objects.len(), 1);
        assert_eq!([label_at(&labels, [-0.07, 0.0], 0.1), label_at(&labels, [0.2, 0.0], 0.1)], [1, 2]);
        // The rim of a bin, whose floor is the table, is higher than the object.
        let bin = [[-0.2, -0.15], [0.2, 0.15]];
        let walls = [
            [[-0.22, -0.17, 0.0], [0.22, -0.15, 0.15]],
            [[-0.22, 0.15, 0.0], [0.22, 0.17, 0.15]],
            [[-0.22, -0.17, 0.0], [-0.2, 0.17, 0.15]],
            [[0.2, -0.17, 0.0], [0.22, 0.17, 0.15]],
        ];
        let (found, labels) = segmentation(bin, &[walls.as_slice(), &[object]].concat());
        assert_eq!(found.objects.len(), 1);
        assert_eq!(label_at(&labels, [-0.07, 0.0], 0.1), 1);
    }
}
