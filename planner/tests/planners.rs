//! Runs each planner on two boxes on a table. `ORT_DYLIB_PATH` must name the ONNX Runtime library.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use grasp::{DecodeParams, Decoded, Fusion, Hand, RESOLUTION, SurfacePoint, WORKSPACE_SIZE};
use grasp_models::onnx::ModelProto;
use grasp_models::{
    ActivationRange, Backend, Network, Options, Precision, Store, quantized_activations, with_full_weights, with_int8,
    without_coarse_evaluator,
};
use grasp_perception::{Scene, seen_from};
use grasp_planner::{Evaluator, Gpd, HighestProposal, ModelSpec, NetworkPlanner, PlanError, PlanParams, Planner, Shaf};
use nalgebra::{Isometry3, Point3, Vector3};

const TABLE: f64 = 0.05;
/// Centre of the base and edge lengths, metres.
type Cuboid = ([f64; 2], [f64; 3]);
/// A high and a low box.
const BOXES: [Cuboid; 2] = [([0.1, 0.15], [0.04, 0.05, 0.12]), ([0.2, 0.16], [0.045, 0.04, 0.05])];
/// Distance between surface points, metres.
const STEP: f64 = 0.002;
/// A camera in front of the boxes.
const EYE: Point3<f64> = Point3::new(0.15, -0.35, 0.45);

/// The top and the four sides of a box.
fn surface(([x, y], [a, b, height]): Cuboid) -> Vec<SurfacePoint> {
    let steps = |length: f64| (0..=(length / STEP) as usize).map(|i| i as f64 * STEP);
    let at = |dx: f64, dy: f64, dz: f64, normal| SurfacePoint {
        position: Point3::new(x - a / 2.0 + dx, y - b / 2.0 + dy, TABLE + dz),
        normal,
    };
    let mut points = Vec::new();
    for dx in steps(a) {
        points.extend(steps(b).map(|dy| at(dx, dy, height, Vector3::z())));
        points.extend(steps(height).flat_map(|dz| [at(dx, 0.0, dz, -Vector3::y()), at(dx, b, dz, Vector3::y())]));
    }
    for dy in steps(b) {
        points.extend(steps(height).flat_map(|dz| [at(0.0, dy, dz, -Vector3::x()), at(a, dy, dz, Vector3::x())]));
    }
    points
}

/// The surface of boxes and of the table.
fn on_table(boxes: &[Cuboid]) -> Vec<SurfacePoint> {
    let mut points: Vec<SurfacePoint> = boxes.iter().copied().flat_map(surface).collect();
    let table = (0..150).flat_map(|i| (0..150).map(move |j| (f64::from(i) * STEP, f64::from(j) * STEP)));
    points.extend(table.map(|(x, y)| SurfacePoint { position: Point3::new(x, y, TABLE), normal: Vector3::z() }));
    points
}

/// The boxes as seen by the camera, with the volume at the pose `frame`.
fn scene(frame: Isometry3<f64>) -> Scene {
    let points = on_table(&BOXES);
    let positions: Vec<Point3<f64>> = points.iter().map(|point| point.position).collect();
    let view = seen_from(&positions, &EYE, WORKSPACE_SIZE).unwrap();
    let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
    assert!(fusion.integrate(&view.image, &view.camera_from_task) > 0);
    Scene { points: Some(points), ..fusion.volume(frame).unwrap().into() }
}

fn zoo(file: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "..", "models", "zoo", file].iter().collect()
}

fn plan(planner: &mut dyn Planner, scene: &Scene, decode: DecodeParams) -> Decoded {
    planner.plan(scene, &PlanParams { decode, table: Some(TABLE) }, &|| true).unwrap()
}

fn network() -> NetworkPlanner {
    NetworkPlanner::load(&zoo("vgn-packed.onnx"), &Options::default()).unwrap()
}

/// Every planner with its default parameters.
fn planners() -> Vec<(&'static str, Box<dyn Planner>, DecodeParams)> {
    let network = network();
    let decode = network.network().metadata().decode_params();
    let proposals = NetworkPlanner::load(&zoo("vgn-packed.onnx"), &Options::default()).unwrap();
    let evaluated = Network::load(&zoo("vgn-packed.onnx"), &Options::default()).unwrap();
    let of_evaluated = Evaluator::decode_params(evaluated.metadata());
    let evaluator = Evaluator::load(&zoo("evaluators/vgn-refined.onnx"), &Options::default()).unwrap();
    vec![
        ("network", Box::new(network), decode),
        ("evaluator", Box::new(NetworkPlanner::new(evaluated, Some(evaluator))), of_evaluated),
        ("highest proposal", Box::new(HighestProposal(proposals)), decode),
        ("gpd", Box::new(Gpd::load(&zoo("classifiers/gpd.onnx"), &Options::default()).unwrap()), Gpd::decode_params()),
        ("shaf", Box::new(Shaf), Shaf::decode_params()),
    ]
}

#[test]
fn every_planner_grasps_the_boxes_and_is_deterministic() {
    let scene = scene(Isometry3::identity());
    for (name, mut planner, decode) in planners() {
        let decoded = plan(planner.as_mut(), &scene, decode);
        assert!(!decoded.grasps.is_empty(), "{name}");
        for grasp in &decoded.grasps {
            let tip = grasp.pose * Point3::new(0.0, 0.0, grasp::FINGER_DEPTH);
            let near = |&([x, y], [a, b, height]): &Cuboid| {
                (tip.x - x).abs() < a && (tip.y - y).abs() < b && tip.z < TABLE + height + 0.02
            };
            assert!(BOXES.iter().any(near), "{name}: {tip}");
            assert!((0.0..=0.08).contains(&grasp.width), "{name}: {}", grasp.width);
        }
        assert_eq!(plan(planner.as_mut(), &scene, decode), decoded, "{name}");
    }
}

#[test]
fn grasps_are_in_the_frame_of_the_volume() {
    let frame = Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::z() * 0.7);
    for (name, mut planner, decode) in planners() {
        let here = plan(planner.as_mut(), &scene(Isometry3::identity()), decode).grasps;
        let there = plan(planner.as_mut(), &scene(frame), decode).grasps;
        assert_eq!(here.len(), there.len(), "{name}");
        for (here, there) in here.iter().zip(&there) {
            let off = (frame * here.pose).inverse() * there.pose;
            assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-6, "{name}");
        }
    }
}

#[test]
fn grasps_are_sorted_by_the_criterion_of_the_planner() {
    let scene = scene(Isometry3::identity());
    for (name, mut planner, decode) in planners() {
        let grasps = plan(planner.as_mut(), &scene, decode).grasps;
        let falls = |measure: fn(&grasp::Grasp) -> f64| grasps.windows(2).all(|w| measure(&w[0]) >= measure(&w[1]));
        match name {
            "highest proposal" => assert!(falls(|grasp| grasp.pose.translation.z)),
            _ => assert!(falls(|grasp| f64::from(grasp.quality)), "{name}"),
        }
    }
    let highest = plan(&mut Shaf, &scene, Shaf::decode_params()).grasps[0];
    assert!((highest.pose.translation.x - 0.1).abs() < 0.04, "the high box: {}", highest.pose.translation);
}

#[test]
fn the_fastest_backend_of_gpd_agrees_with_the_reference() {
    let scene = scene(Isometry3::identity());
    let decode = DecodeParams { threshold: 1e-6, ..Gpd::decode_params() };
    let [reference, fastest] = [Options::default(), Options::auto(1)].map(|options| {
        let mut gpd = Gpd::load(&zoo("classifiers/gpd.onnx"), &options).unwrap();
        plan(&mut gpd, &scene, decode).grasps
    });
    assert!(!reference.is_empty() && reference.len() == fastest.len());
    for grasp in &fastest {
        let same = reference.iter().find(|other| other.pose == grasp.pose).unwrap();
        // Nothing but the classifier depends on the backend.
        assert_eq!(same.width, grasp.width);
        assert!((same.quality - grasp.quality).abs() < 0.02, "{} and {}", same.quality, grasp.quality);
    }
}

#[test]
fn classifiers_run_beside_int8_networks() {
    let entry = |folder: &Path, name: &str| Store::open(folder).unwrap().get(name, None).unwrap().clone();
    let int8 = Options { sessions: Some(2), precision: Some(Precision::Int8), ..Options::default() };
    let gpd = ModelSpec::Gpd(entry(&zoo("classifiers"), "gpd"));
    let (planners, backend) = gpd.load(&int8).unwrap();
    assert_eq!((planners.len(), backend), (2, Backend::REFERENCE));

    let folder = tempfile::tempdir().unwrap();
    let network = with_full_weights(&ModelProto::read(&zoo("vgn-packed.onnx")).unwrap()).unwrap();
    let range = |name| (name, ActivationRange { low: -5.0, high: 5.0 });
    let ranges = quantized_activations(&network).into_iter().map(range).collect();
    with_int8(&network, &ranges).unwrap().write(&folder.path().join("vgn-packed.onnx")).unwrap();
    let network = entry(folder.path(), "vgn-packed");
    let evaluated = ModelSpec::Evaluated { network, evaluator: entry(&zoo("evaluators"), "vgn-refined") };
    let (planners, backend) = evaluated.load(&int8).unwrap();
    assert_eq!((planners.len(), backend.precision), (2, Precision::Int8));
}

#[test]
fn fingers_shorter_than_the_first_bite_of_gpd_find_grasps() {
    let hand = Hand { depth: 0.009, ..Hand::GPD };
    let decode = DecodeParams { hand: Some(hand), ..Shaf::decode_params() };
    assert!(!plan(&mut Shaf, &scene(Isometry3::identity()), decode).grasps.is_empty());
}

#[test]
fn without_points_the_surface_of_the_volume_is_used() {
    let scene = Scene { points: None, ..scene(Isometry3::identity()) };
    assert!(!plan(&mut Shaf, &scene, Shaf::decode_params()).grasps.is_empty());
}

#[test]
fn an_evaluator_works_without_a_coarse_one() {
    let folder = tempfile::tempdir().unwrap();
    let alone = folder.path().join("alone.onnx");
    let both = zoo("evaluators/vgn-refined.onnx");
    without_coarse_evaluator(&ModelProto::read(&both).unwrap()).write(&alone).unwrap();
    let scene = scene(Isometry3::identity());
    let [with, without] = [both, alone].map(|file| {
        let network = Network::load(&zoo("vgn-packed.onnx"), &Options::default()).unwrap();
        let decode = Evaluator::decode_params(network.metadata());
        let evaluator = Evaluator::load(&file, &Options::default()).unwrap();
        plan(&mut NetworkPlanner::new(network, Some(evaluator)), &scene, decode).grasps[0].quality
    });
    // A coarse evaluator leaves poses out, and of the best grasps few.
    assert!((with - without).abs() < 0.1, "{with} and {without}");
}

/// A pen, 12 mm wide and high: the network proposes nothing there, and the fingers have 10 mm above the table.
#[test]
fn the_evaluator_grasps_thin_things_across() {
    let pen: Cuboid = ([0.15, 0.15], [0.012, 0.13, 0.012]);
    let positions: Vec<Point3<f64>> = on_table(&[pen]).iter().map(|point| point.position).collect();
    let view = seen_from(&positions, &EYE, WORKSPACE_SIZE).unwrap();
    let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
    fusion.integrate(&view.image, &view.camera_from_task);
    let frame = Isometry3::new(Vector3::new(0.3, 0.1, -0.2), Vector3::z() * 0.4);
    let volume = fusion.detailed_volume(frame, &[(&view.image, view.camera_from_task)]).unwrap();
    let network = Network::load(&zoo("vgn-packed.onnx"), &Options::default()).unwrap();
    let decode = Evaluator::decode_params(network.metadata());
    let evaluator = Evaluator::load(&zoo("evaluators/vgn-refined.onnx"), &Options::default()).unwrap();
    let mut planner = NetworkPlanner::new(network, Some(evaluator));
    let best = plan(&mut planner, &volume.into(), decode).grasps[0];
    let pose = frame.inverse() * best.pose;
    let tips = pose * Point3::new(0.0, 0.0, grasp::FINGER_DEPTH);
    assert!((tips.x - 0.15).abs() < 0.03 && (tips.y - 0.15).abs() < 0.065, "the pen is between the fingers: {tips}");
    assert!((pose * Vector3::y()).x.abs() > 0.7, "the fingers close across the pen");
}

#[test]
fn planning_stops_when_it_is_cancelled() {
    let scene = scene(Isometry3::identity());
    let params = PlanParams { decode: Shaf::decode_params(), table: Some(TABLE) };
    let mut gpd = Gpd::load(&zoo("classifiers/gpd.onnx"), &Options::default()).unwrap();
    let planners: [&mut dyn Planner; 2] = [&mut Shaf, &mut gpd];
    for planner in planners {
        let calls = Cell::new(0);
        let is_wanted = || {
            calls.set(calls.get() + 1);
            calls.get() < 10
        };
        assert!(matches!(planner.plan(&scene, &params, &is_wanted), Err(PlanError::Cancelled)));
        assert_eq!(calls.get(), 10);
    }
}
