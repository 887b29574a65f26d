//! Building blocks: solids of convex parts, and ways to place and join them.
//!
//! Solids are built standing on z = 0 with their axis along z, unless they say otherwise.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Point3, Rotation3, Vector3};

use crate::hull::convex_hull;
use grasp_picture::Mesh;

/// Maximum number of vertices of a part. The physics engine iterates over all of them at every contact.
const MOST_VERTICES: usize = 64;

/// A solid of convex parts, metres.
#[derive(Clone, Debug, Default)]
pub(super) struct Shape {
    pub(super) parts: Vec<Mesh>,
}

impl Shape {
    /// The convex hull of points; empty if they enclose no volume.
    pub(super) fn hull(points: impl IntoIterator<Item = Point3<f64>>) -> Shape {
        let points: Vec<_> = points.into_iter().collect();
        Shape { parts: convex_hull(&points).into_iter().collect() }
    }

    /// Both solids.
    pub(super) fn and(mut self, other: Shape) -> Shape {
        self.parts.extend(other.parts);
        self
    }

    /// All the solids.
    pub(super) fn all(shapes: impl IntoIterator<Item = Shape>) -> Shape {
        shapes.into_iter().fold(Shape::default(), Shape::and)
    }

    pub(super) fn shifted(self, x: f64, y: f64, z: f64) -> Shape {
        self.moved(&Isometry3::translation(x, y, z))
    }

    /// Rotated about the x axis by `angle` radians.
    pub(super) fn turned_x(self, angle: f64) -> Shape {
        self.moved(&Isometry3::rotation(Vector3::x() * angle))
    }

    /// Rotated about the y axis by `angle` radians.
    pub(super) fn turned_y(self, angle: f64) -> Shape {
        self.moved(&Isometry3::rotation(Vector3::y() * angle))
    }

    /// Rotated about the z axis by `angle` radians.
    pub(super) fn turned_z(self, angle: f64) -> Shape {
        self.moved(&Isometry3::rotation(Vector3::z() * angle))
    }

    /// Rotated so that its axis, z, points along x.
    pub(super) fn laid_down(self) -> Shape {
        self.turned_y(TAU / 4.0)
    }

    /// Scaled along the axes by positive factors.
    pub(super) fn stretched(self, x: f64, y: f64, z: f64) -> Shape {
        self.mapped(|p| Point3::new(p.x * x, p.y * y, p.z * z))
    }

    /// The bounding box of all parts.
    pub(super) fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        Mesh::union(&self.parts).bounds()
    }

    fn moved(self, pose: &Isometry3<f64>) -> Shape {
        self.mapped(|p| pose * p)
    }

    fn mapped(self, f: impl Fn(Point3<f64>) -> Point3<f64>) -> Shape {
        Shape { parts: self.parts.iter().map(|part| part.mapped(&f)).collect() }
    }
}

/// A box whose edges are cut off by `chamfer`.
pub(super) fn block(x: f64, y: f64, z: f64, chamfer: f64) -> Shape {
    let half = Vector3::new(x, y, z) / 2.0;
    let inset = half.add_scalar(-chamfer.min(half.min() * 0.9));
    let corner = |i: usize, axis: usize| {
        let sign = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        let mut p = inset;
        p[axis] = half[axis];
        Point3::new(sign(0) * p.x, sign(1) * p.y, sign(2) * p.z + half.z)
    };
    Shape::hull((0..8).flat_map(|i| (0..3).map(move |axis| corner(i, axis))))
}

/// A prism of a convex outline (x, y).
pub(super) fn prism(outline: &[(f64, f64)], height: f64) -> Shape {
    Shape::hull([0.0, height].into_iter().flat_map(|z| outline.iter().map(move |&(x, y)| Point3::new(x, y, z))))
}

/// A cylinder or (truncated) cone with these radii at the bottom and the top.
pub(super) fn frustum(bottom: f64, top: f64, height: f64) -> Shape {
    lathe(&[(bottom, 0.0), (top, height)])
}

/// An ellipsoid about the origin.
pub(super) fn ball(x: f64, y: f64, z: f64) -> Shape {
    let bands = 6;
    let profile: Vec<_> = (0..=bands)
        .map(|i| (TAU / 2.0 * f64::from(i) / f64::from(bands)).sin_cos())
        .map(|(sin, cos)| (sin.max(0.0), -cos))
        .collect();
    let points = profile.iter().flat_map(|&(radius, z)| circle(radius, z, 12));
    Shape::hull(points).stretched(x, y, z)
}

/// A solid of revolution about z. The outline is pairs of (radius, z) with increasing z.
///
/// The outline is split where it is concave, so that every part is convex.
pub(super) fn lathe(outline: &[(f64, f64)]) -> Shape {
    let bulges = |i: usize| {
        let ((r0, z0), (r1, z1), (r2, z2)) = (outline[i - 1], outline[i], outline[i + 1]);
        (r1 - r0) * (z2 - z1) - (z1 - z0) * (r2 - r1) > -1e-12
    };
    let mut shape = Shape::default();
    let mut first = 0;
    while first + 1 < outline.len() {
        let mut last = first + 1;
        while last + 1 < outline.len() && last - first < 4 && bulges(last) {
            last += 1;
        }
        let rings = &outline[first..=last];
        let sides = (MOST_VERTICES / rings.len() / 2 * 2).min(24);
        shape = shape.and(Shape::hull(rings.iter().flat_map(|&(radius, z)| circle(radius, z, sides))));
        first = last;
    }
    shape
}

/// A hollow wall about z of `segments` flat pieces, defined by rings of (outer radius, inner radius, z).
pub(super) fn wall(rings: &[(f64, f64, f64)], segments: usize) -> Shape {
    let quad = |ring: (f64, f64, f64), i: usize| {
        [i, i + 1].into_iter().flat_map(move |i| {
            let (sin, cos) = (TAU * i as f64 / segments as f64).sin_cos();
            [ring.0, ring.1].map(|radius| Point3::new(radius * cos, radius * sin, ring.2))
        })
    };
    let piece = |pair: &[(f64, f64, f64)], i: usize| Shape::hull(quad(pair[0], i).chain(quad(pair[1], i)));
    Shape::all(rings.windows(2).flat_map(|pair| (0..segments).map(move |i| piece(pair, i))))
}

/// The cross-section of a [`pipe`]: its half widths in the plane of the path and across it.
#[derive(Clone, Copy, Debug)]
pub(super) enum Section {
    Round(f64, f64),
    Square(f64, f64),
}

/// A pipe along a path in the x–z plane, defined by points with a section at each.
pub(super) fn pipe(path: &[(f64, f64, Section)]) -> Shape {
    let last = path.len() - 1;
    let rings: Vec<_> = (0..=last).map(|i| ring(path[i], path[i.saturating_sub(1)], path[(i + 1).min(last)])).collect();
    Shape::all(rings.windows(2).map(|pair| Shape::hull(pair.iter().flatten().copied())))
}

/// A closed [`pipe`].
pub(super) fn closed_pipe(path: &[(f64, f64, Section)]) -> Shape {
    let n = path.len();
    let rings: Vec<_> = (0..n).map(|i| ring(path[i], path[(i + n - 1) % n], path[(i + 1) % n])).collect();
    Shape::all((0..n).map(|i| Shape::hull(rings[i].iter().chain(&rings[(i + 1) % n]).copied())))
}

/// Points of an arc in the x–z plane about (x, z), from one angle to another: angle 0 is +x, a
/// quarter turn +z.
pub(super) fn arc(x: f64, z: f64, radius: f64, from: f64, to: f64, count: usize) -> Vec<(f64, f64)> {
    let angle = |i: usize| from + (to - from) * i as f64 / (count - 1) as f64;
    (0..count).map(|i| (x + radius * angle(i).cos(), z + radius * angle(i).sin())).collect()
}

/// A path with a constant section.
pub(super) fn uniform(path: Vec<(f64, f64)>, section: Section) -> Vec<(f64, f64, Section)> {
    path.into_iter().map(|(x, z)| (x, z, section)).collect()
}

/// The section of a pipe at a point of its path, perpendicular to the line between the neighbours.
fn ring(at: (f64, f64, Section), before: (f64, f64, Section), after: (f64, f64, Section)) -> Vec<Point3<f64>> {
    let along = Vector3::new(after.0 - before.0, 0.0, after.1 - before.1);
    let turn = Rotation3::rotation_between(&Vector3::z(), &along).unwrap_or_else(|| {
        // Straight down: a rotation by 180° about the axis that preserves the sides of the section.
        Rotation3::from_axis_angle(&Vector3::y_axis(), TAU / 2.0)
    });
    let flat = match at.2 {
        Section::Round(a, b) => circle(1.0, 0.0, 12).map(|p| Point3::new(p.x * a, p.y * b, 0.0)).collect(),
        Section::Square(a, b) => [(a, b), (-a, b), (-a, -b), (a, -b)].map(|(x, y)| Point3::new(x, y, 0.0)).to_vec(),
    };
    let flat: Vec<Point3<f64>> = flat;
    flat.into_iter().map(|p| turn * p + Vector3::new(at.0, 0.0, at.1)).collect()
}

/// Points of a circle about the z axis; a single point if the radius is 0.
fn circle(radius: f64, z: f64, sides: usize) -> impl Iterator<Item = Point3<f64>> {
    let radius = if radius < 1e-6 { 0.0 } else { radius };
    (0..sides).map(move |i| {
        let (sin, cos) = (TAU * i as f64 / sides as f64).sin_cos();
        Point3::new(radius * cos, radius * sin, z)
    })
}
