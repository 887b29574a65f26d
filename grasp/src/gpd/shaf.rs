use nalgebra::Vector3;

use super::Candidate;

/// Size of a height band, metres. Within a band, noise in height does not change the order.
const BAND: f64 = 0.01;

/// Orders candidates as SHAF, the highest-point heuristic that GIGA's paper compares with: grasps at the highest object
/// points first.
///
/// The object point of a candidate is its sample point. Heights are counted from the highest point down in bands of 1
/// cm. Within a band, the candidate whose approach is closest to straight down comes first.
pub fn highest_first(candidates: &mut [Candidate]) {
    let top = candidates.iter().map(|candidate| candidate.point.z).fold(f64::MIN, f64::max);
    let band = |candidate: &Candidate| ((top - candidate.point.z) / BAND).floor();
    let rise = |candidate: &Candidate| (candidate.pose.rotation * Vector3::z()).z;
    candidates.sort_by(|a, b| band(a).total_cmp(&band(b)).then(rise(a).total_cmp(&rise(b))));
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3, UnitQuaternion};

    use super::*;

    fn candidate(height: f64, tilt: f64) -> Candidate {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI - tilt);
        let pose = Isometry3::from_parts(Default::default(), rotation);
        Candidate { pose, width: 0.04, point: Point3::new(0.1, 0.1, height) }
    }

    #[test]
    fn the_highest_comes_first_and_at_equal_height_the_steepest() {
        let (low, high_tilted, high) = (candidate(0.10, 0.0), candidate(0.155, 1.0), candidate(0.15, 0.2));
        let mut all = [low, high_tilted, high];
        highest_first(&mut all);
        assert_eq!(all, [high, high_tilted, low]);
        highest_first(&mut []);
    }
}
