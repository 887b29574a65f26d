//! How fast data are made on one core, as one JSON line: `make bench-sim`.

use std::time::Instant;

use grasp::RESOLUTION;
use grasp_sim::camera::{Views, fuse, look};
use grasp_sim::label::Recipe;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::scene::{SceneKind, generate};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

const SCENES: u64 = 24;

fn main() {
    for kind in [SceneKind::Pile, SceneKind::Packed] {
        let objects = ObjectSet::procedural(Split::Train);
        let recipe =
            Recipe { kind, objects: objects.clone(), points: 120, views: Views::Anywhere(1..=6), noise: true, seed: 1 };
        let start = Instant::now();
        let points: usize = (0..SCENES).filter_map(|number| Some(recipe.label(number)?.trials.len())).sum();
        let labelling = start.elapsed().as_secs_f64();

        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let start = Instant::now();
        let worlds: Vec<_> = (0..SCENES).map(|_| generate(kind, &objects, 5, &mut rng)).collect();
        let generating = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let views: Vec<_> = worlds.iter().flat_map(|world| look(world, &Views::Circle.sample(&mut rng))).collect();
        let rendering = start.elapsed().as_secs_f64() / views.len() as f64;
        let start = Instant::now();
        let fused = fuse(&views, RESOLUTION);
        let fusing = start.elapsed().as_secs_f64() / views.len() as f64;
        assert!(fused.values().iter().any(|&value| value > 0.0), "the views see something");

        let line = json!({
            "scene": format!("{kind:?}").to_lowercase(),
            "points_per_second_per_core": points as f64 / labelling,
            "scenes_per_second": SCENES as f64 / labelling,
            "generate_ms_per_scene": generating * 1e3 / SCENES as f64,
            "render_ms_per_view": rendering * 1e3,
            "fuse_ms_per_view": fusing * 1e3,
            "scenes": SCENES,
        });
        println!("{line}");
    }
}
