//! From one depth image of a stereo camera, with nothing else known, to grasps on what stands on the table.

use std::collections::BTreeSet;
use std::path::Path;

use grasp::{DepthImage, Fusion, Intrinsics, ObjectMap, RESOLUTION, WORKSPACE_SIZE};
use grasp_models::{Network, Options};
use grasp_perception::{Scene, Tabletop};
use grasp_picture::{Instance, render};
use grasp_planner::{Evaluator, NetworkPlanner, PlanParams, Planner};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, View, Views, add_stereo_noise};
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::scene::SceneKind;
use nalgebra::Isometry3;

/// Smallest number of pixels of an object that the camera sees well.
const SEEN: usize = 400;

fn planner() -> NetworkPlanner {
    let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/zoo");
    let network = Network::load(&zoo.join("vgn-packed.onnx"), &Options::default()).unwrap();
    let evaluator = Evaluator::load(&zoo.join("evaluators/vgn-refined.onnx"), &Options::default()).unwrap();
    NetworkPlanner::new(network, Some(evaluator))
}

#[test]
fn most_objects_have_a_probable_grasp() {
    let mut planner = planner();
    let decode = Evaluator::decode_params(planner.network().metadata());
    let params = PlanParams { decode, table: Some(TABLE_HEIGHT) };
    let objects = ObjectSet::procedural(Split::PackedTest);
    let views = Views::Random(1..=1);
    let bench =
        Benchmark { kind: SceneKind::Packed, objects, count: 4, views, noise: DepthNoise::NONE, rounds: 10, seed: 23 };
    let (mut grasped, mut seen) = (0, 0);
    for number in 0..bench.rounds {
        let (world, mut rng) = bench.scene(number);
        let camera = bench.views.sample(&mut rng).remove(0);
        let instances: Vec<Instance> = world
            .objects()
            .iter()
            .zip(1..)
            .map(|(body, id)| Instance { mesh: &body.object.visual, pose: world.pose(body.id), scale: body.scale, id })
            .collect();
        let frame = render(&instances, Some(TABLE_HEIGHT), &Intrinsics::BENCHMARK, &camera, 0.1, 2.0);
        let is_object = |id: u16| usize::from(id) <= world.objects().len();
        let labels: Vec<u16> = frame.ids.iter().map(|&id| if is_object(id) { id } else { 0 }).collect();
        let mut view = View { depth: frame.depth, camera_from_task: camera };
        add_stereo_noise(&mut view, &mut rng);

        let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).unwrap();
        let camera_from_task = Tabletop::find(&image, None, TABLE_HEIGHT).unwrap().camera_from_task;
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        fusion.integrate(&image, &camera_from_task);
        let width = Intrinsics::BENCHMARK.width;
        let points = labels.iter().enumerate().filter_map(|(pixel, &label)| {
            Some((camera_from_task.inverse() * image.point(pixel % width, pixel / width)?, label))
        });
        let map = ObjectMap::new(points, &Isometry3::identity(), None);
        let scene = Scene::from(fusion.volume(Isometry3::identity()).unwrap());
        let grasps = planner.plan(&scene, &params, &|| true).unwrap().grasps;

        let hand = grasp::Hand::PANDA;
        let with_grasp: BTreeSet<u16> = grasps.iter().filter_map(|grasp| map.object(&grasp.pose, &hand)).collect();
        let visible = |label: &u16| labels.iter().filter(|other| *other == label).count() >= SEEN;
        let visible: BTreeSet<u16> = (1..=world.objects().len() as u16).filter(visible).collect();
        seen += visible.len();
        grasped += visible.intersection(&with_grasp).count();
    }
    println!("{grasped} of {seen} visible objects have a grasp of at least 0.5");
    assert!(seen >= 20 && grasped * 10 >= seen * 8, "{grasped} of {seen}");
}
