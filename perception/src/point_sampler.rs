use grasp::SurfacePoint;

/// Observed points, subsampled evenly to at most [`LIMIT`](Self::LIMIT): images may have millions of pixels, and the
/// points of queued requests would fill the memory.
pub(crate) struct PointSampler {
    points: Vec<SurfacePoint>,
    /// One of every `stride` points is kept.
    stride: usize,
    count: usize,
}

impl PointSampler {
    /// 10 MB, and far more points than the planners use.
    const LIMIT: usize = 200_000;

    pub fn add(&mut self, point: SurfacePoint) {
        if self.count.is_multiple_of(self.stride) {
            self.points.push(point);
        }
        self.count += 1;
        if self.points.len() == Self::LIMIT {
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
    }

    pub fn into_points(self) -> Vec<SurfacePoint> {
        self.points
    }
}

impl Default for PointSampler {
    fn default() -> Self {
        Self { points: Vec::new(), stride: 1, count: 0 }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};

    use super::*;

    #[test]
    fn points_are_subsampled_evenly() {
        let mut sampler = PointSampler::default();
        let point = |x: usize| SurfacePoint { position: Point3::new(x as f64, 0.0, 0.0), normal: Vector3::z() };
        (0..5 * PointSampler::LIMIT).for_each(|x| sampler.add(point(x)));
        assert!((PointSampler::LIMIT / 2..PointSampler::LIMIT).contains(&sampler.points.len()));
        assert!(sampler.points.windows(2).all(|pair| pair[1].position.x - pair[0].position.x == 8.0));
    }
}
