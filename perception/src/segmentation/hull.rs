/// The convex hull of points on the table, counterclockwise.
pub(super) struct Hull(pub Vec<[f64; 2]>);

impl Hull {
    pub fn new(mut points: Vec<[f64; 2]>) -> Self {
        points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        let half = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
            let mut hull: Vec<[f64; 2]> = Vec::new();
            for point in points {
                while let [.., a, b] = hull[..]
                    && left_of(a, b, *point) <= 0.0
                {
                    hull.pop();
                }
                hull.push(*point);
            }
            hull.pop();
            hull
        };
        let (lower, upper) = (half(&mut points.iter()), half(&mut points.iter().rev()));
        Self([lower, upper].concat())
    }

    /// Whether a point is in the hull, or at most `margin` outside.
    pub fn contains(&self, point: [f64; 2], margin: f64) -> bool {
        let next = self.0.iter().cycle().skip(1);
        self.0.iter().zip(next).all(|(a, b)| {
            let length = (b[0] - a[0]).hypot(b[1] - a[1]);
            left_of(*a, *b, point) >= -margin * length
        })
    }
}

/// Twice the area of a triangle: positive if `point` is on the left of the line from `a` to `b`.
fn left_of(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}
