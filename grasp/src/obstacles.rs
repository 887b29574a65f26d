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
