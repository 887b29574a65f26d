use nalgebra::{Isometry3, Point3};

use crate::{Hand, Volume};

/// What was observed and a hand must not touch: points at or behind the surfaces of a volume.
#[derive(Clone, Debug, Default)]
pub struct Obstacles {
    points: Vec<Point3<f64>>,
}

impl Obstacles {
    /// The voxels that lie behind a surface, by at least `depth` times the distance at which the field is truncated: a
    /// noisy surface is not everywhere where it was seen. Space that nothing observed is taken to be free.
    #[must_use]
    pub fn observed(volume: &Volume, depth: f32) -> Self {
        let (n, size) = (volume.resolution(), volume.voxel_size());
        let behind = 0.5 - depth / 2.0;
        let solid = volume.values().iter().enumerate().filter(|&(_, &value)| value > 0.0 && value <= behind);
        let point = |index: usize| {
            let cell = [index / (n * n), index / n % n, index % n];
            volume.pose() * Point3::from(cell.map(|c| (c as f64 + 0.5) * size))
        };
        Self { points: solid.map(|(index, _)| point(index)).collect() }
    }

    /// How many of the points the open hand meets that comes `from` metres back along its approach to `pose`.
    #[must_use]
    pub fn met_by(&self, hand: &Hand, pose: &Isometry3<f64>, from: f64) -> usize {
        let inverse = pose.inverse();
        self.points.iter().filter(|&point| hand.meets(&(inverse * point), from)).count()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    use super::*;

    const N: usize = 40;
    const SIZE: f64 = 0.0075;

    /// A wall whose face is the plane x = 0.15, seen from in front of it to 0.03 m behind, with the volume's corner at
    /// (1, 2, 3).
    fn wall() -> Volume {
        let value = |index: usize| {
            let behind = (index / (N * N)) as f64 + 0.5 - 20.0;
            if behind < 4.0 { (0.5 - behind / 8.0).clamp(0.0, 1.0) as f32 } else { 0.0 }
        };
        Volume::new(N, SIZE, Isometry3::translation(1.0, 2.0, 3.0), (0..N.pow(3)).map(value).collect()).unwrap()
    }

    /// A hand straight down whose fingers close along x, its base `x` from the volume's corner.
    fn down(x: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        Isometry3::from_parts(Translation3::new(1.0 + x, 2.15, 3.15), turn)
    }

    #[test]
    fn a_hand_meets_what_was_seen_and_nothing_else() {
        let obstacles = Obstacles::observed(&wall(), 0.0);
        let met = |x: f64| obstacles.met_by(&Hand::PANDA, &down(x), 0.05);
        // From the middle of the palm to its end are 0.1 m.
        assert_eq!(met(0.04), 0);
        assert!(met(0.06) > 0 && met(0.15) > met(0.06));
        let retreated = obstacles.met_by(&Hand::PANDA, &down(0.06), 0.0);
        assert!(retreated > 0 && retreated < met(0.06), "the way counts, too");
    }

    #[test]
    fn what_lies_just_behind_the_surface_may_be_spared() {
        let count = |depth| Obstacles::observed(&wall(), depth).points.len() / (N * N);
        // Voxels 0.5, 1.5, 2.5 and 3.5 behind, of a truncation of four.
        assert_eq!([0.0, 0.25, 0.5, 0.875, 0.9].map(count), [4, 3, 2, 1, 0]);
        let points = Obstacles::observed(&wall(), 0.0).points;
        assert!(points.iter().all(|p| (1.15..1.18).contains(&p.x) && p.y > 2.0 && p.z > 3.0), "in the volume's frame");
    }
}
