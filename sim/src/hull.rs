//! Convex hulls with the algorithm of the physics engine.

use grasp_picture::Mesh;
use nalgebra::Point3;
use rapier3d::parry;

/// Smallest volume of a hull, m³.
const LEAST_VOLUME: f64 = 1e-10;

/// The convex hull of `points`; `None` if they enclose no volume.
///
/// Computed with parry in single precision, as in the physics engine.
pub fn convex_hull(points: &[Point3<f64>]) -> Option<Mesh> {
    let mut points: Vec<[f32; 3]> = points.iter().map(|p| p.coords.cast().into()).collect();
    if points.iter().flatten().any(|x| !x.is_finite()) {
        return None;
    }
    // parry's quickhull fails on repeated points.
    points.sort_by(|a, b| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal));
    points.dedup();
    let points: Vec<_> = points.into_iter().map(Into::into).collect();
    let (vertices, triangles) = parry::transformation::try_convex_hull(&points).ok()?;
    let vertices = vertices.iter().map(|p| Point3::new(p.x, p.y, p.z).cast()).collect();
    let hull = Mesh { vertices, triangles };
    (hull.volume() > LEAST_VOLUME).then_some(hull)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn hull_encloses_its_points_and_winds_outward() {
        let sphere = Mesh::sphere(0.04, 24);
        let mut points = sphere.vertices.clone();
        points.push(Point3::origin());
        points.extend_from_slice(&sphere.vertices);
        let hull = convex_hull(&points).unwrap();
        assert_eq!(hull.vertices.len(), sphere.vertices.len());
        assert!((hull.volume() - sphere.volume()).abs() < 1e-9);
    }

    #[test]
    fn flat_and_bad_points_have_no_hull() {
        let flat: Vec<_> = Mesh::cuboid(Vector3::new(0.1, 0.1, 0.0)).vertices;
        assert_eq!(convex_hull(&flat), None);
        assert_eq!(convex_hull(&flat[..2]), None);
        assert_eq!(convex_hull(&[Point3::new(f64::NAN, 0.0, 0.0); 5]), None);
    }
}
