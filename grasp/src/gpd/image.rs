use nalgebra::{Isometry3, Point3, Vector3};

use super::{Candidate, Cloud, VOXEL_SIZE};

/// Pixels along an edge of an image.
pub const IMAGE_SIZE: usize = 60;

/// Pixels of a channel.
const AREA: usize = IMAGE_SIZE * IMAGE_SIZE;

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
    pub fn new(cloud: &Cloud, candidate: &Candidate) -> Self {
        let points = in_region(cloud, &candidate.pose);
        let mut pixels = vec![0; CHANNELS * AREA];
        for (axis, channels) in pixels.chunks_exact_mut(4 * AREA).enumerate() {
            project(&points, axis, channels);
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
    // A matrix rotates many points faster than a quaternion.
    let to_hand = pose.rotation.inverse().to_rotation_matrix();
    let in_region = |point: &Point3<f64>| to_hand * (point.coords - pose.translation.vector) - lower;
    let is_near = |position: &Vector3<f64>, margin: f64| {
        (0..3).all(|axis| (-margin..size[axis] + margin).contains(&position[axis]))
    };
    let points = cloud.in_cells(|centre, radius| is_near(&in_region(centre), radius));
    points
        .map(|point| (in_region(&point.position), point))
        .filter(|(position, _)| is_near(position, 0.0))
        .map(|(position, point)| Point {
            position: position.component_div(&size).into(),
            normal: (to_hand * point.normal).map(|component| component.abs() as f32).into(),
        })
        .collect()
}

/// Draws the four channels of the projection along `axis`, which are 0. Rows and columns are the other two axes in
/// ascending order.
fn project(points: &[Point], axis: usize, channels: &mut [u8]) {
    let [rows, columns] = [[1, 2], [0, 2], [0, 1]][axis];
    let covered = |position: &[f64; 3], axis: usize| covered(position[axis], REGION[1][axis] - REGION[0][axis]);
    let mut sums = vec![[0.0_f32; 4]; AREA];
    let mut counts = vec![0.0_f32; AREA];
    for Point { position, normal: [x, y, z] } in points {
        let values = [*x, *y, *z, 1.0 - position[axis] as f32];
        let columns = covered(position, columns);
        for row in covered(position, rows) {
            let span = row * IMAGE_SIZE + columns.start..row * IMAGE_SIZE + columns.end;
            for (sum, count) in sums[span.clone()].iter_mut().zip(&mut counts[span]) {
                for (sum, value) in sum.iter_mut().zip(values) {
                    *sum += value;
                }
                *count += 1.0;
            }
        }
    }
    for (pixel, (sum, count)) in sums.iter().zip(&counts).enumerate().filter(|(_, (_, count))| **count > 0.0) {
        for (channel, value) in sum.iter().enumerate() {
            // Adding 0.5 rounds, because no value is negative.
            channels[channel * AREA + pixel] = (255.0 * value / count + 0.5) as u8;
        }
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
        let image = Image::new(&slab(), &candidate());
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
            .map(|pose| Image::new(&cloud, &Candidate { pose, ..candidate() }));
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
        let image = Image::new(&Cloud::new(points.map(far)), &candidate());
        assert!(image.pixels().iter().all(|&value| value == 0));
        let image = Image::new(&Cloud::new([far(Point3::new(0.0, 0.0, 0.015))]), &candidate());
        let nearness = image.pixels()[11 * AREA..].iter().max();
        assert_eq!(nearness, Some(&191), "a quarter of the way along z");
    }

    #[test]
    fn a_pixel_is_the_rounded_mean_of_its_points() {
        let at = |z| SurfacePoint { position: Point3::new(0.0, 0.0, z), normal: Vector3::z() };
        let image = Image::new(&Cloud::new([at(0.015), at(0.03)]), &candidate());
        // Along z: 1 - (0.25 + 0.5) / 2 = 0.625, times 255 = 159.4.
        let nearness = image.pixels()[11 * AREA..].iter().filter(|&&value| value > 0);
        assert!(nearness.clone().count() > 0 && nearness.clone().all(|&value| value == 159));
    }
}
