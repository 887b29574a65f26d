//! Triangle meshes.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Point3, Vector3};

/// A triangle mesh; triangles are counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertices, metres.
    pub vertices: Vec<Point3<f64>>,
    /// Three indices into `vertices` per triangle.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// A box of the given edge lengths, centred on the origin.
    pub fn cuboid(size: Vector3<f64>) -> Mesh {
        let vertices = (0..8)
            .map(|i| {
                let sign = |bit: u32| if i >> bit & 1 == 1 { 0.5 } else { -0.5 };
                Point3::new(sign(0) * size.x, sign(1) * size.y, sign(2) * size.z)
            })
            .collect();
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh { vertices, triangles }
    }

    /// The solid of revolution about z of a profile of `(radius, z)` pairs, approximated with `sides` sides.
    ///
    /// The solid lies to the left of the profile: up the outside and, for a hollow object, down the inside. Profile
    /// ends off the axis are closed with discs.
    pub fn lathe(profile: &[(f64, f64)], sides: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let mut previous: Option<Vec<u32>> = None;
        for ring in closed_on_axis(profile) {
            let ring = mesh.push_ring(ring, sides);
            if let Some(below) = previous.replace(ring.clone()) {
                mesh.stitch(&below, &ring);
            }
        }
        mesh
    }

    /// A cylinder along z, centred on the origin.
    pub fn cylinder(radius: f64, length: f64, sides: u32) -> Mesh {
        Mesh::lathe(&[(radius, -length / 2.0), (radius, length / 2.0)], sides)
    }

    /// A sphere around the origin with `sides` sides around and half as many bands from pole to pole.
    pub fn sphere(radius: f64, sides: u32) -> Mesh {
        let bands = (sides / 2).max(2);
        let profile: Vec<_> = (0..=bands)
            .map(|i| (TAU / 2.0 * f64::from(i) / f64::from(bands)).sin_cos())
            // Sines within rounding error of zero are the poles.
            .map(|(sin, cos)| (if sin < 1e-9 { 0.0 } else { radius * sin }, -radius * cos))
            .collect();
        Mesh::lathe(&profile, sides)
    }

    /// Joins meshes into one, without merging their surfaces.
    pub fn union<'a>(meshes: impl IntoIterator<Item = &'a Mesh>) -> Mesh {
        let mut union = Mesh::default();
        meshes.into_iter().for_each(|mesh| union.append(mesh));
        union
    }

    /// Adds the vertices and triangles of `other`.
    pub fn append(&mut self, other: &Mesh) {
        let offset = self.vertices.len() as u32;
        self.vertices.extend_from_slice(&other.vertices);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|i| i + offset)));
    }

    /// The mesh with `f` applied to every vertex; `f` must preserve the orientation.
    pub fn mapped(&self, f: impl Fn(Point3<f64>) -> Point3<f64>) -> Mesh {
        Mesh { vertices: self.vertices.iter().map(|&p| f(p)).collect(), triangles: self.triangles.clone() }
    }

    /// The mesh scaled by `factor` about the origin.
    pub fn scaled(&self, factor: f64) -> Mesh {
        self.mapped(|p| p * factor)
    }

    /// The mesh transformed by `pose`.
    pub fn transformed(&self, pose: &Isometry3<f64>) -> Mesh {
        self.mapped(|p| pose * p)
    }

    /// The lower and the upper corner of the axis-aligned bounding box; both are the origin for a mesh without
    /// vertices.
    pub fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        let Some(&first) = self.vertices.first() else { return Default::default() };
        self.vertices.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)))
    }

    /// The edge lengths of the bounding box, metres.
    pub fn extents(&self) -> Vector3<f64> {
        let (low, high) = self.bounds();
        high - low
    }

    /// The enclosed volume in m³. The mesh must be closed.
    pub fn volume(&self) -> f64 {
        self.tetrahedra().map(|(volume, _)| volume).sum()
    }

    /// The centre of mass of the enclosed solid. The mesh must be closed and its volume above 0.
    pub fn centroid(&self) -> Point3<f64> {
        let moment: Vector3<f64> = self.tetrahedra().map(|(volume, centre)| volume * centre).sum();
        (moment / self.volume()).into()
    }

    /// The corners of a triangle.
    pub fn corners(&self, triangle: [u32; 3]) -> [Point3<f64>; 3] {
        triangle.map(|i| self.vertices[i as usize])
    }

    /// Twice the area of a triangle along its outward normal.
    pub fn area_normal(&self, triangle: [u32; 3]) -> Vector3<f64> {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a))
    }

    /// Signed volume and centroid of the tetrahedron from the origin to each triangle.
    fn tetrahedra(&self) -> impl Iterator<Item = (f64, Vector3<f64>)> + '_ {
        self.triangles.iter().map(|&triangle| {
            let [a, b, c] = self.corners(triangle).map(|p| p.coords);
            (a.dot(&b.cross(&c)) / 6.0, (a + b + c) / 4.0)
        })
    }

    /// Adds one ring of a lathe. A ring of radius 0 is a single vertex, whose index is repeated `sides` times.
    fn push_ring(&mut self, (radius, z): (f64, f64), sides: u32) -> Vec<u32> {
        let first = self.vertices.len() as u32;
        if radius == 0.0 {
            self.vertices.push(Point3::new(0.0, 0.0, z));
            return vec![first; sides as usize];
        }
        self.vertices.extend((0..sides).map(|i| {
            let (sin, cos) = (TAU * f64::from(i) / f64::from(sides)).sin_cos();
            Point3::new(radius * cos, radius * sin, z)
        }));
        (first..first + sides).collect()
    }

    /// Joins two rings with a band of triangles, without those that degenerate on the axis.
    fn stitch(&mut self, below: &[u32], above: &[u32]) {
        for i in 0..below.len() {
            let j = (i + 1) % below.len();
            let halves = [[below[i], below[j], above[j]], [below[i], above[j], above[i]]];
            self.triangles.extend(halves.iter().filter(|[a, b, c]| a != b && b != c && c != a));
        }
    }
}

/// The profile of a lathe with both ends connected to the axis.
fn closed_on_axis(profile: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let bottom = profile.first().filter(|(radius, _)| *radius > 0.0).map(|&(_, z)| (0.0, z));
    let top = profile.last().filter(|(radius, _)| *radius > 0.0).map(|&(_, z)| (0.0, z));
    bottom.into_iter().chain(profile.iter().copied()).chain(top).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn volumes_and_centroids_match_the_solids() {
        let cuboid = Mesh::cuboid(Vector3::new(0.1, 0.2, 0.3));
        assert!((cuboid.volume() - 0.006).abs() < 1e-12);
        let moved = cuboid.transformed(&Isometry3::translation(1.0, 2.0, 3.0));
        assert!((moved.centroid() - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-9);
        let sphere = Mesh::sphere(0.05, 96);
        assert!((sphere.volume() / (TAU * 2.0 / 3.0 * 0.05f64.powi(3)) - 1.0).abs() < 5e-3);
        let cup = Mesh::lathe(&[(0.03, 0.0), (0.03, 0.1), (0.025, 0.1), (0.025, 0.01), (0.0, 0.01)], 64);
        let expected = TAU / 2.0 * (0.03f64.powi(2) * 0.1 - 0.025f64.powi(2) * 0.09);
        assert!((cup.volume() / expected - 1.0).abs() < 5e-3);
    }
}
