use grasp::Volume;
use nalgebra::{Matrix3, Unit, Vector3};

/// A nearly level plane in a volume: the top of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Table {
    /// Angle between the plane and the bottom of the volume, radians.
    pub tilt: f64,
    /// Height of the plane above the bottom of the volume, in its middle, metres.
    pub height: f64,
    /// Observed part of the plane, m².
    pub area: f64,
}

/// Columns of the volume along x and y in which the surface is sampled, at most.
const COLUMNS: usize = 20;

/// Distance between the points that propose a plane, columns: long enough for an accurate slope, and short enough that
/// they are often on one surface.
const BASELINE: usize = 3;

/// Largest distance of a point from its plane, metres.
const TOLERANCE: f64 = 0.005;

/// A level plane at the expected height is preferred if it has at least this share of the points of the largest plane.
/// The top of a large object may be larger than what is seen of the table.
const PREFERRED: f64 = 0.5;

impl Table {
    /// The largest plane of a volume that is less than 45° from level; `None` if none has three points. `expected`
    /// is the height at which a table is expected, metres above the volume's bottom.
    #[must_use]
    pub fn find(volume: &Volume, expected: f64) -> Option<Table> {
        let stride = volume.resolution().div_ceil(COLUMNS);
        let surface = Surface::new(volume, stride);
        let level = Plane { slope: [0.0; 2], offset: expected };
        let largest = surface.largest_plane().unwrap_or(level);
        let preferred = surface.count(&level) as f64 >= PREFERRED * surface.count(&largest) as f64;
        let plane = surface.refined(if preferred { level } else { largest })?;
        let normal = plane.normal();
        let middle = volume.voxel_size() * volume.resolution() as f64 / 2.0;
        let of_point = (stride as f64 * volume.voxel_size()).powi(2) / normal.z;
        Some(Table {
            tilt: normal.z.min(1.0).acos(),
            height: plane.height(middle, middle),
            area: surface.count(&plane) as f64 * of_point,
        })
    }
}

/// Heights of the topmost surface over a grid of columns.
struct Surface {
    edge: usize,
    points: Vec<Option<Vector3<f64>>>,
}

/// z = slope · (x, y) + offset, metres.
#[derive(Clone, Copy, Debug)]
struct Plane {
    slope: [f64; 2],
    offset: f64,
}

impl Surface {
    /// Samples every `stride`-th column.
    fn new(volume: &Volume, stride: usize) -> Self {
        let (n, size) = (volume.resolution(), volume.voxel_size());
        let columns: Vec<usize> = (stride / 2..n).step_by(stride).collect();
        let place = |index: usize| (index as f64 + 0.5) * size;
        let column = |x: usize, y: usize| {
            let values = &volume.values()[(x * n + y) * n..][..n];
            // Behind the surface values are below 0.5, and 0 where nothing was observed.
            let top = (1..n).rev().find(|&k| values[k] >= 0.5 && values[k - 1] > 0.0 && values[k - 1] < 0.5)?;
            let (below, above) = (f64::from(values[top - 1]), f64::from(values[top]));
            let height = (top as f64 - 0.5 + (0.5 - below) / (above - below)) * size;
            Some(Vector3::new(place(x), place(y), height))
        };
        let points = columns.iter().flat_map(|&x| columns.iter().map(move |&y| column(x, y))).collect();
        Self { edge: columns.len(), points }
    }

    /// The plane through three neighbouring points that has the most points near it.
    fn largest_plane(&self) -> Option<Plane> {
        let at = |x: usize, y: usize| (x < self.edge && y < self.edge).then(|| self.points[x * self.edge + y])?;
        // Every second column proposes a plane: this runs for every request.
        let corners = (0..self.edge).step_by(2).flat_map(|x| (0..self.edge).step_by(2).map(move |y| (x, y)));
        let proposed = corners.filter_map(|(x, y)| {
            let (corner, along_x, along_y) = (at(x, y)?, at(x + BASELINE, y)?, at(x, y + BASELINE)?);
            let (along_x, along_y) = (along_x - corner, along_y - corner);
            let slope = [along_x.z / along_x.x, along_y.z / along_y.y];
            let plane = Plane { slope, offset: corner.z - slope[0] * corner.x - slope[1] * corner.y };
            plane.is_level().then_some(plane)
        });
        proposed.max_by_key(|plane| self.count(plane))
    }

    fn near(&self, plane: &Plane) -> impl Iterator<Item = &Vector3<f64>> {
        let plane = *plane;
        let tolerance = TOLERANCE / plane.normal().z;
        self.points.iter().flatten().filter(move |p| (p.z - plane.height(p.x, p.y)).abs() <= tolerance)
    }

    fn count(&self, plane: &Plane) -> usize {
        self.near(plane).count()
    }

    /// The least-squares plane of the points near a plane, fitted repeatedly; `None` if they are fewer than three or on
    /// a line, or the fitted plane is steeper than 45°.
    fn refined(&self, plane: Plane) -> Option<Plane> {
        const REPEATS: usize = 3;
        (0..REPEATS).try_fold(plane, |plane, _| {
            let (mut normal_matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
            for point in self.near(&plane) {
                let row = Vector3::new(point.x, point.y, 1.0);
                normal_matrix += row * row.transpose();
                right += row * point.z;
            }
            let solution = normal_matrix.cholesky()?.solve(&right);
            let fitted = Plane { slope: [solution.x, solution.y], offset: solution.z };
            fitted.is_level().then_some(fitted)
        })
    }
}

impl Plane {
    fn height(&self, x: f64, y: f64) -> f64 {
        self.slope[0] * x + self.slope[1] * y + self.offset
    }

    fn normal(&self) -> Unit<Vector3<f64>> {
        Unit::new_normalize(Vector3::new(-self.slope[0], -self.slope[1], 1.0))
    }

    fn is_level(&self) -> bool {
        // Written so that NaN fails.
        self.slope[0].hypot(self.slope[1]) < 1.0
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3};

    use super::*;

    const N: usize = 40;
    const VOXEL: f64 = 0.0075;

    /// A volume of the half space below a plane through (0.15, 0.15, height), with a box of 8 × 8 cm that is `tall`.
    fn scene(height: f64, tilt_degrees: f64, tall: f64) -> Volume {
        let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), tilt_degrees.to_radians());
        let normal = rotation * Vector3::z();
        let truncation = 4.0 * VOXEL;
        let value = |index: usize| {
            let p = Point3::new(index / (N * N), index / N % N, index % N).map(|c| (c as f64 + 0.5) * VOXEL);
            let over_table = normal.dot(&(p - Point3::new(0.15, 0.15, height)));
            let within = (p.x - 0.1).abs() < 0.04 && (p.y - 0.12).abs() < 0.04;
            let distance = if within { over_table.min(p.z - height - tall) } else { over_table } / truncation;
            if distance.abs() < 0.98 { ((distance + 1.0) / 2.0) as f32 } else { 0.0 }
        };
        Volume::new(N, VOXEL, Isometry3::identity(), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    #[test]
    fn height_and_tilt_of_the_table_are_measured() {
        for (height, tilt) in [(0.05, 0.0), (0.07, 0.0), (0.05, 7.0), (0.12, -20.0), (0.15, 40.0)] {
            let table = Table::find(&scene(height, tilt, 0.06), 0.05).unwrap();
            assert!((table.height - height).abs() < 1e-3, "{height} {tilt}: {table:?}");
            assert!((table.tilt.to_degrees() - f64::abs(tilt)).abs() < 0.3, "{height} {tilt}: {table:?}");
            assert!(table.area > 0.05, "{height} {tilt}: {table:?}");
        }
    }

    #[test]
    fn a_wall_is_no_table() {
        let value = |index: usize| {
            let distance = ((index / (N * N)) as f64 - 20.0) / 4.0;
            if distance.abs() < 0.98 { ((distance + 1.0) / 2.0) as f32 } else { 0.0 }
        };
        let wall = Volume::new(N, VOXEL, Isometry3::identity(), (0..N.pow(3)).map(value).collect()).unwrap();
        assert_eq!(Table::find(&wall, 0.05), None);
    }

    #[test]
    fn the_top_of_a_large_object_is_not_taken_for_the_table() {
        // Only a strip of the table is observed beside the box.
        let values: Vec<f32> = scene(0.05, 0.0, 0.08).values().to_vec();
        let seen = |(index, value): (usize, f32)| {
            let (x, y) = (index / (N * N), index / N % N);
            if (4..22).contains(&x) && (10..18).contains(&y) { value } else { 0.0 }
        };
        let values = values.into_iter().enumerate().map(seen).collect();
        let volume = Volume::new(N, VOXEL, Isometry3::identity(), values).unwrap();
        let table = Table::find(&volume, 0.05).unwrap();
        assert!((table.height - 0.05).abs() < 2e-3, "{table:?}");
    }
}
