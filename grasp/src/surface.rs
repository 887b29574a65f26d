use std::collections::HashMap;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::fusion::NEAR_SURFACE;
use crate::{Details, Fusion, Volume};

/// A zero crossing of the fused field, with the outward normal. Cube frame, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position of the zero crossing.
    pub position: Point3<f64>,
    /// Unit normal that points to free space.
    pub normal: Vector3<f64>,
}

/// The observed surface as a triangle mesh, counter-clockwise as seen from free space. Cube frame, metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfaceMesh {
    /// Vertex positions.
    pub vertices: Vec<Point3<f64>>,
    /// Three vertex indices per triangle.
    pub triangles: Vec<[u32; 3]>,
}

/// A truncated signed distance field over a cube.
pub(crate) trait Field: Sync {
    /// Voxels along an edge.
    fn resolution(&self) -> usize;

    /// Edge of a voxel, metres.
    fn voxel_size(&self) -> f64;

    /// Distance at a voxel as a fraction of the truncation distance; 0 if the voxel was not observed.
    fn distance(&self, index: usize) -> f32;

    /// Distance at a voxel; `None` if no surface near the voxel was observed.
    fn near_surface(&self, index: usize) -> Option<f32>;

    /// The zero crossings between neighbouring voxels.
    fn surface(&self) -> Vec<SurfacePoint> {
        (0..self.resolution()).into_par_iter().flat_map_iter(|x| self.surface_from(x)).collect()
    }

    /// The zero crossings between the voxels with index `x` along x and the next ones along each axis.
    fn surface_from(&self, x: usize) -> Vec<SurfacePoint> {
        let n = self.resolution();
        let stride = [n * n, n, 1];
        let mut points = Vec::new();
        for index in x * n * n..(x + 1) * n * n {
            let Some(here) = self.near_surface(index) else { continue };
            let cell = [x, index / n % n, index % n];
            // The normal needs neighbours on both sides, which voxels at the faces of the cube do not have.
            let inner = 1..n - 1;
            if !cell.iter().all(|c| inner.contains(c)) {
                continue;
            }
            for axis in 0..3 {
                if !inner.contains(&(cell[axis] + 1)) {
                    continue;
                }
                let Some(there) = self.near_surface(index + stride[axis]) else { continue };
                if here * there < 0.0 {
                    let mut position = Point3::from(cell.map(|c| c as f64 + 0.5));
                    position[axis] += f64::from(here.abs() / (here.abs() + there.abs()));
                    let position = position * self.voxel_size();
                    if let Some(normal) = self.normal_at(&position) {
                        points.push(SurfacePoint { position, normal });
                    }
                }
            }
        }
        points
    }

    /// Central difference of the field over 0.99 voxels to each side, as in Open3D.
    fn normal_at(&self, point: &Point3<f64>) -> Option<Vector3<f64>> {
        let gap = 0.99 * self.voxel_size();
        let mut gradient = Vector3::zeros();
        for axis in 0..3 {
            let mut offset = Vector3::zeros();
            offset[axis] = gap;
            gradient[axis] = self.interpolate(&(point + offset)) - self.interpolate(&(point - offset));
        }
        gradient.try_normalize(1e-12)
    }

    /// Distance at `point` (cube frame) as a fraction of the truncation distance, by trilinear interpolation.
    fn interpolate(&self, point: &Point3<f64>) -> f64 {
        let n = self.resolution();
        let p = point.coords / self.voxel_size() - Vector3::repeat(0.5);
        let base = p.map(|c| c.floor().clamp(0.0, (n - 2) as f64));
        let r = p - base;
        let [x, y, z] = [base.x as usize, base.y as usize, base.z as usize];
        let mut sum = 0.0;
        for corner in 0..8 {
            let (dx, dy, dz) = (corner >> 2, corner >> 1 & 1, corner & 1);
            let weight = [1.0 - r.x, r.x][dx] * [1.0 - r.y, r.y][dy] * [1.0 - r.z, r.z][dz];
            sum += weight * f64::from(self.distance(((x + dx) * n + y + dy) * n + z + dz));
        }
        sum
    }
}

impl Field for Volume {
    fn resolution(&self) -> usize {
        self.resolution()
    }

    fn voxel_size(&self) -> f64 {
        self.voxel_size()
    }

    fn distance(&self, index: usize) -> f32 {
        let value = self.values()[index];
        if value > 0.0 { 2.0 * value - 1.0 } else { 0.0 }
    }

    fn near_surface(&self, index: usize) -> Option<f32> {
        let is_near = |distance: &f32| (-NEAR_SURFACE..NEAR_SURFACE).contains(distance);
        (self.values()[index] > 0.0).then(|| self.distance(index)).filter(is_near)
    }
}

impl Field for Details {
    fn resolution(&self) -> usize {
        self.resolution()
    }

    fn voxel_size(&self) -> f64 {
        self.voxel_size()
    }

    fn distance(&self, index: usize) -> f32 {
        match self.bytes()[index] {
            0 => 0.0,
            byte => Self::distance(byte),
        }
    }

    fn near_surface(&self, index: usize) -> Option<f32> {
        let byte = self.bytes()[index];
        (byte != 0 && byte != Self::FREE).then(|| Self::distance(byte))
    }
}

impl Details {
    /// The zero crossings between neighbouring voxels, with normals.
    #[must_use]
    pub fn surface(&self) -> Vec<SurfacePoint> {
        Field::surface(self)
    }
}

impl Fusion {
    /// The observed surface as points: every zero crossing between neighbouring voxels, as in Open3D's
    /// `ExtractPointCloud`.
    #[must_use]
    pub fn surface(&self) -> Vec<SurfacePoint> {
        Field::surface(self)
    }
}

impl Volume {
    /// The observed surface as points, as [`Fusion::surface`].
    #[must_use]
    pub fn surface(&self) -> Vec<SurfacePoint> {
        Field::surface(self)
    }

    /// The observed surface as a mesh, for display. Each group of eight voxels with a sign change gets one vertex, at
    /// the mean of the zero crossings on its edges (surface nets: Gibson, "Constrained Elastic Surface Nets", MICCAI
    /// 1998). Only edges with two observed ends count.
    #[must_use]
    pub fn mesh(&self) -> SurfaceMesh {
        let n = self.resolution();
        let index = |[x, y, z]: [usize; 3]| (x * n + y) * n + z;
        let mut mesh = SurfaceMesh::default();
        let mut corners = HashMap::new();
        for cell in (0..(n - 1).pow(3)).map(|i| [i / (n - 1).pow(2), i / (n - 1) % (n - 1), i % (n - 1)]) {
            if let Some(vertex) = self.corner(cell) {
                corners.insert(cell, mesh.vertices.len() as u32);
                mesh.vertices.push(vertex);
            }
        }
        // Each edge between voxels of different signs is shared by four groups.
        for at in (0..n.pow(3)).map(|i| [i / (n * n), i / n % n, i % n]) {
            for axis in 0..3 {
                let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
                let mut next = at;
                next[axis] += 1;
                if next[axis] >= n || at[u] == 0 || at[v] == 0 {
                    continue;
                }
                let (Some(here), Some(there)) = (self.near_surface(index(at)), self.near_surface(index(next))) else {
                    continue;
                };
                if (here < 0.0) == (there < 0.0) {
                    continue;
                }
                let around = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[du, dv]| {
                    let mut cell = at;
                    cell[u] -= du;
                    cell[v] -= dv;
                    corners.get(&cell).copied()
                });
                let [Some(a), Some(b), Some(c), Some(d)] = around else { continue };
                // The winding depends on the direction of the sign change.
                let [b, d] = if here < 0.0 { [b, d] } else { [d, b] };
                mesh.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        mesh
    }

    /// The mean zero crossing on the edges of a group of eight voxels.
    fn corner(&self, cell: [usize; 3]) -> Option<Point3<f64>> {
        let n = self.resolution();
        let at = |corner: usize| [cell[0] + (corner >> 2), cell[1] + (corner >> 1 & 1), cell[2] + (corner & 1)];
        let value = |corner: usize| {
            let [x, y, z] = at(corner);
            self.near_surface((x * n + y) * n + z).map(f64::from)
        };
        let (mut sum, mut count) = (Vector3::zeros(), 0.0);
        let edges = (0..8).flat_map(|from| [1, 2, 4].map(|bit| (from, from | bit)));
        for (from, to) in edges.filter(|(from, to)| from != to) {
            let (Some(here), Some(there)) = (value(from), value(to)) else { continue };
            if (here < 0.0) != (there < 0.0) {
                let share = here / (here - there);
                let [from, to] = [from, to].map(|corner| Vector3::from(at(corner).map(|c| c as f64 + 0.5)));
                sum += from + (to - from) * share;
                count += 1.0;
            }
        }
        (count > 0.0).then(|| Point3::from(sum / count * self.voxel_size()))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;

    /// The field of a ball of radius 0.05 m in the middle of the cube, observed from all sides.
    fn ball() -> Volume {
        let (n, size) = (40, 0.0075);
        let value = |i: usize| {
            let p = Point3::from([i / (n * n), i / n % n, i % n].map(|c| (c as f64 + 0.5) * size));
            let distance = ((p - Point3::new(0.15, 0.15, 0.15)).norm() - 0.05) / 0.03;
            if distance.abs() < 1.0 { (distance as f32 + 1.0) / 2.0 } else { 0.0 }
        };
        Volume::new(n, size, Isometry3::identity(), (0..n.pow(3)).map(value).collect()).unwrap()
    }

    #[test]
    fn the_mesh_of_a_ball_is_a_ball() {
        let SurfaceMesh { vertices, triangles } = ball().mesh();
        let centre = Point3::new(0.15, 0.15, 0.15);
        assert!(vertices.iter().all(|vertex| ((vertex - centre).norm() - 0.05).abs() < 0.001));
        let corners = |triangle: &[u32; 3]| triangle.map(|corner| vertices[corner as usize]);
        let mut area = 0.0;
        for [a, b, c] in triangles.iter().map(corners) {
            let normal = (b - a).cross(&(c - a)) / 2.0;
            assert!(normal.dot(&(a - centre)) > 0.0, "the normal points to free space");
            area += normal.norm();
        }
        let expected = 4.0 * std::f64::consts::PI * 0.05 * 0.05;
        assert!((area / expected - 1.0).abs() < 0.03, "{area} m² of {expected}");
        // Euler's formula for a closed surface.
        assert_eq!(triangles.len(), 2 * (vertices.len() - 2));
    }
}
