use nalgebra::Vector3;

use super::Candidate;

/// Heights closer than this are the same, metres: a candidate on a flat top is not preferred for the noise of a point.
const BAND: f64 = 0.01;

/// Orders candidates as SHAF does, the simple high-point heuristic that GIGA's paper compares with: the grasp of the
/// highest object point first.
///
/// In its pure geometric form here the object point is the sample at which the hand was fitted. Points less than a
/// centimetre apart in height, counted from the highest, are equally high; of their candidates the one whose approach
/// is nearest to straight down comes first.
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
    fn the_highest_comes_first_and_of_equals_the_one_from_above() {
        let (low, high_tilted, high) = (candidate(0.10, 0.0), candidate(0.155, 1.0), candidate(0.15, 0.2));
        let mut all = [low, high_tilted, high];
        highest_first(&mut all);
        assert_eq!(all, [high, high_tilted, low]);
        highest_first(&mut []);
    }
}
