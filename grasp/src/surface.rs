use nalgebra::{Point3, Vector3};

use crate::Fusion;

/// A point where the fused field crosses zero, with the outward normal. Cube frame, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position.
    pub position: Point3<f64>,
    /// Unit normal, towards free space.
    pub normal: Vector3<f64>,
}

impl Fusion {
    /// The observed surface: every zero crossing between neighbouring voxels, as in Open3D's `ExtractPointCloud`.
    #[must_use]
    pub fn surface(&self) -> Vec<SurfacePoint> {
        let n = self.resolution();
        let stride = [n * n, n, 1];
        let mut points = Vec::new();
        for index in 0..n.pow(3) {
            let Some(here) = self.near_surface(index) else { continue };
            let cell = [index / (n * n), index / n % n, index % n];
            // At the faces of the cube there is nothing on one side to take a normal from.
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

    /// Central difference of the field over 0.99 of a voxel to each side, as Open3D takes it.
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
}
