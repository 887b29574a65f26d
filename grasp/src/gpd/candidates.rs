use std::f64::consts::{FRAC_PI_2, PI};
use std::ops::RangeInclusive;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::Rng;
use rand::seq::index;
use rayon::prelude::*;

use super::Cloud;
use crate::{Hand, SurfacePoint};

/// Larger than the rounding errors of coordinates, metres. Checks that only skip work have this margin.
const ROUNDING: f64 = 1e-9;

/// Parameters of the candidate search. The defaults are those of GPD's code.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// The hand that is fitted.
    pub hand: Hand,
    /// Range of object extents along the closing axis, metres.
    pub aperture: RangeInclusive<f64>,
    /// Number of sample points at which the hand is fitted.
    pub samples: usize,
    /// Radius of the neighbourhood whose normals define the local frame of a sample, metres.
    pub frame_radius: f64,
    /// Number of rotations about the axis of least curvature, evenly over half a turn.
    pub rotations: usize,
    /// Number of offsets along the closing axis, evenly over the opening.
    pub placements: usize,
    /// Distance by which the fingertips initially pass the sample, metres (GPD: `init_bite`).
    pub bite: f64,
    /// Step by which the hand is moved forward, metres.
    pub deepening: f64,
    /// Smallest height of any corner of the hand, metres above z = 0 of the cloud's frame. The table is not in the
    /// cloud.
    pub lowest: f64,
}

impl Params {
    /// GPD's parameters for a hand that stays above `lowest` (metres).
    #[must_use]
    pub fn above(lowest: f64) -> Self {
        Self {
            hand: Hand::GPD,
            aperture: 0.01..=0.07,
            samples: 500,
            frame_radius: 0.01,
            rotations: 8,
            placements: 10,
            bite: 0.01,
            deepening: 0.005,
            lowest,
        }
    }
}

/// A pose at which the hand fits around a part of the cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// `T_task_grasp`: z is the approach, ±y the closing axis, the origin is at the finger base.
    pub pose: Isometry3<f64>,
    /// Extent along the closing axis of the points between the fingers, metres.
    pub width: f64,
    /// The sample point, task frame, metres.
    pub point: Point3<f64>,
}

/// Fits the hand at random sample points of the cloud. For each sample and rotation the result is the middle one of the
/// free offsets, moved forward as far as possible. The same cloud and state of `rng` give the same candidates.
#[must_use]
pub fn candidates(cloud: &Cloud, params: &Params, rng: &mut impl Rng) -> Vec<Candidate> {
    by_sample(cloud, params, rng).flatten().collect()
}

/// Samples that are searched at the same time.
const TOGETHER: usize = 32;

/// Like [`candidates`], lazily, one item per sample, so that the caller can stop early. The search is slow for large
/// clouds and hands.
pub fn by_sample(cloud: &Cloud, params: &Params, rng: &mut impl Rng) -> impl Iterator<Item = Vec<Candidate>> {
    let points = cloud.points();
    let samples = index::sample(rng, points.len(), params.samples.min(points.len())).into_vec();
    let starts = (0..samples.len()).step_by(TOGETHER);
    starts.flat_map(move |start| {
        let samples = &samples[start..samples.len().min(start + TOGETHER)];
        samples.par_iter().map(|&sample| fit_at(cloud, params, &points[sample])).collect::<Vec<_>>()
    })
}

/// The candidates of one sample.
fn fit_at(cloud: &Cloud, params: &Params, sample: &SurfacePoint) -> Vec<Candidate> {
    let (normal, axis) = local_frame(cloud, params, sample);
    let slice = slice(cloud, &params.hand, &sample.position, &axis);
    (0..params.rotations)
        .map(|turn| turn as f64 / params.rotations as f64 * PI - FRAC_PI_2)
        .filter_map(|angle| TurnedHand::new(params, sample.position, normal, axis, angle).fit(cloud, &slice))
        .collect()
}

/// The points that can be between the fingers or collide with them, at any rotation about `axis` and any offset,
/// relative to the sample: those within reach of the hand and within the breadth of its fingers.
fn slice(cloud: &Cloud, hand: &Hand, sample: &Point3<f64>, axis: &Vector3<f64>) -> Vec<Vector3<f64>> {
    let (reach, half) = (hand.outer_diameter + hand.depth, hand.height / 2.0 + ROUNDING);
    let is_near = |offset: &Vector3<f64>, margin: f64| {
        offset.dot(axis).abs() <= half + margin && offset.norm_squared() <= (reach + margin).powi(2)
    };
    let points = cloud.in_cells(|centre, radius| is_near(&(centre - sample), radius));
    points.map(|point| point.position - sample).filter(|offset| is_near(offset, 0.0)).collect()
}

/// The normal and the axis of least curvature at a sample. Along this axis normals vary least.
fn local_frame(cloud: &Cloud, params: &Params, sample: &SurfacePoint) -> (Vector3<f64>, Vector3<f64>) {
    let normals = cloud.within(sample.position, params.frame_radius).map(|point| point.normal);
    let eigen = normals.map(|normal| normal * normal.transpose()).sum::<Matrix3<f64>>().symmetric_eigen();
    let column = |index: usize| -> Vector3<f64> { eigen.eigenvectors.column(index).into() };
    let normal = column(eigen.eigenvalues.imax());
    let normal = if normal.dot(&sample.normal) < 0.0 { -normal } else { normal };
    // On a plane the smallest eigenvalue is degenerate, so the axis is made orthogonal to the normal.
    let axis = column(eigen.eigenvalues.imin());
    (normal, (axis - normal * axis.dot(&normal)).normalize())
}

/// The hand at one rotation about a sample.
struct TurnedHand<'a> {
    params: &'a Params,
    sample: Point3<f64>,
    rotation: UnitQuaternion<f64>,
}

impl<'a> TurnedHand<'a> {
    /// The hand whose approach is against `normal`, turned by `angle` about `axis`.
    fn new(params: &'a Params, sample: Point3<f64>, normal: Vector3<f64>, axis: Vector3<f64>, angle: f64) -> Self {
        let approach = Rotation3::from_axis_angle(&Unit::new_unchecked(axis), angle) * -normal;
        let axes = Matrix3::from_columns(&[axis, approach.cross(&axis), approach]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Self { params, sample, rotation }
    }

    /// The candidate of this rotation, if the hand fits. `slice` holds the points of [`slice`].
    fn fit(&self, cloud: &Cloud, slice: &[Vector3<f64>]) -> Option<Candidate> {
        let Params { hand, bite, deepening, aperture, .. } = self.params;
        // For many rotations the table leaves no offset, and its check needs no points.
        let mut offsets = self.offsets().filter(|&offset| self.is_above_table(offset, *bite)).peekable();
        offsets.peek()?;
        let to_hand = self.rotation.inverse().to_rotation_matrix();
        let slice: Vec<Vector3<f64>> = slice.iter().map(|point| to_hand * point).collect();
        // The hand does not reach beyond its fingertips.
        let reached: Vec<Vector3<f64>> = slice.iter().copied().filter(|point| point.z <= bite + ROUNDING).collect();
        let free: Vec<f64> = offsets.filter(|&offset| self.is_free(&reached, offset, *bite)).collect();
        let offset = *free.get(free.len() / 2)?;
        let bites = (0..).map(|step| bite + f64::from(step) * deepening);
        let bites = bites.take_while(|&bite| bite <= hand.depth + ROUNDING && self.is_above_table(offset, bite));
        let bite = bites.take_while(|&bite| self.is_free(&slice, offset, bite)).last()?;

        let held = slice.iter().map(|point| self.in_hand(point, offset, bite)).filter(|point| hand.contains(point));
        let (lower, upper) = held.fold((f64::MAX, f64::MIN), |(lower, upper), p| (lower.min(p.y), upper.max(p.y)));
        let candidate = Candidate { pose: self.pose(offset, bite), width: upper - lower, point: self.sample };
        // The palm is checked last, because its check is the slowest.
        (aperture.contains(&candidate.width) && palm_is_free(cloud, hand, &candidate.pose)).then_some(candidate)
    }

    /// The offsets along the closing axis.
    fn offsets(&self) -> impl Iterator<Item = f64> {
        let Params { hand, placements, .. } = self.params;
        let share = |placement: usize| (placement as f64 + 0.5) / *placements as f64;
        (0..*placements).map(move |placement| (2.0 * share(placement) - 1.0) * hand.half_opening())
    }

    fn pose(&self, offset: f64, bite: f64) -> Isometry3<f64> {
        let origin = self.sample + self.rotation * Vector3::new(0.0, offset, bite - self.params.hand.depth);
        Isometry3::from_parts(Translation3::from(origin), self.rotation)
    }

    /// A point that is relative to the sample, with the axes of the hand, in the frame of the hand.
    fn in_hand(&self, point: &Vector3<f64>, offset: f64, bite: f64) -> Point3<f64> {
        Point3::new(point.x, point.y - offset, point.z + self.params.hand.depth - bite)
    }

    fn is_above_table(&self, offset: f64, bite: f64) -> bool {
        self.params.hand.lowest_point(&self.pose(offset, bite)) >= self.params.lowest
    }

    fn is_free(&self, points: &[Vector3<f64>], offset: f64, bite: f64) -> bool {
        let hand = &self.params.hand;
        let mut points = points.iter().map(|point| self.in_hand(point, offset, bite));
        points.all(|point| !hand.finger_collides(&point) && !hand.palm_collides(&point))
    }
}

/// The palm is wider than the fingers, so it is checked against the whole cloud.
fn palm_is_free(cloud: &Cloud, hand: &Hand, pose: &Isometry3<f64>) -> bool {
    let to_hand = pose.rotation.inverse().to_rotation_matrix();
    let in_hand = |point: &Point3<f64>| Point3::from(to_hand * (point.coords - pose.translation.vector));
    let mut points = cloud.in_cells(|centre, radius| hand.comes_near(&in_hand(centre), 0.0, radius));
    points.all(|point| !hand.palm_collides(&in_hand(&point.position)))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const TABLE: f64 = 0.05;

    /// A box of 40 × 120 × 80 mm on the table, one point per millimetre on all faces but the bottom.
    fn standing_box() -> Vec<SurfacePoint> {
        let (lower, upper) = (Point3::new(0.13, 0.09, TABLE), Point3::new(0.17, 0.21, TABLE + 0.08));
        let mut points = Vec::new();
        for axis in 0..3 {
            let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
            for (bound, side) in [(lower, -1.0), (upper, 1.0)] {
                let mut normal = Vector3::zeros();
                normal[axis] = side;
                if axis == 2 && side < 0.0 {
                    continue;
                }
                let steps = |axis: usize| ((upper[axis] - lower[axis]) / 1e-3).round() as usize;
                for (i, j) in (0..=steps(u)).flat_map(|i| (0..=steps(v)).map(move |j| (i, j))) {
                    let mut position = bound;
                    position[u] = lower[u] + i as f64 * 1e-3;
                    position[v] = lower[v] + j as f64 * 1e-3;
                    points.push(SurfacePoint { position, normal });
                }
            }
        }
        points
    }

    fn of(points: Vec<SurfacePoint>, seed: u64) -> (Cloud, Vec<Candidate>) {
        let cloud = Cloud::new(points);
        let found = candidates(&cloud, &Params::above(TABLE), &mut ChaCha8Rng::seed_from_u64(seed));
        (cloud, found)
    }

    #[test]
    fn a_box_is_grasped_across_its_narrow_side() {
        let (_, found) = of(standing_box(), 1);
        assert!(found.len() > 50, "{} candidates", found.len());
        let across = |c: &&Candidate| (c.pose.rotation * Vector3::y()).x.abs() > 0.9;
        let count = found.iter().filter(across).count();
        assert!(count > found.len() / 3, "{count} of {} close along x, the side of 40 mm", found.len());
        assert!(found.iter().filter(across).any(|c| (c.width - 0.04).abs() < 0.004), "the width is that of the box");
        let along = found.iter().filter(|c| (c.pose.rotation * Vector3::y()).y.abs() > 0.98);
        // The long side of 120 mm does not fit into the hand, only a corner does.
        assert!(along.clone().all(|c| c.width < 0.07));
        assert!(found.iter().any(|c| (c.pose.rotation * Vector3::z()).z < -0.95), "one approaches from above");
    }

    #[test]
    fn no_candidate_collides_with_the_table_or_the_object() {
        let (cloud, found) = of(standing_box(), 2);
        let Params { hand, aperture, .. } = Params::above(TABLE);
        for candidate in &found {
            assert!(hand.lowest_point(&candidate.pose) >= TABLE);
            let mut points = cloud.points().iter().map(|p| candidate.pose.inverse_transform_point(&p.position));
            assert!(points.clone().all(|point| !hand.finger_collides(&point) && !hand.palm_collides(&point)));
            assert!(points.any(|point| hand.contains(&point)), "a point is between the fingers");
            assert!(aperture.contains(&candidate.width));
        }
        let params = Params::above(TABLE + 0.06);
        let high = candidates(&cloud, &params, &mut ChaCha8Rng::seed_from_u64(2));
        assert!(!high.is_empty() && high.len() < found.len(), "a higher table leaves fewer");
        assert!(high.iter().all(|candidate| hand.lowest_point(&candidate.pose) >= TABLE + 0.06));
    }

    /// The candidate of a rotation, from a scan of all points at each pose.
    fn scanned(cloud: &Cloud, hand: &TurnedHand) -> Option<Candidate> {
        let TurnedHand { params, .. } = hand;
        let in_hand = |pose: Isometry3<f64>| {
            cloud.points().iter().map(move |point| pose.inverse_transform_point(&point.position))
        };
        let reach = params.hand.outer_diameter + params.hand.depth;
        let near: Vec<Point3<f64>> = cloud.within(hand.sample, reach).map(|point| point.position).collect();
        let is_free = |offset: f64, bite: f64| {
            let pose = hand.pose(offset, bite);
            params.hand.lowest_point(&pose) >= params.lowest
                && near.iter().map(|point| pose.inverse_transform_point(point)).all(|point| {
                    point.x.abs() > params.hand.height / 2.0
                        || !params.hand.finger_collides(&point) && !params.hand.palm_collides(&point)
                })
        };
        let free: Vec<f64> = hand.offsets().filter(|&offset| is_free(offset, params.bite)).collect();
        let offset = *free.get(free.len() / 2)?;
        let bites = (0..9).map(|step| params.bite + f64::from(step) * params.deepening);
        let bite = bites.take_while(|&bite| bite <= params.hand.depth + 1e-9 && is_free(offset, bite)).last()?;
        let pose = hand.pose(offset, bite);
        let held = in_hand(pose).filter(|point| params.hand.contains(point)).map(|point| point.y);
        let width = held.clone().fold(f64::MIN, f64::max) - held.fold(f64::MAX, f64::min);
        let is_free = in_hand(pose).all(|point| !params.hand.palm_collides(&point));
        (is_free && params.aperture.contains(&width)).then_some(Candidate { pose, width, point: hand.sample })
    }

    #[test]
    fn candidates_are_those_of_a_scan_of_all_points() {
        let cloud = Cloud::new(standing_box());
        let params = Params::above(TABLE);
        let mut found = 0;
        for point in cloud.points().iter().step_by(37) {
            let (normal, axis) = local_frame(&cloud, &params, point);
            let slice = slice(&cloud, &params.hand, &point.position, &axis);
            for angle in [-1.2, -0.4, 0.0, 0.4, 1.2] {
                let hand = TurnedHand::new(&params, point.position, normal, axis, angle);
                match (hand.fit(&cloud, &slice), scanned(&cloud, &hand)) {
                    (Some(candidate), Some(expected)) => {
                        assert_eq!(candidate.pose, expected.pose);
                        assert!((candidate.width - expected.width).abs() < 1e-12);
                        found += 1;
                    }
                    (candidate, expected) => assert_eq!(candidate, expected),
                }
            }
        }
        assert!(found > 20, "{found} candidates");
    }

    #[test]
    fn the_fingertips_pass_the_sample_by_at_least_the_bite() {
        let (_, found) = of(standing_box(), 3);
        let params = Params::above(TABLE);
        for candidate in &found {
            let bite = params.hand.depth - candidate.pose.inverse_transform_point(&candidate.point).z;
            let steps = (bite - params.bite) / params.deepening;
            assert!((steps - steps.round()).abs() < 1e-6 && (-1e-6..8.0 + 1e-6).contains(&steps), "a bite of {bite}");
        }
        assert!(found.iter().any(|c| c.pose.inverse_transform_point(&c.point).z < 0.02), "some are deep");
    }

    #[test]
    fn the_same_seed_gives_the_same_candidates() {
        assert_eq!(of(standing_box(), 4).1, of(standing_box(), 4).1);
        assert_ne!(of(standing_box(), 4).1, of(standing_box(), 5).1);
    }

    #[test]
    fn a_wide_plane_and_an_empty_cloud_give_no_candidates() {
        let at = |i: i32, j: i32| Point3::new(f64::from(i) * 2e-3, f64::from(j) * 2e-3, 0.1);
        let plane = (0..150).flat_map(|i| (0..150).map(move |j| at(i, j)));
        let plane = plane.map(|position| SurfacePoint { position, normal: Vector3::z() }).collect();
        let (_, found) = of(plane, 6);
        let inner = |c: &&Candidate| (0.08..0.22).contains(&c.point.x) && (0.08..0.22).contains(&c.point.y);
        assert_eq!(found.iter().filter(inner).count(), 0, "no candidates away from the borders of the plane");
        assert!(of(vec![], 6).1.is_empty());
    }
}
