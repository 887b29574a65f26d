use std::collections::{BTreeMap, HashMap};

use nalgebra::{Matrix3, Point3, Vector3};

use crate::SurfacePoint;

/// Edge of the voxels to which a cloud is downsampled, metres (GPD's code: `voxel_size`).
pub const VOXEL_SIZE: f64 = 0.003;

/// Radius of the neighbourhood from which a normal is estimated, metres (GPD's code: `normals_radius`).
pub const NORMALS_RADIUS: f64 = 0.03;

/// Largest number of points. Objects on a table have a few thousand. Noise can have a hundred times as many, each with
/// thousands of neighbours.
const MAX_POINTS: usize = 20_000;

/// A downsampled point cloud with normals towards the camera. Task frame, metres. It has one point per voxel of
/// [`VOXEL_SIZE`], or of a larger size that limits the cloud to 20,000 points.
#[derive(Clone, Debug)]
pub struct Cloud {
    points: Vec<SurfacePoint>,
    /// Indices into `points` by cell of size [`CELL`].
    cells: HashMap<[i64; 3], Vec<usize>>,
}

/// Edge of the cells of the neighbour search, metres: a normal's neighbourhood touches 27 of them.
const CELL: f64 = NORMALS_RADIUS;

impl Cloud {
    /// Downsamples `points` to the means of their voxels and estimates each normal from the plane through its
    /// neighbourhood.
    ///
    /// The normals of `points` only decide the sign of the estimated normals; directions [towards the
    /// camera](crate::DepthImage::points) are enough. The order of the points only affects rounding.
    pub fn new(points: impl IntoIterator<Item = SurfacePoint>) -> Self {
        let one = |SurfacePoint { position, normal }| Sum { positions: position.coords, normals: normal, count: 1.0 };
        let mut edge = VOXEL_SIZE;
        let mut voxels = thinned(points.into_iter().map(one), edge);
        while voxels.len() > MAX_POINTS {
            edge *= 2.0;
            voxels = thinned(voxels.into_values(), edge);
        }
        let seen: Vec<SurfacePoint> = voxels
            .into_values()
            .map(|sum| SurfacePoint {
                position: sum.mean(),
                normal: sum.normals.try_normalize(1e-12).unwrap_or(Vector3::z()),
            })
            .collect();
        let mut cells: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
        for (index, point) in seen.iter().enumerate() {
            cells.entry(cell_of(&point.position, CELL)).or_default().push(index);
        }
        let mut cloud = Self { points: seen, cells };
        let normals: Vec<Vector3<f64>> = cloud.points.iter().map(|point| cloud.normal_at(point)).collect();
        for (point, normal) in cloud.points.iter_mut().zip(normals) {
            point.normal = normal;
        }
        cloud
    }

    /// The points, ordered by voxel.
    #[must_use]
    pub fn points(&self) -> &[SurfacePoint] {
        &self.points
    }

    /// The points within `radius` of `centre`.
    pub fn within(&self, centre: Point3<f64>, radius: f64) -> impl Iterator<Item = &SurfacePoint> {
        let lower = cell_of(&(centre - Vector3::repeat(radius)), CELL);
        let upper = cell_of(&(centre + Vector3::repeat(radius)), CELL);
        let wanted: f64 = lower.iter().zip(upper).map(|(&lower, upper)| (upper - lower + 1) as f64).product();
        // For a large radius, scanning all points is cheaper than visiting all cells.
        let all = wanted > self.points.len() as f64;
        let cells = (lower[0]..=upper[0])
            .flat_map(move |x| (lower[1]..=upper[1]).flat_map(move |y| (lower[2]..=upper[2]).map(move |z| [x, y, z])));
        let cells = cells.take(if all { 0 } else { usize::MAX });
        let points = self.points.get(if all { 0 } else { self.points.len() }..).unwrap_or_default();
        cells
            .filter_map(|cell| self.cells.get(&cell))
            .flatten()
            .map(|&index| &self.points[index])
            .chain(points)
            .filter(move |point| (point.position - centre).norm_squared() <= radius * radius)
    }

    /// The direction of least variance of the neighbourhood, on the observed side.
    fn normal_at(&self, point: &SurfacePoint) -> Vector3<f64> {
        let (mut sum, mut squares, mut count) = (Vector3::zeros(), Matrix3::zeros(), 0.0);
        for neighbour in self.within(point.position, NORMALS_RADIUS) {
            let offset = neighbour.position - point.position;
            sum += offset;
            squares += offset * offset.transpose();
            count += 1.0;
        }
        if count < 3.0 {
            return point.normal;
        }
        let eigen = (squares - sum * sum.transpose() / count).symmetric_eigen();
        let normal: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into();
        if normal.dot(&point.normal) < 0.0 { -normal } else { normal }
    }
}

/// Sums over the points of a voxel.
#[derive(Default)]
struct Sum {
    positions: Vector3<f64>,
    normals: Vector3<f64>,
    count: f64,
}

impl Sum {
    fn mean(&self) -> Point3<f64> {
        Point3::from(self.positions / self.count)
    }
}

/// Sums by voxel, in a fixed order so that the same points give the same cloud.
fn thinned(points: impl Iterator<Item = Sum>, edge: f64) -> BTreeMap<[i64; 3], Sum> {
    let mut voxels: BTreeMap<[i64; 3], Sum> = BTreeMap::new();
    for point in points {
        let sum = voxels.entry(cell_of(&point.mean(), edge)).or_default();
        sum.positions += point.positions;
        sum.normals += point.normals;
        sum.count += point.count;
    }
    voxels
}

fn cell_of(point: &Point3<f64>, edge: f64) -> [i64; 3] {
    [point.x, point.y, point.z].map(|coordinate| (coordinate / edge).floor() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane through the origin, one point per millimetre, seen from above.
    fn plane(slope: f64) -> Vec<SurfacePoint> {
        let at = |i: i32, j: i32| Point3::new(f64::from(i) * 1e-3, f64::from(j) * 1e-3, slope * f64::from(i) * 1e-3);
        let points = (-60..60).flat_map(|i| (-60..60).map(move |j| at(i, j)));
        points.map(|position| SurfacePoint { position, normal: Vector3::new(0.3, 0.0, 1.0) }).collect()
    }

    #[test]
    fn normals_of_a_plane_point_to_the_observed_side() {
        for slope in [0.0, 0.5] {
            let cloud = Cloud::new(plane(slope));
            let expected = Vector3::new(-slope, 0.0, 1.0).normalize();
            let inner = cloud.points().iter().filter(|point| point.position.coords.norm() < 0.02);
            // The neighbourhood of a voxel mean is not quite symmetric.
            assert!(inner.clone().count() > 100 && inner.clone().all(|point| point.normal.dot(&expected) > 0.999));
        }
        let below = plane(0.0).into_iter().map(|point| SurfacePoint { normal: -point.normal, ..point });
        assert!(Cloud::new(below).points().iter().all(|point| point.normal.z < -0.999));
    }

    #[test]
    fn a_voxel_holds_one_point() {
        let cloud = Cloud::new(plane(0.0));
        assert_eq!(cloud.points().len(), 40 * 40);
    }

    #[test]
    fn neighbours_are_those_within_the_radius() {
        let cloud = Cloud::new(plane(0.2));
        // The last one covers more cells than there are points.
        for (centre, radius) in
            [(Point3::origin(), 0.01), (Point3::new(0.02, -0.03, 0.0), 0.07), (Point3::new(0.5, 0.0, 0.0), 0.46)]
        {
            let near = |point: &&SurfacePoint| (point.position - centre).norm() <= radius;
            let expected = cloud.points().iter().filter(near).count();
            assert!(expected > 0);
            assert_eq!(cloud.within(centre, radius).count(), expected);
        }
    }

    #[test]
    fn noise_is_downsampled_to_the_point_limit() {
        let at = |i: usize| Point3::from([i / 10_000, i / 100 % 100, i % 100].map(|c| c as f64 * VOXEL_SIZE));
        let cloud = Cloud::new((0..1_000_000).map(|i| SurfacePoint { position: at(i), normal: Vector3::z() }));
        let count = cloud.points().len();
        assert!((MAX_POINTS / 8..=MAX_POINTS).contains(&count), "{count}");
    }

    #[test]
    fn a_single_point_keeps_its_normal() {
        let point = SurfacePoint { position: Point3::new(0.1, 0.1, 0.1), normal: Vector3::y() };
        assert_eq!(Cloud::new([point]).points(), [point]);
        assert!(Cloud::new([]).points().is_empty());
    }
}
