use std::collections::BTreeMap;

use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

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
    cells: BTreeMap<[i64; 3], Vec<usize>>,
}

/// Edge of the cells of the neighbour search, metres.
const CELL: f64 = NORMALS_RADIUS;

/// Edge of the blocks whose points share a neighbour search for their normals, metres.
const BLOCK: f64 = NORMALS_RADIUS / 3.0;

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
        let cells = by_cell(&seen, CELL);
        let mut cloud = Self { points: seen, cells };
        for (index, normal) in cloud.normals() {
            cloud.points[index].normal = normal;
        }
        cloud
    }

    /// The points, ordered by voxel.
    #[must_use]
    pub fn points(&self) -> &[SurfacePoint] {
        &self.points
    }

    /// The points within `radius` of `centre`; `radius` is at least 0.
    pub fn within(&self, centre: Point3<f64>, radius: f64) -> impl Iterator<Item = &SurfacePoint> {
        let [lower, upper] = [-radius, radius].map(|side| cell_of(&(centre + Vector3::repeat(side)), CELL));
        let layers = self.cells.range([lower[0], i64::MIN, i64::MIN]..=[upper[0], i64::MAX, i64::MAX]);
        let cells =
            layers.filter(move |(cell, _)| (1..3).all(|axis| (lower[axis]..=upper[axis]).contains(&cell[axis])));
        let points = cells.flat_map(|(_, indices)| indices).map(|&index| &self.points[index]);
        points.filter(move |point| (point.position - centre).norm_squared() <= radius * radius)
    }

    /// The points, without those of cells that `may_contain` rejects. Its arguments are the centre and the radius of a
    /// sphere around the cell.
    pub(super) fn in_cells(
        &self,
        may_contain: impl Fn(&Point3<f64>, f64) -> bool,
    ) -> impl Iterator<Item = &SurfacePoint> {
        let cells = self.cells.iter().filter(move |(cell, _)| may_contain(&centre_of(cell, CELL), radius_of(CELL)));
        cells.flat_map(|(_, indices)| indices).map(|&index| &self.points[index])
    }

    /// The indices of all points, and their normals.
    fn normals(&self) -> Vec<(usize, Vector3<f64>)> {
        let of_block = |(block, indices): ([i64; 3], Vec<usize>)| {
            // The points of a block share most of their neighbours.
            let centre = centre_of(&block, BLOCK);
            let near = Neighbours::new(self.within(centre, NORMALS_RADIUS + radius_of(BLOCK)), centre);
            indices.into_iter().map(move |index| (index, near.normal_at(&self.points[index])))
        };
        by_cell(&self.points, BLOCK).into_par_iter().flat_map_iter(of_block).collect()
    }
}

/// Points whose sums are computed at the same time, by vector instructions.
const LANES: usize = 4;

/// Points around a centre, relative to it.
struct Neighbours {
    centre: Point3<f64>,
    offsets: Vec<[[f32; LANES]; 3]>,
}

impl Neighbours {
    fn new<'a>(points: impl Iterator<Item = &'a SurfacePoint>, centre: Point3<f64>) -> Self {
        // Lanes without a point are out of reach.
        let far = [[1.0; LANES]; 3];
        let mut offsets = Vec::new();
        for (index, point) in points.enumerate() {
            if index % LANES == 0 {
                offsets.push(far);
            }
            let (last, offset) = (offsets.len() - 1, (point.position - centre).cast::<f32>());
            for axis in 0..3 {
                offsets[last][axis][index % LANES] = offset[axis];
            }
        }
        Self { centre, offsets }
    }

    /// The direction of least variance of the neighbourhood, on the observed side.
    fn normal_at(&self, point: &SurfacePoint) -> Vector3<f64> {
        const SQUARED: f32 = (NORMALS_RADIUS * NORMALS_RADIUS) as f32;
        let at = (point.position - self.centre).cast::<f32>();
        // The count, the sum of the offsets, and the sums of their products.
        let mut sums = [[0.0_f32; LANES]; 10];
        for [x, y, z] in &self.offsets {
            for lane in 0..LANES {
                let [x, y, z] = [x[lane] - at.x, y[lane] - at.y, z[lane] - at.z];
                // A weight and no branch, because the processor would often mispredict the branch.
                let weight = if x * x + y * y + z * z <= SQUARED { 1.0 } else { 0.0 };
                let [x, y, z] = [x * weight, y * weight, z * weight];
                for (sum, term) in sums.iter_mut().zip([weight, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z]) {
                    sum[lane] += term;
                }
            }
        }
        let [count, x, y, z, xx, xy, xz, yy, yz, zz] = sums.map(|lanes| f64::from(lanes.iter().sum::<f32>()));
        if count < 3.0 {
            return point.normal;
        }
        let sum = Vector3::new(x, y, z);
        let squares = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
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

/// The indices of the points by cell of size `edge`.
fn by_cell(points: &[SurfacePoint], edge: f64) -> BTreeMap<[i64; 3], Vec<usize>> {
    let mut cells: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
    for (index, point) in points.iter().enumerate() {
        cells.entry(cell_of(&point.position, edge)).or_default().push(index);
    }
    cells
}

fn cell_of(point: &Point3<f64>, edge: f64) -> [i64; 3] {
    [point.x, point.y, point.z].map(|coordinate| (coordinate / edge).floor() as i64)
}

fn centre_of([x, y, z]: &[i64; 3], edge: f64) -> Point3<f64> {
    let middle = |index: &i64| (*index as f64 + 0.5) * edge;
    Point3::new(middle(x), middle(y), middle(z))
}

/// Radius of the sphere around a cell.
fn radius_of(edge: f64) -> f64 {
    0.5 * 3.0_f64.sqrt() * edge
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
    fn only_cells_that_may_contain_a_point_are_searched() {
        let cloud = Cloud::new(plane(0.2));
        let in_slab = |point: &Point3<f64>, margin: f64| (0.8 * point.x - 0.6 * point.y).abs() <= 0.004 + margin;
        let searched = || cloud.in_cells(in_slab).map(|point| point.position);
        let expected = cloud.points().iter().filter(|point| in_slab(&point.position, 0.0)).count();
        assert_eq!(searched().filter(|point| in_slab(point, 0.0)).count(), expected);
        assert!((1..cloud.points().len()).contains(&searched().count()), "some cells are skipped");
    }

    #[test]
    fn a_normal_is_that_of_all_neighbours() {
        let bent = |point: SurfacePoint| {
            let Point3 { coords } = point.position;
            SurfacePoint { position: Point3::new(coords.x, coords.y, 5.0 * coords.norm_squared()), ..point }
        };
        let cloud = Cloud::new(plane(0.0).into_iter().map(bent));
        for point in cloud.points() {
            let near: Vec<Vector3<f64>> =
                cloud.within(point.position, NORMALS_RADIUS).map(|point| point.position.coords).collect();
            let mean = near.iter().sum::<Vector3<f64>>() / near.len() as f64;
            let covariance: Matrix3<f64> = near.iter().map(|at| (at - mean) * (at - mean).transpose()).sum();
            let [along, across] = [point.normal, point.normal.cross(&Vector3::x()).normalize()]
                .map(|direction| direction.dot(&(covariance * direction)));
            let eigenvalues = covariance.symmetric_eigenvalues();
            // The normal is the direction of the least variance, up to the precision of f32.
            assert!((along - eigenvalues.min()).abs() < 1e-3 * eigenvalues.max(), "{}", point.position);
            assert!(across > along);
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
