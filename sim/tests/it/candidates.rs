//! The classical planners and the training data of their classifier. `ORT_DYLIB_PATH` must name ONNX Runtime's library.

use std::fs;

use grasp::{DecodeParams, Hand, WORKSPACE_SIZE};
use grasp_data::Candidates;
use grasp_models::Options;
use grasp_planner::object_points;
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, Views, points};
use grasp_sim::label::SceneConfig;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::planner::{Observation, PlannerSpec};
use grasp_sim::scene::SceneKind;
use grasp_sim::trial::execute;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

fn benchmark() -> Benchmark {
    Benchmark {
        kind: SceneKind::Packed,
        objects: ObjectSet::procedural(Split::PackedTest),
        count: 3,
        views: Views::Side { azimuth: 0.0 },
        noise: DepthNoise::NONE,
        rounds: 1,
        seed: 5,
    }
}

fn plan(spec: &str, observation: &Observation) -> Vec<grasp::Grasp> {
    let mut planner =
        spec.parse::<PlannerSpec>().unwrap().build(&DecodeParams::benchmark(), &Options::default()).unwrap();
    planner.plan(observation, &mut ChaCha8Rng::seed_from_u64(1)).unwrap()
}

#[test]
fn candidates_depend_on_the_seed_and_not_on_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let made = |threads: usize, seed: u64| {
        let config = SceneConfig {
            kind: SceneKind::Packed,
            objects: ObjectSet::procedural(Split::Train),
            points: 8,
            views: Views::Side { azimuth: 0.0 },
            observations: 1,
            noise: DepthNoise::BENCHMARK,
            seed,
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let scenes: Vec<Candidates> =
            pool.install(|| (0..5).into_par_iter().map(|number| config.candidates(number)).collect());
        let mut tried = Candidates::default();
        scenes.into_iter().for_each(|candidates| tried.append(candidates));
        assert!(tried.len() > 20 && tried.len() <= 40, "{} candidates", tried.len());
        assert!((1..tried.len()).contains(&tried.successes()));
        let path = folder.path().join(format!("{threads}-{seed}.npz"));
        tried.write(&path).unwrap();
        fs::read(path).unwrap()
    };
    let once = made(1, 1);
    assert!(once == made(4, 1), "the same bytes on any number of threads");
    assert!(once != made(1, 2));
}

#[test]
fn shaf_proposes_high_grasps_that_lift() {
    let (world, mut rng) = benchmark().scene(0);
    let observation = benchmark().observe(&world, &mut rng).unwrap();
    let grasps = plan("shaf", &observation);
    assert!(grasps.len() > 10);
    assert!(grasps.iter().all(|grasp| Hand::GPD.lowest_point(&grasp.pose) >= TABLE_HEIGHT));
    let seen = object_points(&points(&observation.views), WORKSPACE_SIZE, TABLE_HEIGHT);
    let top = seen.iter().map(|point| point.position.z).fold(0.0, f64::max);
    let tips = |grasp: &grasp::Grasp| (grasp.pose * nalgebra::Point3::new(0.0, 0.0, grasp::FINGER_DEPTH)).z;
    assert!(tips(&grasps[0]) > top - grasp::FINGER_DEPTH - 0.01, "the fingers close near the top");
    let down = |grasp: &grasp::Grasp| -(grasp.pose.rotation * Vector3::z()).z;
    assert!(down(&grasps[0]) > 0.5, "from above");
    assert!(grasps.iter().take(5).any(|grasp| execute(&mut world.clone(), &grasp.pose).0.is_success()));
    assert_eq!(grasps, plan("shaf", &observation), "the same each time");
}

#[test]
fn a_classifier_filters_and_ranks_candidates() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gpd.onnx");
    grasp_models::gpd::gpd(3).write(&path).unwrap();
    let (world, mut rng) = benchmark().scene(0);
    let observation = benchmark().observe(&world, &mut rng).unwrap();
    let grasps = plan(&format!("gpd:{}", path.display()), &observation);
    assert!(grasps.len() <= plan("shaf", &observation).len());
    assert!(grasps.iter().all(|grasp| (0.5..=1.0).contains(&grasp.quality)), "a score below 0 is a quality below 0.5");
    assert!(grasps.windows(2).all(|pair| pair[0].quality >= pair[1].quality), "best first");
}

#[test]
fn shaf_ranks_a_networks_proposals_by_height() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo/vgn-packed.onnx");
    let (world, mut rng) = benchmark().scene(1);
    let observation = benchmark().observe(&world, &mut rng).unwrap();
    let grasps = plan(&format!("shaf:{path}"), &observation);
    assert!(grasps.len() > 3 && grasps.iter().all(|grasp| grasp.quality > 0.5));
    let height = |grasp: &grasp::Grasp| grasp.pose.translation.z;
    assert!(grasps.windows(2).all(|pair| height(&pair[0]) >= height(&pair[1])));
}

#[test]
fn the_wrong_kind_of_network_is_refused_with_its_file_name() {
    let folder = tempfile::tempdir().unwrap();
    let classifier = folder.path().join("gpd.onnx");
    grasp_models::gpd::gpd(0).write(&classifier).unwrap();
    let network = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo/vgn-packed.onnx");
    let classifier = classifier.display();
    for (spec, file, expected) in [
        (format!("gpd:{network}"), "vgn-packed.onnx", "a classifier has the input `images`"),
        (format!("shaf:{classifier}"), "gpd.onnx", "a grasp network has the input `tsdf`"),
        (classifier.to_string(), "gpd.onnx", "a grasp network has the input `tsdf`"),
        ("gpd:nowhere.onnx".to_owned(), "nowhere.onnx", "No such file"),
    ] {
        let error = spec
            .parse::<PlannerSpec>()
            .unwrap()
            .build(&DecodeParams::benchmark(), &Options::default())
            .err()
            .unwrap()
            .to_string();
        assert!(error.contains(file) && error.contains(expected), "{spec}: {error}");
    }
}
