/// The convex hull of points on the table: its edges, counterclockwise.
#[derive(Default)]
pub(super) struct Hull(Vec<Edge>);

/// The line through an edge, with the hull on its left.
struct Edge {
    from: [f64; 2],
    /// Of length 1.
    direction: [f64; 2],
}

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
        let corners = [lower, upper].concat();
        let next = corners.iter().cycle().skip(1);
        Self(corners.iter().zip(next).map(|(&from, &to)| Edge::new(from, to)).collect())
    }

    /// Whether a point is in the hull, or at most `margin` outside.
    pub fn contains(&self, point: [f64; 2], margin: f64) -> bool {
        self.0.iter().all(|edge| edge.distance(point) >= -margin)
    }
}

impl Edge {
    fn new(from: [f64; 2], to: [f64; 2]) -> Self {
        let [x, y] = [to[0] - from[0], to[1] - from[1]];
        let length = x.hypot(y).max(f64::MIN_POSITIVE);
        Self { from, direction: [x / length, y / length] }
    }

    /// Distance of a point on the left of the line; negative on the right.
    fn distance(&self, point: [f64; 2]) -> f64 {
        let Self { from, direction: [x, y] } = self;
        x * (point[1] - from[1]) - y * (point[0] - from[0])
    }
}

/// Twice the area of a triangle: positive if `point` is on the left of the line from `a` to `b`.
fn left_of(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}
