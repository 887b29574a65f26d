//! What stands on a table, divided into objects.

mod grid;
mod hull;
mod walls;

use std::collections::BTreeSet;

use grasp::DepthImage;
use nalgebra::Isometry3;

use self::grid::{Grid, NOISE, STEP};

/// What stands on the table in a depth image. Objects that touch each other may be one.
#[derive(Clone, Debug)]
pub(crate) struct Segmentation {
    /// Objects that a hand may lift; the label of the first is 1.
    pub objects: Vec<Object>,
    /// Label of each sampled pixel, row by row: 0 is no object, and labels after those of the objects are other things:
    /// what the image cuts off, walls and rims of bins, and what hangs over the edge of the table.
    labels: Vec<u16>,
    /// Distance between sampled pixels.
    step: usize,
}

/// An object on a table.
#[derive(Clone, Debug)]
pub(crate) struct Object {
    /// Its points along the table, metres, with the weight of each: the area that the pixel shows, less for pixels that
    /// are far from the middle of the image.
    pub points: Vec<([f64; 2], f64)>,
}

/// A thing with a smaller visible area, m², that is beside other things in the image is a fragment of them: depth
/// cameras have holes at edges.
const FRAGMENT: f64 = 6e-4;

/// Things longer than this, metres, may be a bin with objects that touch its walls.
const LONGEST: f64 = 0.5;

/// Distance from the hull of the visible table within which things stand on it, metres.
const OVERHANG: f64 = 0.03;

impl Segmentation {
    /// Divides what stands on the table in an image. `camera_from_table` is the pose of a frame whose plane z = 0 is
    /// the table.
    pub fn new(image: &DepthImage, camera_from_table: &Isometry3<f64>) -> Self {
        let grid = Grid::new(image, camera_from_table);
        let stands = |index: &usize| grid.is_above_table(*index) && grid.is_over_table(*index, OVERHANG);
        let mut objects: Vec<Vec<usize>> = Vec::new();
        let mut others: Vec<Vec<usize>> = Vec::new();
        for thing in grid.things((0..grid.points.len()).filter(stands).collect()) {
            if grid.length(&thing) <= LONGEST {
                if grid.is_whole(&thing) {
                    objects.push(thing)
                } else {
                    others.push(thing)
                };
                continue;
            }
            let (walls, rest) = grid.without_walls(thing);
            others.extend(walls);
            let (whole, cut): (Vec<_>, Vec<_>) = grid.things(rest).into_iter().partition(|part| grid.is_whole(part));
            objects.extend(whole);
            others.extend(cut);
        }
        let mut is_other = vec![false; grid.points.len()];
        others.iter().flatten().for_each(|&index| is_other[index] = true);
        let (objects, fragments): (Vec<_>, Vec<_>) =
            objects.into_iter().partition(|thing| grid.area(thing) >= FRAGMENT || !grid.is_near(thing, &is_other));
        others.extend(fragments);
        let mut labels = vec![0; grid.points.len()];
        for (pixels, label) in objects.iter().chain(&others).zip(1..=u16::MAX) {
            pixels.iter().for_each(|&index| labels[index] = label);
        }
        let objects = objects.iter().map(|pixels| grid.object(pixels)).collect();
        Self { objects, labels, step: grid.step }
    }

    /// The objects in a frame whose axes are those of the table, moved by `offset` metres.
    pub fn moved(mut self, offset: [f64; 2]) -> Self {
        let points = self.objects.iter_mut().flat_map(|object| &mut object.points);
        points.for_each(|(at, _)| *at = [at[0] + offset[0], at[1] + offset[1]]);
        self
    }

    /// The labels of the objects.
    pub fn labels_of_objects(&self) -> BTreeSet<u16> {
        (1..=u16::MAX).take(self.objects.len()).collect()
    }

    /// The label of each pixel of the image, row by row.
    pub fn labels(&self, image: &DepthImage) -> Vec<u16> {
        let (width, depth) = (image.intrinsics().width, image.depth());
        let columns = width.div_ceil(self.step);
        let label = |(index, &own): (usize, &f32)| {
            let (u, v) = (index % width / self.step, index / width / self.step);
            let sampled = depth[v * self.step * width + u * self.step];
            // A pixel between two samples belongs to the first if it is on the same surface.
            let is_same = (own - sampled).abs() as f64 <= STEP + NOISE * f64::from(own);
            if is_same { self.labels[v * columns + u] } else { 0 }
        };
        depth.iter().enumerate().map(label).collect()
    }
}

#[cfg(test)]
mod tests {
    use grasp::Intrinsics;
    use nalgebra::Vector3;

    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 320, height: 240, fx: 300.0, fy: 300.0, cx: 159.5, cy: 119.5 };

    /// Distance of the camera from the table below it, metres.
    const DISTANCE: f64 = 0.8;

    /// The image of boxes (lower and upper corner, metres) on a table straight below the camera, and what stands on it.
    fn segmentation(table: [[f64; 2]; 2], boxes: &[[[f64; 3]; 2]]) -> (Segmentation, Vec<u16>) {
        let depth = |index: usize| {
            let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
            let [x, y] = [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy];
            let over = |z: f64, low: [f64; 2], high: [f64; 2]| {
                let at = [x * z, y * z];
                (0..2).all(|axis| (low[axis]..high[axis]).contains(&at[axis]))
            };
            let tops = boxes.iter().filter_map(|[low, high]| {
                let z = DISTANCE - high[2];
                over(z, [low[0], low[1]], [high[0], high[1]]).then_some(z)
            });
            let below = if over(DISTANCE, table[0], table[1]) { DISTANCE } else { DISTANCE + 0.5 };
            tops.fold(below, f64::min) as f32
        };
        let depths: Vec<f32> = (0..CAMERA.width * CAMERA.height).map(depth).collect();
        let image = DepthImage::new(CAMERA, depths).unwrap();
        // z points to the camera.
        let down = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let camera_from_table = Isometry3::from_parts(nalgebra::Translation3::new(0.0, 0.0, DISTANCE), down);
        let segmentation = Segmentation::new(&image, &camera_from_table);
        let labels = segmentation.labels(&image);
        (segmentation, labels)
    }

    /// The label at a point of the table below the camera.
    fn label_at(labels: &[u16], [x, y]: [f64; 2], height: f64) -> u16 {
        let z = DISTANCE - height;
        let [u, v] = [x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy].map(f64::round);
        labels[v as usize * CAMERA.width + u as usize]
    }

    const EVERYWHERE: [[f64; 2]; 2] = [[-9.0; 2], [9.0; 2]];

    #[test]
    fn each_object_has_a_label() {
        let large = [[-0.2, -0.1, 0.0], [-0.1, 0.1, 0.08]];
        let small = [[0.1, 0.0, 0.0], [0.14, 0.03, 0.03]];
        let (segmentation, labels) = segmentation(EVERYWHERE, &[small, large]);
        assert_eq!(segmentation.labels_of_objects(), [1, 2].into());
        assert_eq!([[-0.15, 0.0], [0.12, 0.015], [0.0, 0.0]].map(|at| label_at(&labels, at, 0.0)), [1, 2, 0]);
        let points = &segmentation.objects[1].points;
        // y of the table is opposite to that of the image.
        assert!(
            points.iter().all(|([x, y], _)| (0.095..0.145).contains(x) && (-0.035..0.005).contains(y)),
            "{points:?}"
        );
    }

    #[test]
    fn what_the_image_cuts_off_and_what_is_beside_the_table_is_no_object() {
        let arm = [[0.1, -0.02, 0.0], [9.0, 0.04, 0.1]];
        let object = [[-0.1, -0.02, 0.0], [-0.04, 0.04, 0.1]];
        let (found, labels) = segmentation(EVERYWHERE, &[arm, object]);
        assert_eq!(found.objects.len(), 1);
        assert_eq!([label_at(&labels, [-0.07, 0.0], 0.1), label_at(&labels, [0.2, 0.0], 0.1)], [1, 2]);
        // The rim of a bin, whose floor is the table, is higher than the object.
        let bin = [[-0.2, -0.15], [0.2, 0.15]];
        let walls = [
            [[-0.22, -0.17, 0.0], [0.22, -0.15, 0.15]],
            [[-0.22, 0.15, 0.0], [0.22, 0.17, 0.15]],
            [[-0.22, -0.17, 0.0], [-0.2, 0.17, 0.15]],
            [[0.2, -0.17, 0.0], [0.22, 0.17, 0.15]],
        ];
        let (found, labels) = segmentation(bin, &[walls.as_slice(), &[object]].concat());
        assert_eq!(found.objects.len(), 1);
        assert_eq!(label_at(&labels, [-0.07, 0.0], 0.1), 1);
    }
}
