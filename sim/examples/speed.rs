//! Speed of data generation on one core: `make bench-sim`. Prints a table, and a JSON object as the last line.

use std::time::Instant;

use grasp::RESOLUTION;
use grasp_sim::camera::{DepthNoise, Views, fuse, look};
use grasp_sim::label::SceneConfig;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::scene::{SceneKind, generate};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

const SCENES: u64 = 40;

/// Durations in seconds for `SCENES` scenes of one kind, with the number of points and views.
#[derive(Clone, Copy, Default)]
struct Times {
    labelling: f64,
    points: usize,
    generating: f64,
    rendering: f64,
    fusing: f64,
    views: usize,
}

fn main() {
    println!(
        "{:8} {:>9} {:>9} {:>14} {:>14} {:>12}",
        "", "points/s", "scenes/s", "generate ms", "render ms", "fuse ms"
    );
    let rows = [("pile", SceneKind::Pile), ("packed", SceneKind::Packed)].map(|(name, kind)| {
        let times = Times::measure(kind);
        let ([points, scenes], [generate, render, fuse]) = (times.rates(SCENES), times.milliseconds(SCENES));
        println!("{name:8} {points:9.0} {scenes:9.2} {generate:8.1}/scene {render:9.2}/view {fuse:7.3}/view");
        times
    });
    let all = rows.iter().fold(Times::default(), |sum, times| Times {
        labelling: sum.labelling + times.labelling,
        points: sum.points + times.points,
        generating: sum.generating + times.generating,
        rendering: sum.rendering + times.rendering,
        fusing: sum.fusing + times.fusing,
        views: sum.views + times.views,
    });
    println!("one core; {SCENES} scenes per row, 120 points with six yaws each, 640×480 views, 40³ voxels");
    let ([points, scenes], [generate, render, fuse]) = (all.rates(2 * SCENES), all.milliseconds(2 * SCENES));
    let line = json!({
        "points_per_second_per_core": points,
        "pile_points_per_second_per_core": rows[0].rates(SCENES)[0],
        "packed_points_per_second_per_core": rows[1].rates(SCENES)[0],
        "scenes_per_second": scenes,
        "generate_ms_per_scene": generate,
        "render_ms_per_view": render,
        "fuse_ms_per_view": fuse,
        "scenes": 2 * SCENES,
    });
    println!("{line}");
}

impl Times {
    fn measure(kind: SceneKind) -> Self {
        let objects = ObjectSet::procedural(Split::Train);
        let config = SceneConfig {
            kind,
            objects: objects.clone(),
            points: 120,
            views: Views::Random(1..=6),
            observations: 1,
            noise: DepthNoise::BENCHMARK,
            seed: 1,
        };
        let (points, labelling) =
            timed(|| (0..SCENES).filter_map(|number| Some(config.label(number)?.points.len())).sum());

        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (worlds, generating): (Vec<_>, _) =
            timed(|| (0..SCENES).map(|_| generate(kind, &objects, 5, &mut rng)).collect());
        let (views, rendering): (Vec<_>, _) =
            timed(|| worlds.iter().flat_map(|world| look(world, &Views::Circle.sample(&mut rng))).collect());
        let (fused, fusing) = timed(|| fuse(&views, RESOLUTION));
        assert!(fused.values().iter().any(|&value| value > 0.0), "the views see something");
        Self { labelling, points, generating, rendering, fusing, views: views.len() }
    }

    /// Points and scenes per second.
    fn rates(&self, scenes: u64) -> [f64; 2] {
        [self.points as f64, scenes as f64].map(|count| count / self.labelling)
    }

    /// Milliseconds to generate a scene, to render a view and to fuse a view.
    fn milliseconds(&self, scenes: u64) -> [f64; 3] {
        let views = self.views as f64;
        [self.generating / scenes as f64, self.rendering / views, self.fusing / views].map(|seconds| seconds * 1e3)
    }
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = work();
    (result, start.elapsed().as_secs_f64())
}
