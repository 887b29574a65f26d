//! What pictures of grasps have in common.

use grasp_picture::{Color, Mesh, Picture};
use nalgebra::{Isometry3, Point3, Translation3};

/// Number of grasps that are drawn, best first. More would hide each other.
pub(crate) const SHOWN: usize = 40;

/// Edges of the workspace.
const EDGE: Color = [170, 170, 170];

/// Outline of the table's height.
const TABLE: Color = [205, 150, 70];

/// The x, y and z axes.
const AXES: [Color; 3] = [[214, 48, 49], [38, 166, 91], [41, 98, 255]];

/// The edges of the workspace, the height of the table on its sides, and the axes of the task frame.
pub(crate) fn frame(picture: &mut Picture, size: f64, table: f64) {
    let thickness = size / 300.0;
    let corner = |index: usize| Point3::from([0, 1, 2].map(|axis| if index >> axis & 1 == 1 { size } else { 0.0 }));
    // From each corner along the axes for which it is on the lower side.
    let edges = (0..8).flat_map(|from| [1, 2, 4].map(|axis| (from, from | axis))).filter(|(from, to)| from != to);
    let edges: Vec<Mesh> = edges.map(|(from, to)| bar(corner(from), corner(to), thickness)).collect();
    picture.mesh(&Mesh::union(&edges), &Isometry3::identity(), 1.0, EDGE);
    if (0.0..=size).contains(&table) {
        let at = |index: usize| Point3::new(corner(index).x, corner(index).y, table);
        let sides = [(0, 1), (1, 3), (3, 2), (2, 0)].map(|(from, to)| bar(at(from), at(to), thickness));
        picture.mesh(&Mesh::union(&sides), &Isometry3::identity(), 1.0, TABLE);
    }
    for (axis, color) in AXES.into_iter().enumerate() {
        let mut end = Point3::origin();
        end[axis] = 0.25 * size;
        picture.mesh(&bar(Point3::origin(), end, 4.0 * thickness), &Isometry3::identity(), 1.0, color);
    }
}

/// An axis-aligned bar between two points.
fn bar(from: Point3<f64>, to: Point3<f64>, thickness: f64) -> Mesh {
    let middle = Translation3::from(nalgebra::center(&from, &to));
    Mesh::cuboid((to - from).abs().add_scalar(thickness)).transformed(&middle.into())
}
