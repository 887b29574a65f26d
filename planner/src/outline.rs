//! How the pads lie against the outline of an object.

use std::collections::HashMap;
use std::f64::consts::PI;

use grasp::{Hand, SurfacePoint, Volume};
use nalgebra::{Isometry3, Point3, Vector3};

use crate::hand_fit::object_points;

/// Edge of the cells of the search for points, metres.
const CELL: f64 = 0.03;

/// Strips across the pads in which the outline is measured, and the fewest that a line is fitted to.
const STRIPS: usize = 5;
const FEWEST: usize = 4;

/// Angle between a pad and the outline up to which a grasp is as good as one that lies flat: the cone of friction 0.5. In
/// the simulation, with friction 1, an object turns between the pads until it lies flat.
const FRICTION_CONE: f64 = 27.0 * PI / 180.0;

/// Angle at which a grasp would be half as good, and the lowest factor: a sure grasp that is not flat comes after the
/// others, and is still one.
const HALF: f64 = PI / 4.0;
const LOWEST: f64 = 0.75;

/// The observed points of the objects in a volume.
pub(crate) struct Outlines {
    cells: HashMap<[i32; 3], Vec<Point3<f64>>>,
    /// From the frame of the grasps to that of the points.
    from_frame: Isometry3<f64>,
    hand: Hand,
}

impl Outlines {
    /// The `surface` of a volume, without that of a table at the height `table`, metres.
    pub(crate) fn new(surface: &[SurfacePoint], volume: &Volume, table: Option<f64>, hand: Hand) -> Self {
        let size = volume.resolution() as f64 * volume.voxel_size();
        let mut cells: HashMap<_, Vec<_>> = HashMap::new();
        for point in object_points(surface, size, table.unwrap_or(f64::NEG_INFINITY)) {
            cells.entry(cell(&point.position)).or_default().push(point.position);
        }
        Self { cells, from_frame: volume.pose().inverse(), hand }
    }

    pub(crate) fn hand(&self) -> &Hand {
        &self.hand
    }

    /// The factor by which the angle between the pads and the outline lowers the probability of success: 1 if the pads lie
    /// flat, or if too little of the outline was seen.
    pub(crate) fn agreement(&self, pose: &Isometry3<f64>) -> f32 {
        // Distance from the middle of the pads along x, and from the middle of the hand along y.
        let half_breadth = self.hand.height / 2.0;
        let strip = |x: f64| ((x / half_breadth + 1.0) / 2.0 * STRIPS as f64) as usize;
        let mut sides = [[f64::NEG_INFINITY; STRIPS]; 2];
        for point in self.between(&(self.from_frame * pose)) {
            let strip = strip(point.x).min(STRIPS - 1);
            sides[0][strip] = sides[0][strip].max(-point.y);
            sides[1][strip] = sides[1][strip].max(point.y);
        }
        let [left, right] = sides.map(|side| slope(&side, 2.0 * half_breadth / STRIPS as f64));
        // Turned about the approach both sides are inclined in the same direction, on a wedge in opposite ones.
        let angle = f64::max((right - left).abs(), (right + left).abs()) / 2.0;
        let excess = (angle.atan() - FRICTION_CONE).max(0.0);
        (1.0 - 0.5 * excess / (HALF - FRICTION_CONE)).max(LOWEST) as f32
    }

    /// The points between the fingers of a hand at `pose`, in its frame.
    fn between(&self, pose: &Isometry3<f64>) -> impl Iterator<Item = Point3<f64>> {
        let (inverse, hand) = (pose.inverse(), self.hand);
        let corner = Vector3::new(hand.height / 2.0, hand.half_opening(), hand.depth / 2.0);
        let middle = pose * Point3::new(0.0, 0.0, corner.z);
        let reach = pose.rotation.to_rotation_matrix().matrix().abs() * corner;
        let [low, high] = [middle - reach, middle + reach].map(|point| cell(&point));
        let cells = (low[0]..=high[0])
            .flat_map(move |x| (low[1]..=high[1]).flat_map(move |y| (low[2]..=high[2]).map(move |z| [x, y, z])));
        let points = cells.filter_map(|cell| self.cells.get(&cell)).flatten().map(move |point| inverse * point);
        points.filter(move |p| p.x.abs() < corner.x && p.y.abs() < corner.y && (0.0..2.0 * corner.z).contains(&p.z))
    }
}

fn cell(point: &Point3<f64>) -> [i32; 3] {
    point.coords.map(|c| (c / CELL).floor() as i32).into()
}

/// Slope of the line through the strips' outermost points, `step` metres apart; 0 if too few strips have points.
fn slope(side: &[f64; STRIPS], step: f64) -> f64 {
    let seen = || side.iter().enumerate().filter(|(_, y)| y.is_finite()).map(|(index, y)| (index as f64 * step, *y));
    let count = seen().count();
    if count < FEWEST {
        return 0.0;
    }
    let mean_of = |value: fn((f64, f64)) -> f64| seen().map(value).sum::<f64>() / count as f64;
    let (x_mean, y_mean) = (mean_of(|(x, _)| x), mean_of(|(_, y)| y));
    let covariance: f64 = seen().map(|(x, y)| (x - x_mean) * (y - y_mean)).sum();
    covariance / seen().map(|(x, _)| (x - x_mean).powi(2)).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use grasp::{DepthImage, Fusion, Intrinsics, RESOLUTION, WORKSPACE_SIZE};
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;
    use crate::hand_fit::surface;

    /// A bar along x, 40 mm wide, 60 mm above a wall, seen from above.
    fn bar() -> Volume {
        let camera = Intrinsics::BENCHMARK;
        let (width, height) = (camera.width, camera.height);
        let y = |row: usize| (row as f64 - camera.cy) / camera.fy * 0.5;
        let is_bar = |pixel: usize| y(pixel / width).abs() < 0.02;
        let depth: Vec<f32> = (0..width * height).map(|pixel| if is_bar(pixel) { 0.5 } else { 0.56 }).collect();
        let image = DepthImage::new(camera, &depth).unwrap();
        let camera_from_task = Isometry3::translation(-0.15, -0.15, 0.35);
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        fusion.integrate(&image, &camera_from_task);
        fusion.detailed_volume(Isometry3::identity(), &[(image, camera_from_task)]).unwrap()
    }

    #[test]
    fn a_turned_hand_agrees_less() {
        let volume = bar();
        let outlines = Outlines::new(&surface(&volume), &volume, None, Hand::PANDA);
        // The fingertips are 30 mm below the top of the bar, which is at z = 0.15.
        let at = |degrees: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), degrees.to_radians());
            let pose = Isometry3::from_parts(Translation3::new(0.15, 0.15, 0.13), turn);
            outlines.agreement(&pose)
        };
        assert_eq!((at(0.0), at(-10.0)), (1.0, 1.0));
        assert!((0.76..0.95).contains(&at(32.0)) && (0.76..0.95).contains(&at(-32.0)), "{} {}", at(32.0), at(-32.0));
        assert_eq!(at(45.0), LOWEST as f32);
        let beside = Isometry3::translation(0.15, 0.0, 0.02);
        assert_eq!(outlines.agreement(&beside), 1.0, "nothing between the fingers");
    }
}
