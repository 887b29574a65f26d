use nalgebra::{Isometry3, Point3, Vector3};

use super::{Candidate, Cloud, VOXEL_SIZE};

/// Pixels along an edge of an image.
pub const IMAGE_SIZE: usize = 60;

/// Channels of an image: three for normals and one for depth in each of three projections.
///
/// GPD defines images of 3, 12 and 15 channels. The 15-channel image adds shadows, which need ray casting for every
/// candidate; 12 channels show the shape from all sides without them.
pub const CHANNELS: usize = 12;

/// Region of the image: between the fingers, 1 cm beyond the fingertips, and one finger breadth on each side. Smallest
/// and largest coordinates in the grasp frame, metres (GPD: `image_height`, `image_outer_diameter`, `image_depth`).
const REGION: [[f64; 3]; 2] = [[-0.02, -0.05, 0.0], [0.02, 0.05, 0.06]];

/// The surface between the fingers of a candidate, as input of the classifier.
///
/// The points of the region are projected along x, y and z of the grasp frame. Each projection has four channels: the
/// absolute components of the normals along x, y and z, and the nearness, which is 1 at the smallest coordinate along
/// the projection and 0 at the largest. A pixel holds the mean over its points, 0 without points. A point covers the
/// area of its voxel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    pixels: Vec<u8>,
}

impl Image {
    /// Shape of an image: channels, rows and columns.
    pub const SHAPE: [usize; 3] = [CHANNELS, IMAGE_SIZE, IMAGE_SIZE];

    /// The image of a candidate in its cloud.
    #[must_use]
    pub fn of(cloud: &Cloud, candidate: &Candidate) -> Self {
        let points = in_region(cloud, &candidate.pose);
        let mut pixels = Vec::with_capacity(CHANNELS * IMAGE_SIZE * IMAGE_SIZE);
        for axis in 0..3 {
            project(&points, axis, &mut pixels);
        }
        Self { pixels }
    }

    /// Pixels, `[CHANNELS, IMAGE_SIZE, IMAGE_SIZE]`; 255 stands for 1.
    #[must_use]
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// Writes the pixels to the input of a classifier: values in [0, 1].
    pub fn write(&self, values: &mut [f32]) {
        for (value, &pixel) in values.iter_mut().zip(&self.pixels) {
            *value = f32::from(pixel) / 255.0;
        }
    }
}

/// A point of the region in unit cube coordinates, with the absolute components of its normal.
struct Point {
    position: [f64; 3],
    normal: [f32; 3],
}

fn in_region(cloud: &Cloud, pose: &Isometry3<f64>) -> Vec<Point> {
    let [lower, upper] = REGION.map(Vector3::from);
    let size = upper - lower;
    let centre = pose * Point3::from((lower + upper) / 2.0);
    let near = cloud.within(centre, size.norm() / 2.0);
    near.map(|point| {
        let position = (pose.inverse_transform_point(&point.position).coords - lower).component_div(&size);
        let normal = pose.rotation.inverse() * point.normal;
        Point { position: position.into(), normal: normal.map(|component| component.abs() as f32).into() }
    })
    .filter(|point| point.position.iter().all(|coordinate| (0.0..1.0).contains(coordinate)))
    .collect()
}

/// Appends the four channels of the projection along `axis`. Rows and columns are the other two axes in ascending
/// order.
fn project(points: &[Point], axis: usize, pixels: &mut Vec<u8>) {
    let plane = [[1, 2], [0, 2], [0, 1]][axis];
    let mut sums = vec![[0.0_f32; 5]; IMAGE_SIZE * IMAGE_SIZE];
    for Point { position, normal: [x, y, z] } in points {
        let nearness = 1.0 - position[axis] as f32;
        let [rows, columns] = plane.map(|axis| covered(position[axis], REGION[1][axis] - REGION[0][axis]));
        for row in rows {
            for sum in &mut sums[row * IMAGE_SIZE..][columns.clone()] {
                for (sum, value) in sum.iter_mut().zip([*x, *y, *z, nearness, 1.0]) {
                    *sum += value;
                }
            }
        }
    }
    for channel in 0..4 {
        pixels.extend(sums.iter().map(|sum| (255.0 * sum[channel] / sum[4].max(1.0)).round() as u8));
    }
}

/// The pixels that a voxel centred at `position`, in [0, 1), covers along an axis of `length` metres.
fn covered(position: f64, length: f64) -> std::ops::Range<usize> {
    let half = VOXEL_SIZE / length / 2.0;
    let pixel = |position: f64| (position.clamp(0.0, 1.0) * IMAGE_SIZE as f64) as usize;
    pixel(position - half)..(pixel(position + half) + 1).min(IMAGE_SIZE)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::SurfacePoint;

    const AREA: usize = IMAGE_SIZE * IMAGE_SIZE;

    fn candidate() -> Candidate {
        Candidate { pose: Isometry3::identity(), width: 0.04, point: Point3::origin() }
    }

    /// The two faces of a slab between the fingers, 4 cm apart.
    fn slab() -> Cloud {
        let mut points = Vec::new();
        for (i, j) in (-30..=30).flat_map(|i| (0..=30).map(move |j| (i, j))) {
            let (x, z) = (f64::from(i) * 1e-3, 0.03 + f64::from(j) * 1e-3);
            for side in [-1.0, 1.0] {
                points.push(SurfacePoint { position: Point3::new(x, 0.02 * side, z), normal: Vector3::y() * side });
            }
        }
        Cloud::new(points)
    }

    #[test]
    fn an_image_shows_the_surfaces_between_the_fingers() {
        let image = Image::of(&slab(), &candidate());
        assert_eq!(image.pixels().len(), CHANNELS * AREA);
        let channel = |index: usize| &image.pixels()[index * AREA..][..AREA];
        // Projection along x: rows are y, columns are z; the faces are two lines at y = ±0.02.
        let normals_along_y = channel(1);
        let row = |y: f64| ((y + 0.05) / 0.1 * IMAGE_SIZE as f64) as usize;
        let column = |z: f64| (z / 0.06 * IMAGE_SIZE as f64) as usize;
        for y in [-0.0199, 0.0199] {
            assert!(normals_along_y[row(y) * IMAGE_SIZE + column(0.045)] > 250, "the normal is along y");
        }
        assert_eq!(normals_along_y[row(0.0) * IMAGE_SIZE + column(0.045)], 0, "the slab is empty inside");
        assert_eq!(normals_along_y[row(0.02) * IMAGE_SIZE + column(0.01)], 0, "no surface near the palm");
        assert!(channel(0).iter().all(|&value| value < 30), "no normal is along x");
    }

    #[test]
    fn a_symmetric_object_gives_a_similar_image_after_half_a_turn() {
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
        let cloud = slab();
        let [here, there] = [Isometry3::identity(), Isometry3::from_parts(Default::default(), turned)]
            .map(|pose| Image::of(&cloud, &Candidate { pose, ..candidate() }));
        let lit = |image: &Image| image.pixels().iter().map(|&value| f64::from(value)).sum::<f64>();
        let difference: f64 = here.pixels().iter().zip(there.pixels()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        // The voxel grid of the cloud is not symmetric.
        assert!(difference < 0.3 * lit(&here), "{difference} of {}", lit(&here));
        assert!((lit(&here) / lit(&there) - 1.0).abs() < 0.05);
    }

    #[test]
    fn points_outside_the_region_are_not_shown() {
        let far = |position| SurfacePoint { position, normal: Vector3::z() };
        let points = [Point3::new(0.0, 0.06, 0.03), Point3::new(0.03, 0.0, 0.03), Point3::new(0.0, 0.0, -0.01)];
        let image = Image::of(&Cloud::new(points.map(far)), &candidate());
        assert!(image.pixels().iter().all(|&value| value == 0));
        let image = Image::of(&Cloud::new([far(Point3::new(0.0, 0.0, 0.015))]), &candidate());
        let nearness = image.pixels()[11 * AREA..].iter().max();
        assert_eq!(nearness, Some(&191), "a quarter of the way along z");
    }
}
