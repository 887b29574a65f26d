//! What pictures of grasps have in common.

use grasp_picture::{Color, Mesh, Picture};
use nalgebra::{Isometry3, Point3, Translation3, Vector3};

/// Number of grasps that are drawn, best first. More would hide each other.
pub(crate) const SHOWN: usize = 40;

/// Edges of the workspace.
const EDGE: Color = [170, 170, 170];

/// Outline of the table's height.
const TABLE: Color = [205, 150, 70];

/// The x, y and z axes.
const AXES: [Color; 3] = [[214, 48, 49], [38, 166, 91], [41, 98, 255]];

/// A line along an axis of the task frame.
pub(crate) struct Line {
    pub ends: [Point3<f64>; 2],
    pub thickness: f64,
    pub color: Color,
}

/// The edges of a workspace with these lengths, the height of the table on its sides, and the axes of the task frame.
/// Metres. Lines of one colour follow one another.
pub(crate) fn outline(lengths: Vector3<f64>, table: Option<f64>) -> Vec<Line> {
    let thickness = lengths.min() / 300.0;
    let corner =
        |index: usize| Point3::from([0, 1, 2].map(|axis| if index >> axis & 1 == 1 { lengths[axis] } else { 0.0 }));
    // From each corner along the axes for which it is on the lower side.
    let edges = (0..8).flat_map(|from| [1, 2, 4].map(|axis| (from, from | axis))).filter(|(from, to)| from != to);
    let edge = |(from, to): (usize, usize)| Line { ends: [corner(from), corner(to)], thickness, color: EDGE };
    let mut lines: Vec<Line> = edges.map(edge).collect();
    if let Some(height) = table.filter(|height| (0.0..=lengths.z).contains(height)) {
        let at = |index: usize| Point3::new(corner(index).x, corner(index).y, height);
        let side = |(from, to): (usize, usize)| Line { ends: [at(from), at(to)], thickness, color: TABLE };
        lines.extend([(0, 1), (1, 3), (3, 2), (2, 0)].map(side));
    }
    for (axis, color) in AXES.into_iter().enumerate() {
        let mut end = Point3::origin();
        end[axis] = 0.25 * lengths.min();
        lines.push(Line { ends: [Point3::origin(), end], thickness: 4.0 * thickness, color });
    }
    lines
}

/// Adds the outline of a cube.
pub(crate) fn frame(picture: &mut Picture, size: f64, table: Option<f64>) {
    for lines in outline(Vector3::repeat(size), table).chunk_by(|a, b| a.color == b.color) {
        let bars: Vec<Mesh> =
            lines.iter().map(|Line { ends: [from, to], thickness, .. }| bar(*from, *to, *thickness)).collect();
        picture.mesh(&Mesh::union(&bars), &Isometry3::identity(), 1.0, lines[0].color);
    }
}

/// An axis-aligned bar between two points.
fn bar(from: Point3<f64>, to: Point3<f64>, thickness: f64) -> Mesh {
    let middle = Translation3::from(nalgebra::center(&from, &to));
    Mesh::cuboid((to - from).abs().add_scalar(thickness)).transformed(&middle.into())
}
