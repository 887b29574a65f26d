//! Requests with depth images or point clouds: grasps are those of the fused volume, and errors name the field.

use std::path::Path;
use std::time::Duration;

use grasp::{DepthImage, Fusion, RESOLUTION as PAPERS, Volume, WORKSPACE_SIZE};
use grasp_client::{
    Client, CloudView, Depth, DepthView, DetectOptions, Detection, Error, Extrinsics, FindTable, LocalServer,
    Observation, Options, Proposal, Workspace,
};
use grasp_proto::pb;
use grasp_proto::pb::geometry_warning::Code as WarningCode;
use grasp_tests::scene::{BLOCK, CAMERA, TABLE, camera, depth, view};
use grasp_tests::{RESOLUTION, Server, TestModel, graspd, no_collision_check};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use tonic::Code;

fn low() -> Options {
    with_options(DetectOptions { threshold: Some(0.6), ..DetectOptions::default() })
}

fn with_options(detect: DetectOptions) -> Options {
    let collision = detect.collision.or_else(no_collision_check);
    Options { detect: DetectOptions { collision, ..detect }, ..Options::default() }
}

/// The volume that the server must fuse.
fn fused(cameras: &[Isometry3<f64>], resolution: usize, pose: Isometry3<f64>) -> Volume {
    let mut fusion = Fusion::new(resolution, WORKSPACE_SIZE);
    for camera in cameras {
        fusion.integrate(&DepthImage::new(CAMERA, depth(camera)).unwrap(), camera);
    }
    fusion.volume(pose).unwrap()
}

fn assert_same(actual: &[Proposal], expected: &[Proposal]) {
    assert!(!expected.is_empty() && actual.len() == expected.len(), "{} not {}", actual.len(), expected.len());
    for (actual, expected) in actual.iter().zip(expected) {
        assert!(
            (actual.pose.translation.vector - expected.pose.translation.vector).norm() < 1e-9,
            "{actual:?} {expected:?}"
        );
        assert!((actual.quality - expected.quality).abs() < 1e-5, "{actual:?} {expected:?}");
    }
}

fn assert_at_the_block(grasp: &Proposal) {
    let between = grasp.pose * Point3::new(0.0, 0.0, 0.03);
    let near = (0..3).all(|axis| (BLOCK[0][axis] - 0.03..=BLOCK[1][axis] + 0.03).contains(&between[axis]));
    assert!(near, "{between} is not at the block");
}

fn refusal(outcome: Result<Detection, Error>) -> (Code, String) {
    match outcome {
        Err(Error::Refused { code, message, .. }) => (code, message),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn depth_images_give_the_grasps_of_the_fused_volume() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let pose = Isometry3::new(Vector3::new(0.4, -0.2, 1.1), Vector3::new(0.0, 0.0, 2.0));
    let workspace = Workspace { pose, size: Some(0.3), ..Workspace::default() };
    let cameras = [camera(30.0, -90.0), camera(45.0, 60.0)];
    let expected = client.detect(&fused(&cameras, RESOLUTION, pose), low()).await.unwrap();

    let metres = cameras.map(|camera| view(&camera));
    let frame_id = "panda_link0".to_owned();
    let options = Options { frame_id, ..low() };
    let detection = client.detect_from_depth(&metres, &workspace, options).await.unwrap();
    assert_same(&detection.grasps, &expected.grasps);
    assert_eq!((detection.frame_id.as_str(), detection.model.as_str()), ("panda_link0", "mirror"));
    assert!(detection.latency.fusion > 0.0 && detection.latency.total > detection.latency.fusion);
    let count = "graspd_stage_duration_seconds_count{model=\"mirror 1\",stage=\"fusion\"}";
    assert_eq!(server.metric(count), 1.0, "a volume in the request is not fused");

    // Poses as from a hand-eye calibration, depth in millimetres as from a camera driver.
    let millimetres = cameras.map(|camera| DepthView {
        depth: Depth::Millimetres(depth(&camera).iter().map(|metres| (metres * 1e3).round() as u16).collect()),
        extrinsics: Extrinsics::FrameFromCamera(pose * camera.inverse()),
        ..view(&camera)
    });
    let rounded = client.detect_from_depth(&millimetres, &workspace, low()).await.unwrap();
    let near = |a: &Proposal, b: &Proposal| (a.pose.translation.vector - b.pose.translation.vector).norm() < 0.02;
    assert!(detection.grasps.iter().all(|grasp| rounded.grasps.iter().any(|other| near(grasp, other))));
}

#[tokio::test]
async fn the_grid_is_rotated_to_the_camera_azimuth_of_the_network() {
    let turned = TestModel::new("turned").camera_azimuth(-60.0);
    let server = Server::run(&[TestModel::new("mirror"), turned], &[]);
    let client = server.client().await;
    let pose = Isometry3::new(Vector3::new(0.4, -0.2, 1.1), Vector3::new(0.0, 0.0, 2.0));
    let workspace = Workspace { pose, ..Workspace::default() };
    let eye = camera(40.0, -90.0);
    let options = || with_options(DetectOptions { model: "turned".to_owned(), ..low().detect });
    let detection = client.detect_from_depth(&[view(&eye)], &workspace, options()).await.unwrap();

    // The grid is rotated by -30° about its centre, so that the camera is at -60° in the frame of the grid.
    let middle = Isometry3::translation(0.15, 0.15, 0.0);
    let turn = Isometry3::rotation(Vector3::z() * -30_f64.to_radians());
    let task_from_grid = middle * turn * middle.inverse();
    let volume = fused(&[eye * task_from_grid], RESOLUTION, pose * task_from_grid);
    // Grasps in the corners of the rotated grid are dropped if they are outside the requested workspace.
    let all = client.detect(&volume, options()).await.unwrap().grasps;
    let between = |grasp: &Proposal| pose.inverse() * grasp.pose * Point3::new(0.0, 0.0, grasp::FINGER_DEPTH);
    let inside = |grasp: &&Proposal| between(grasp).iter().all(|c| (0.0..=WORKSPACE_SIZE).contains(c));
    let expected: Vec<Proposal> = all.iter().filter(inside).cloned().collect();
    assert!(detection.grasps.len() >= expected.len() && !expected.is_empty());
    for grasp in &expected {
        let near = |other: &Proposal| (other.pose.translation.vector - grasp.pose.translation.vector).norm() < 1e-9;
        assert!(detection.grasps.iter().any(near), "{grasp:?} is missing");
    }
    assert!(detection.grasps.iter().all(|grasp| inside(&grasp)), "a grasp is outside the workspace");

    let models = client.list_models().await.unwrap();
    let azimuth = |name: &str| models.iter().find(|model| model.name == name).unwrap().camera_azimuth;
    assert_eq!((azimuth("mirror"), azimuth("turned")), (None, Some(-60.0)));
    // A tracked volume that is rotated for one network cannot be used by another.
    let mut tracking = client.track(workspace).await.unwrap();
    tracking.add(&[view(&eye)], options()).await.unwrap();
    let (code, message) = refusal(tracking.add(&[], low()).await);
    assert_eq!(code, Code::InvalidArgument);
    assert!(message.starts_with("options.model is `mirror`, which requires a different grid"), "{message}");
}

/// What a camera sees as a point cloud in its own frame, as drivers publish it.
fn cloud(camera_from_task: &Isometry3<f64>) -> CloudView {
    let image = depth(camera_from_task);
    let pixels = image.iter().enumerate().filter(|(_, depth)| **depth > 0.0).map(|(index, &depth)| {
        let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
        let z = f64::from(depth);
        [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z].map(|c| c as f32)
    });
    CloudView {
        points: pixels.chain([[f32::NAN; 3]]).collect(),
        frame_from_cloud: Isometry3::identity(),
        camera_position: [0.0; 3],
        labels: None,
    }
}

#[tokio::test]
async fn point_clouds_give_grasps_in_the_workspace() {
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS)], &[]);
    let client = server.client().await;
    let pose = camera(35.0, -60.0);
    let cloud = CloudView { frame_from_cloud: pose.inverse(), ..cloud(&pose) };
    let network = client.detect_from_cloud(std::slice::from_ref(&cloud), &Workspace::default(), low()).await.unwrap();
    assert!(!network.grasps.is_empty() && network.latency.fusion > 0.0);
    let shaf = || with_options(DetectOptions { model: "shaf".to_owned(), ..DetectOptions::default() });
    let detection =
        client.detect_from_cloud(std::slice::from_ref(&cloud), &Workspace::default(), shaf()).await.unwrap();
    assert!(!detection.grasps.is_empty(), "{:?}", detection.dropped);
    detection.grasps.iter().for_each(assert_at_the_block);

    let inside = CloudView { camera_position: [0.0, 0.0, 0.6], ..cloud.clone() };
    let (code, message) = refusal(client.detect_from_cloud(&[inside], &Workspace::default(), low()).await);
    assert_eq!(code, Code::InvalidArgument);
    assert!(message.starts_with("views[0]: camera at") && message.contains("camera_position"), "{message}");
}

#[tokio::test]
async fn invalid_views_are_refused_with_the_field_and_the_value() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let pose = camera(30.0, -90.0);
    let good = || view(&pose);
    let workspace = Workspace::default();
    let refused = async |view: DepthView, begins: &str| {
        let (code, message) = refusal(client.detect_from_depth(&[good(), view], &workspace, low()).await);
        assert!(code == Code::InvalidArgument && message.starts_with(begins), "{code:?}: {message}");
        assert!(client.detect_from_depth(&[good()], &workspace, low()).await.is_ok(), "the connection stays usable");
    };

    let millimetres = depth(&pose).iter().map(|metres| metres * 1e3).collect();
    refused(
        DepthView { depth: Depth::Metres(millimetres), ..good() },
        "views[1].data: the median depth is above 20 m, so the values look like millimetres",
    )
    .await;
    let metres = depth(&pose).iter().map(|metres| metres.round() as u16).collect();
    refused(
        DepthView { depth: Depth::Millimetres(metres), ..good() },
        "views[1].data: the median depth is below 20 mm, so the values look like metres",
    )
    .await;
    let behind = Extrinsics::CameraFromTask(Isometry3::translation(-0.15, -0.15, -1.0));
    refused(
        DepthView { extrinsics: behind, ..good() },
        "views[1]: camera at (0.150, 0.150, 1.000) in the task frame sees none of the workspace; the workspace is behind the camera",
    )
    .await;
    let none = vec![f32::NAN; CAMERA.width * CAMERA.height];
    refused(DepthView { depth: Depth::Metres(none), ..good() }, "views[1]: camera at (0.15").await;
    let [fx, _, cx, _, fy, cy, ..] = good().k;
    let transposed = [fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1.0];
    refused(DepthView { k: transposed, ..good() }, "views[1].camera.k is [135.0").await;
    refused(DepthView { k: [0.0; 9], ..good() }, "views[1].camera.k is [0.0").await;
    let [half, centre] = [fx / 2.0, cx / 2.0];
    let smaller = [half, 0.0, centre, 0.0, half, cy / 2.0, 0.0, 0.0, 1.0];
    refused(DepthView { k: smaller, ..good() }, "views[1].camera.k is [67.5").await;
    refused(DepthView { width: 161, ..good() }, "views[1].data is 76800 bytes, 161 × 120 pixels need").await;

    let refused = async |views: &[DepthView], workspace: Workspace, begins: &str| {
        let (code, message) = refusal(client.detect_from_depth(views, &workspace, low()).await);
        assert!(code == Code::InvalidArgument && message.starts_with(begins), "{code:?}: {message}");
    };
    refused(&[], workspace, "views has 0 entries, must have from 1 to 64").await;
    refused(
        &[good()],
        Workspace { size: Some(0.5), ..workspace },
        "workspace.size is 0.5, must be 0.3 m (±0.1 %) or 0 for the model mirror",
    )
    .await;
    refused(&[good()], Workspace { size: Some(-1.0), ..workspace }, "workspace.size is -1, must be above 0").await;
    // A workspace above the scene, in front of the camera.
    let above = Workspace { pose: Isometry3::translation(0.0, 0.0, 0.25), ..Workspace::default() };
    let hand_eye = Extrinsics::FrameFromCamera(pose.inverse());
    let elsewhere = DepthView { extrinsics: hand_eye, ..good() };
    refused(&[elsewhere], above, "views: none shows a surface in the workspace").await;
}

#[tokio::test]
async fn the_scale_of_depths_is_corrected_by_the_table() {
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS)], &[]);
    let client = server.client().await;
    let cameras = [camera(30.0, -90.0), camera(40.0, 90.0)];
    let factors = [0.96, 1.03];
    let scaled = |camera: &Isometry3<f64>, factor: f32| {
        let depth = depth(camera).into_iter().map(|depth| depth / factor).collect();
        DepthView { depth: Depth::Metres(depth), ..view(camera) }
    };
    let good = cameras.map(|camera| view(&camera));
    let wrong: Vec<_> = cameras.iter().zip(factors).map(|(camera, factor)| scaled(camera, factor)).collect();
    let corrected = Workspace { correct_depth_scale: Some(true), ..Workspace::default() };
    let kept = Workspace { correct_depth_scale: Some(false), ..Workspace::default() };
    let detect = async |views: &[DepthView], workspace: &Workspace| {
        client.detect_from_depth(views, workspace, low()).await.unwrap()
    };
    let expected = detect(&good, &Workspace::default()).await;
    assert_eq!(expected.depth_factors, [1.0, 1.0], "nothing to correct");
    let codes = |warnings: &[pb::GeometryWarning]| warnings.iter().map(|warning| warning.code()).collect::<Vec<_>>();
    let uncorrected = detect(&wrong, &kept).await;
    assert_eq!(uncorrected.depth_factors, [0.0; 0]);
    assert!(!codes(&uncorrected.warnings).is_empty(), "the views disagree");

    let found = detect(&wrong, &corrected).await;
    assert_eq!(codes(&found.warnings), []);
    let by_default = detect(&wrong, &Workspace::default()).await;
    assert_eq!((&by_default.depth_factors, &by_default.grasps), (&found.depth_factors, &found.grasps));
    let told = codes(&by_default.warnings);
    assert!(
        !told.is_empty() && told.iter().all(|code| *code == WarningCode::DepthsCorrected),
        "{:?}",
        by_default.warnings
    );
    let is_close =
        |found: &[f64]| found.len() == 2 && found.iter().zip(factors).all(|(a, b)| (a - f64::from(b)).abs() < 2e-3);
    assert!(is_close(&found.depth_factors), "{:?}", found.depth_factors);
    assert_eq!(found.grasps.len(), expected.grasps.len());
    let distance = (found.grasps[0].pose.translation.vector - expected.grasps[0].pose.translation.vector).norm();
    assert!(distance < 2e-3, "{distance} m from the grasp in the views without an error");

    // Point clouds, scores and a tracked volume are corrected too.
    let cloud = |camera: &Isometry3<f64>, factor: f64| {
        let depth = depth(camera);
        let image = DepthImage::new(CAMERA, &depth).unwrap();
        let image: Vec<_> = image.points(camera).map(|point| point.position).collect();
        let eye = camera.inverse() * Point3::origin();
        let points = image.iter().map(|point| (eye + (point - eye) / factor).coords.cast().into()).collect();
        CloudView { points, camera_position: eye.coords.into(), frame_from_cloud: Isometry3::identity(), labels: None }
    };
    let clouds: Vec<_> = cameras.iter().zip(factors).map(|(camera, factor)| cloud(camera, factor.into())).collect();
    let found = client.detect_from_cloud(&clouds, &corrected, low()).await.unwrap();
    assert!(is_close(&found.depth_factors), "{:?}", found.depth_factors);
    let seen = Observation::Depth(&wrong, &corrected);
    let scored = client.score(seen, &[expected.grasps[0].pose], low()).await.unwrap();
    assert!(is_close(&scored.depth_factors), "{:?}", scored.depth_factors);
    let mut tracking = client.track(corrected).await.unwrap();
    let found = tracking.add(&wrong, low()).await.unwrap();
    assert!(is_close(&found.depth_factors), "{:?}", found.depth_factors);

    // By default a table that is 4 cm or 3° off is an error of a pose, and nothing is corrected. Neither are clouds.
    let hand_eye = |view: &DepthView, frame_from_camera: Isometry3<f64>| DepthView {
        extrinsics: Extrinsics::FrameFromCamera(frame_from_camera),
        ..view.clone()
    };
    let from_camera = cameras[0].inverse();
    let lowered = Isometry3::translation(0.0, 0.0, -0.04) * from_camera;
    let turned = Isometry3::rotation(Vector3::x() * 0.06) * from_camera;
    for (pose, code) in [(lowered, WarningCode::TableHeight), (turned, WarningCode::TableTilted)] {
        let found = detect(&[hand_eye(&good[0], pose)], &Workspace::default()).await;
        assert_eq!(found.depth_factors, [1.0]);
        assert!(codes(&found.warnings).contains(&code), "{:?}", found.warnings);
    }
    let found = client.detect_from_cloud(&clouds, &Workspace::default(), low()).await.unwrap();
    assert_eq!(found.depth_factors, [0.0; 0]);

    // Without a table at about its height the depths stay as they are, with a warning.
    let low = Workspace { pose: Isometry3::translation(0.0, 0.0, -0.1), ..corrected };
    let found = detect(&[hand_eye(&good[0], from_camera)], &low).await;
    assert_eq!(found.depth_factors, [1.0]);
    assert!(codes(&found.warnings).contains(&WarningCode::DepthScale), "{:?}", found.warnings);
    let both = Workspace { find_table: Some(FindTable::default()), ..corrected };
    let hand_eye = [hand_eye(&good[0], from_camera)];
    let (code, message) =
        refusal(client.detect_from_depth(&hand_eye, &both, with_options(DetectOptions::default())).await);
    assert!(code == Code::InvalidArgument && message.starts_with("workspace.correct_depth_scale is true"), "{message}");
    let none = Some(pb::CollisionCheck { table_height: Some(-1.0), ..Default::default() });
    let none = with_options(DetectOptions { collision: none, ..DetectOptions::default() });
    let (code, message) = refusal(client.detect_from_depth(&good, &corrected, none).await);
    assert!(code == Code::InvalidArgument && message.starts_with("workspace.correct_depth_scale is true"), "{message}");
}

#[tokio::test]
async fn planners_without_a_network_are_selected_by_name() {
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS)], &[]);
    let classifiers = server.models().join("classifiers");
    std::fs::create_dir(&classifiers).unwrap();
    let zoo = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo/classifiers/gpd.onnx");
    std::fs::copy(zoo, classifiers.join("gpd.onnx")).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    let client = server.client().await;
    let names: Vec<_> = client.list_models().await.unwrap().into_iter().map(|model| model.name).collect();
    assert_eq!(names, ["mirror", "gpd", "shaf"], "the network is the default, so it comes first");

    let cameras = [camera(30.0, -90.0), camera(40.0, 90.0)];
    let views = cameras.map(|camera| view(&camera));
    let volume = fused(&cameras, PAPERS, Isometry3::identity());
    for planner in ["gpd", "shaf"] {
        let options = || with_options(DetectOptions { model: planner.to_owned(), ..DetectOptions::default() });
        let seen = client.detect_from_depth(&views, &Workspace::default(), options()).await.unwrap();
        assert!(!seen.grasps.is_empty() && seen.model == planner, "{planner}: {:?}", seen.dropped);
        assert!(seen.grasps.is_sorted_by(|a, b| a.quality >= b.quality));
        seen.grasps.iter().for_each(assert_at_the_block);
        let again = client.detect_from_depth(&views, &Workspace::default(), options()).await.unwrap();
        assert_same(&again.grasps, &seen.grasps);
        // A volume has a coarser surface than depth images, but it suffices for grasps.
        let coarse = client.detect(&volume, options()).await.unwrap();
        assert!(!coarse.grasps.is_empty(), "{planner}: {:?}", coarse.dropped);
    }
    // Grasps with a quality below 0.5 are returned only for a lower threshold.
    let has_low_quality = async |threshold| {
        let detect = DetectOptions {
            model: "gpd".to_owned(),
            threshold: Some(threshold),
            max_grasps: 1000,
            ..DetectOptions::default()
        };
        let detection = client.detect_from_depth(&views, &Workspace::default(), with_options(detect)).await.unwrap();
        detection.grasps.iter().any(|grasp| grasp.quality < 0.5)
    };
    assert_eq!((has_low_quality(0.5).await, has_low_quality(0.001).await), (false, true));
    // A table height above the block leaves no points to grasp.
    let table = Some(pb::CollisionCheck { mode: Some(0), table_height: Some(0.2), ..Default::default() });
    let detect = DetectOptions { model: "shaf".to_owned(), collision: table, ..DetectOptions::default() };
    let none = client.detect_from_depth(&views, &Workspace::default(), with_options(detect)).await.unwrap();
    assert!(none.grasps.is_empty() && none.dropped.as_ref().unwrap().mask > 1000, "{:?}", none.dropped);
    let own =
        pb::Gripper { max_opening: 0.03, finger_depth: 0.05, finger_width: 0.01, finger_breadth: 0.02, palm: None };
    let detect = DetectOptions { model: "shaf".to_owned(), gripper: Some(own), ..DetectOptions::default() };
    let narrow = client.detect_from_depth(&views, &Workspace::default(), with_options(detect)).await.unwrap();
    let widest = narrow.grasps.iter().map(|grasp| grasp.width).fold(0.0, f64::max);
    assert!(widest <= 0.02, "a grasp of {widest} m for a hand with an opening of 3 cm");
}

#[tokio::test]
async fn an_evaluator_scores_the_grasps_of_its_network() {
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS)], &[]);
    let zoo = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo"));
    let evaluators = server.models().join("evaluators");
    std::fs::create_dir(&evaluators).unwrap();
    std::fs::copy(zoo.join("evaluators/vgn-refined.onnx"), evaluators.join("vgn-refined.onnx")).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 1.0).await;
    let client = server.client().await;
    let names = async || {
        let models = client.list_models().await.unwrap();
        models.into_iter().map(|model| model.name).collect::<Vec<_>>()
    };
    assert_eq!(names().await, ["mirror", "shaf"], "the evaluator is not served without its network");
    let network = server.models().join("vgn-packed.onnx");
    std::fs::copy(zoo.join("vgn-packed.onnx"), &network).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(names().await, ["mirror", "vgn-packed", "vgn-refined", "shaf"]);
    let models = client.list_models().await.unwrap();
    assert!(models[2].provenance["network"].starts_with("vgn-packed 4, sha256 "), "{:?}", models[2].provenance);
    assert_eq!((models[2].resolution, models[2].threshold), (40, 0.5));

    let views = [camera(30.0, -90.0), camera(40.0, 90.0)].map(|camera| view(&camera));
    let detect = async |model: &str| {
        let detect = DetectOptions { model: model.to_owned(), threshold: Some(0.01), ..DetectOptions::default() };
        client.detect_from_depth(&views, &Workspace::default(), with_options(detect)).await.unwrap()
    };
    let Detection { grasps: evaluated, latency, .. } = detect("vgn-refined").await;
    assert!(latency.evaluation > 0.0, "{latency:?}");
    let stages = [latency.queue, latency.preprocessing, latency.fusion, latency.inference, latency.postprocessing];
    assert!(stages.iter().sum::<f64>() + latency.evaluation <= latency.total, "{latency:?}");
    let series = format!(
        "graspd_stage_duration_seconds_sum{{model=\"{}\",stage=\"evaluation\"}}",
        format_args!("{} {}", models[2].name, models[2].version)
    );
    assert!((server.metric(&series) - latency.evaluation).abs() < 1e-9);
    assert!(!evaluated.is_empty() && evaluated.is_sorted_by(|a, b| a.quality >= b.quality));
    assert_at_the_block(&evaluated[0]);
    // Its former name.
    assert_same(&detect("graspd").await.grasps, &evaluated);
    let qualities = |grasps: &[Proposal]| grasps.iter().map(|grasp| grasp.quality).collect::<Vec<_>>();
    let alone = detect("vgn-packed").await;
    assert_eq!(alone.latency.evaluation, 0.0, "no evaluator");
    assert_ne!(qualities(&alone.grasps), qualities(&evaluated));

    // After the removal of the network's file the loaded evaluator stays.
    std::fs::remove_file(&network).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 2.0).await;
    assert_eq!(names().await, ["mirror", "vgn-refined", "shaf"]);
}

#[tokio::test]
async fn a_model_with_an_evaluator_can_be_the_default() {
    let zoo = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo"));
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("evaluators")).unwrap();
    for file in ["vgn-packed.onnx", "evaluators/vgn-refined.onnx"] {
        std::fs::copy(zoo.join(file), folder.path().join(file)).unwrap();
    }
    let models = folder.path().to_str().unwrap();
    let start = |default| {
        let flags = ["--models", models, "--provider", "cpu", "--default-model", default];
        let mut server = LocalServer::start(graspd(), flags)?;
        server.wait_ready().map(|()| server)
    };
    let server = start("graspd").unwrap();
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    assert_eq!(client.list_models().await.unwrap()[0].name, "vgn-refined");
    assert!(start("shaf").is_err(), "it has no network");
}

#[tokio::test]
async fn planning_stops_when_the_deadline_passes() {
    let server = Server::run(&[TestModel::new("mirror")], &["--workers", "1"]);
    let client = server.client().await;
    let checkered = |resolution: usize| {
        let value = |i: usize| {
            let [x, y, z] = [i / (resolution * resolution), i / resolution % resolution, i % resolution];
            if (x + y + z) % 2 == 0 { 0.25 } else { 0.75 }
        };
        let voxel_size = WORKSPACE_SIZE / resolution as f64;
        let values = (0..resolution.pow(3)).map(value).collect();
        Volume::new(resolution, voxel_size, Isometry3::identity(), values).unwrap()
    };
    // A hand as large as the workspace collides everywhere, so that planning takes minutes.
    let large =
        pb::Gripper { max_opening: 0.5, finger_depth: 0.5, finger_width: 0.01, finger_breadth: 0.5, palm: None };
    let shaf = |gripper| DetectOptions { model: "shaf".to_owned(), gripper, ..DetectOptions::default() };
    let short = Options { timeout: Some(Duration::from_millis(500)), ..with_options(shaf(Some(large))) };
    let late = client.detect(&checkered(100), short).await;
    // If the client's own timer ends the call first, the code is CANCELLED.
    let late = late.err().and_then(|error| error.code());
    assert!(matches!(late, Some(Code::DeadlineExceeded | Code::Cancelled)), "{late:?}");
    // There is one session: if the first request were still planned, this one would exceed its deadline.
    let volume = fused(&[camera(30.0, -90.0), camera(40.0, 90.0)], PAPERS, Isometry3::identity());
    let long = Options { timeout: Some(Duration::from_secs(20)), ..with_options(shaf(None)) };
    assert!(!client.detect(&volume, long).await.unwrap().grasps.is_empty());

    let finer = client.detect(&checkered(101), with_options(shaf(None))).await.unwrap_err().to_string();
    assert!(finer.contains("volume.resolution is 101, supported: at most 100 (shaf 1)"), "{finer}");
}

async fn detect_with(client: &Client, detect: DetectOptions) -> Detection {
    let views = [camera(30.0, -90.0), camera(40.0, 90.0)].map(|camera| view(&camera));
    let detect = DetectOptions { threshold: Some(0.6), ..detect };
    client.detect_from_depth(&views, &Workspace::default(), with_options(detect)).await.unwrap()
}

fn vector(x: f64, y: f64, z: f64) -> Option<pb::Vector3> {
    Some(pb::Vector3 { x, y, z })
}

#[tokio::test]
async fn region_approach_and_minimum_height_are_enforced() {
    // Grasps from above: rotated by 180° about x.
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS).rotation([1.0, 0.0, 0.0, 0.0])], &[]);
    let client = server.client().await;
    let all = detect_with(&client, DetectOptions::default()).await.grasps;
    let tips = |grasp: &Proposal| grasp.pose * Point3::new(0.0, 0.0, 0.05);

    let region = pb::Box { min: vector(0.1, 0.0, 0.0), max: vector(0.2, 0.15, 0.3) };
    let detection =
        detect_with(&client, DetectOptions { region: Some(region), explain: true, ..DetectOptions::default() }).await;
    assert!(!detection.grasps.is_empty() && detection.grasps.len() < all.len());
    assert!(detection.grasps.iter().all(|g| (0.1..=0.2).contains(&tips(g).x) && tips(g).y <= 0.15));
    assert!(detection.dropped.unwrap().region > 0);

    let cone = |z| Some(pb::Cone { axis: vector(0.0, 0.0, z), angle: 0.2 });
    assert_same(
        &detect_with(&client, DetectOptions { approach: cone(-3.0), ..DetectOptions::default() }).await.grasps,
        &all,
    );
    let up = detect_with(&client, DetectOptions { approach: cone(3.0), ..DetectOptions::default() }).await;
    assert!(
        up.grasps.is_empty() && up.dropped.is_some_and(|dropped| dropped.approach > 0),
        "an empty reply has the reason"
    );

    let high =
        detect_with(&client, DetectOptions { min_height: Some(0.12), explain: true, ..DetectOptions::default() }).await;
    assert!(high.grasps.iter().all(|g| tips(g).z >= 0.1199) && high.dropped.unwrap().height > 0);

    assert!(all.iter().all(|grasp| grasp.collides.is_none()), "collisions are checked only on request");
}

#[tokio::test]
async fn colliding_grasps_are_flagged_or_dropped() {
    // Horizontal grasps along x.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS).rotation([0.0, half, 0.0, half])], &[]);
    let client = server.client().await;
    // A hand without a palm, so that not every grasp collides with the table.
    let (max_opening, finger_depth, finger_width, finger_breadth) = (0.08, 0.05, 0.01, 0.02);
    let gripper = Some(pb::Gripper { max_opening, finger_depth, finger_width, finger_breadth, palm: None });
    let detect_with = async |client: &Client, detect| detect_with(client, DetectOptions { gripper, ..detect }).await;
    let all = detect_with(&client, DetectOptions::default()).await.grasps;
    let collision = |mode: i32| Some(pb::CollisionCheck { mode: Some(mode), ..Default::default() });
    let flagged =
        detect_with(&client, DetectOptions { collision: collision(1), ..DetectOptions::default() }).await.grasps;
    let filtered =
        detect_with(&client, DetectOptions { collision: collision(2), explain: true, ..DetectOptions::default() })
            .await;
    assert_same(&flagged, &all);
    let free: Vec<_> = flagged.iter().filter(|grasp| grasp.collides == Some(false)).copied().collect();
    assert!(free.len() < flagged.len(), "some grasps collide with the block or the table");
    let left = |grasp: &&Proposal| filtered.grasps.iter().any(|other| other.pose == grasp.pose);
    assert_eq!(free.iter().filter(left).count(), free.len());
    assert!(filtered.grasps.len() > free.len(), "neighbours of dropped grasps are added");
    assert!(filtered.dropped.unwrap().collision as usize >= flagged.len() - free.len());
    assert!(
        filtered.grasps.iter().all(|grasp| grasp.pose.translation.z >= TABLE + 0.01),
        "no grasp is below the table"
    );
    let buried = Some(pb::CollisionCheck { mode: Some(1), table_height: Some(0.3), ..Default::default() });
    let buried = detect_with(&client, DetectOptions { collision: buried, ..DetectOptions::default() }).await.grasps;
    assert!(buried.iter().all(|grasp| grasp.collides == Some(true)), "the table is above all grasps");
}

#[tokio::test]
async fn poses_have_the_requested_convention_pre_grasp_and_retreat() {
    let server = Server::run(&[TestModel::new("mirror").resolution(PAPERS).rotation([1.0, 0.0, 0.0, 0.0])], &[]);
    let client = server.client().await;
    let own = detect_with(&client, DetectOptions::default()).await.grasps;
    let offset = |a: &Isometry3<f64>, b: &Isometry3<f64>| (a.inverse() * b).translation.vector;
    for grasp in &own {
        assert!((offset(&grasp.pose, &grasp.pregrasp) - Vector3::new(0.0, 0.0, -0.05)).norm() < 1e-9);
        assert!((offset(&grasp.pose, &grasp.retreat) - Vector3::new(0.0, 0.0, -0.1)).norm() < 1e-9);
    }

    let detect = DetectOptions {
        convention: Some(pb::Convention { origin: 1, closing_axis: 1, parent_from_grasp: None }),
        pregrasp_distance: Some(0.12),
        retreat: Some(pb::Retreat { distance: Some(0.2), direction: vector(0.0, 0.0, 1.0) }),
        ..DetectOptions::default()
    };
    let converted = detect_with(&client, detect).await.grasps;
    for (own, converted) in own.iter().zip(&converted) {
        assert!(
            (offset(&own.pose, &converted.pose) - Vector3::new(0.0, 0.0, 0.05)).norm() < 1e-9,
            "the origin is between the fingertips"
        );
        let closing = own.pose.inverse() * (converted.pose * Vector3::x());
        assert!((closing - Vector3::y()).norm() < 1e-9, "the closing axis y becomes x");
        assert!((offset(&converted.pose, &converted.pregrasp) - Vector3::new(0.0, 0.0, -0.12)).norm() < 1e-9);
        let lifted = converted.retreat.translation.vector - converted.pose.translation.vector;
        assert!((lifted - Vector3::new(0.0, 0.0, 0.2)).norm() < 1e-9);
    }

    // Fingers of twice the depth: the base is further back, the fingertips are at the same place.
    let gripper =
        pb::Gripper { max_opening: 0.1, finger_depth: 0.1, finger_width: 0.01, finger_breadth: 0.02, palm: None };
    let long = detect_with(&client, DetectOptions { gripper: Some(gripper), ..DetectOptions::default() }).await.grasps;
    assert_eq!(long.len(), own.len());
    for (own, long) in own.iter().zip(&long) {
        assert!((offset(&own.pose, &long.pose) - Vector3::new(0.0, 0.0, -0.05)).norm() < 1e-9);
    }
    let bad = DetectOptions { gripper: Some(pb::Gripper { max_opening: 85.0, ..gripper }), ..DetectOptions::default() };
    let views = [view(&camera(30.0, -90.0))];
    let (code, message) = refusal(client.detect_from_depth(&views, &Workspace::default(), with_options(bad)).await);
    assert_eq!(code, Code::InvalidArgument);
    assert_eq!(message, "options.gripper.max_opening is 85 m, must be above 0 and at most 0.5");
}

#[tokio::test]
async fn wrong_geometry_is_reported_as_a_warning_and_counted() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let workspace = Workspace::default();
    let camera = camera(30.0, -90.0);
    let correct = client.detect_from_depth(&[view(&camera)], &workspace, low()).await.unwrap();
    assert_eq!(correct.warnings, []);

    let middle = Translation3::new(0.15, 0.15, TABLE);
    let tilted = camera * middle * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.2) * middle.inverse();
    let tilted = DepthView { extrinsics: Extrinsics::CameraFromTask(tilted), ..view(&camera) };
    let detection = client.detect_from_depth(std::slice::from_ref(&tilted), &workspace, low()).await.unwrap();
    let [warning] = &detection.warnings[..] else { panic!("{:?}", detection.warnings) };
    assert_eq!(warning.code(), WarningCode::TableTilted);
    assert!(warning.message.starts_with("the table is tilted by 11."), "{}", warning.message);
    assert!((warning.figures["tilt_degrees"] - 0.2_f64.to_degrees()).abs() < 1.0, "{warning:?}");

    // As DetectGrasps, and in a stream whose second view contradicts the first.
    let volume = fused(&[camera], RESOLUTION, Isometry3::identity());
    let lower = DetectOptions {
        collision: Some(pb::CollisionCheck { mode: Some(0), table_height: Some(0.02), ..Default::default() }),
        ..low().detect
    };
    let detection = client.detect(&volume, with_options(lower)).await.unwrap();
    let [warning] = &detection.warnings[..] else { panic!("{:?}", detection.warnings) };
    assert_eq!(warning.code(), WarningCode::TableHeight);
    assert!((warning.figures["height_m"] - TABLE).abs() < 0.005 && warning.figures["expected_height_m"] == 0.02);
    let none = DetectOptions {
        collision: Some(pb::CollisionCheck { mode: Some(0), table_height: Some(-1.0), ..Default::default() }),
        ..low().detect
    };
    assert_eq!(client.detect(&volume, with_options(none)).await.unwrap().warnings, []);

    let mut track = client.track(workspace).await.unwrap();
    assert_eq!(track.add(&[view(&camera)], low()).await.unwrap().warnings, []);
    let higher = camera * Translation3::new(0.0, 0.0, -0.04);
    let moved = DepthView { extrinsics: Extrinsics::CameraFromTask(higher), ..view(&camera) };
    let detection = track.add(&[moved], low()).await.unwrap();
    let codes: Vec<_> = detection.warnings.iter().map(pb::GeometryWarning::code).collect();
    assert!(codes.contains(&WarningCode::ViewsDisagree), "{codes:?}");

    let counted = |code: &str| server.metric(&format!("graspd_warnings_total{{code=\"{code}\",model=\"mirror 1\"}}"));
    assert_eq!(["TABLE_TILTED", "VIEWS_DISAGREE", "NO_TABLE"].map(counted), [1.0, 1.0, 0.0]);
}

#[tokio::test]
async fn the_table_is_found_in_the_first_view() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let camera_from_task = camera(35.0, -90.0);
    let of_frame = |pose| DepthView { extrinsics: Extrinsics::FrameFromCamera(pose), ..view(&camera_from_task) };
    let auto = Workspace { find_table: Some(FindTable::default()), ..Workspace::default() };

    // In the frame of the camera.
    let shaf = || with_options(DetectOptions { model: "shaf".to_owned(), ..DetectOptions::default() });
    let detection = client.detect_from_depth(&[of_frame(Isometry3::identity())], &auto, shaf()).await.unwrap();
    let table = detection.table.unwrap();
    let camera_from_found = grasp_proto::pose(table.workspace.as_ref().unwrap(), "workspace").unwrap();
    let height = (camera_from_task.inverse() * camera_from_found * Point3::new(0.15, 0.15, TABLE)).z;
    assert!((height - TABLE).abs() < 0.003, "{height}");
    assert!((table.angle.to_degrees() - 35.0).abs() < 1.0 && table.tilt.is_none(), "{table:?}");
    assert_eq!(detection.warnings, []);
    let best = detection.grasps[0];
    assert_at_the_block(&Proposal { pose: camera_from_task.inverse() * best.pose, ..best });

    // In the frame of the robot, with gravity, and with a second view.
    let gravity = FindTable { gravity: Some([0.0, 0.0, -9.81]) };
    let auto = Workspace { find_table: Some(gravity), ..Workspace::default() };
    let second = camera(45.0, 60.0);
    let views = [
        of_frame(camera_from_task.inverse()),
        DepthView { extrinsics: Extrinsics::FrameFromCamera(second.inverse()), ..view(&second) },
    ];
    let detection = client.detect_from_depth(&views, &auto, shaf()).await.unwrap();
    assert!(detection.table.unwrap().tilt.unwrap() < 0.02);
    assert_at_the_block(&detection.grasps[0]);
    let mut tracking = client.track(auto).await.unwrap();
    let tracked = tracking.add(&views[..1], low()).await.unwrap();
    assert!(tracked.table.is_some());
    assert!(tracking.add(&views[1..], low()).await.unwrap().table.is_none(), "it is found once");

    let refused = async |views: &[DepthView], find_table: FindTable, expected: &str| {
        let auto = Workspace { find_table: Some(find_table), ..Workspace::default() };
        let (code, message) = refusal(client.detect_from_depth(views, &auto, low()).await);
        assert_eq!(code, Code::InvalidArgument);
        assert!(message.contains(expected), "{message}");
    };
    let any = FindTable::default();
    refused(&[view(&camera_from_task)], any, "views[0].extrinsics is camera_from_task, must be frame_from_camera")
        .await;
    let second = [views[0].clone(), view(&camera_from_task)];
    refused(&second, any, "views[1].extrinsics is camera_from_task, must be frame_from_camera").await;
    let sideways = FindTable { gravity: Some([1.0, 0.0, 0.0]) };
    refused(&views[..1], sideways, "views[0].data: the largest level plane near the middle").await;
    let nowhere = FindTable { gravity: Some([0.0; 3]) };
    refused(&views[..1], nowhere, "workspace.gravity is (0, 0, 0), must be finite and of a length above 0").await;
    let nothing = DepthView { depth: Depth::Metres(vec![0.0; 160 * 120]), ..views[0].clone() };
    refused(&[nothing], any, "views[0].data: no pixel has a depth of at most 2 m").await;
}

#[tokio::test]
async fn the_table_is_found_in_a_point_cloud() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let camera_from_task = camera(35.0, -90.0);
    let auto = Workspace { find_table: Some(FindTable::default()), ..Workspace::default() };
    let seen = cloud(&camera_from_task);
    let shaf = || with_options(DetectOptions { model: "shaf".to_owned(), ..DetectOptions::default() });
    let detection = client.detect_from_cloud(std::slice::from_ref(&seen), &auto, shaf()).await.unwrap();
    let table = detection.table.unwrap();
    let camera_from_found = grasp_proto::pose(table.workspace.as_ref().unwrap(), "workspace").unwrap();
    let height = (camera_from_task.inverse() * camera_from_found * Point3::new(0.15, 0.15, TABLE)).z;
    assert!((height - TABLE).abs() < 0.004, "{height}");
    assert!((table.angle.to_degrees() - 35.0).abs() < 6.0 && table.tilt.is_none(), "{table:?}");
    let best = detection.grasps[0];
    assert_at_the_block(&Proposal { pose: camera_from_task.inverse() * best.pose, ..best });

    let refused = async |view: CloudView, expected: &str| {
        let (code, message) = refusal(client.detect_from_cloud(&[view], &auto, low()).await);
        assert_eq!(code, Code::InvalidArgument);
        assert!(message.contains(expected), "{message}");
    };
    let inside =
        CloudView { points: vec![[0.1, 0.1, 0.1]], camera_position: [0.1_f32; 3].map(f64::from), ..seen.clone() };
    refused(inside, "views[0].camera_position is (0.1").await;
    let line = (0..1000).map(|index| [index as f32 * 1e-4, 0.0, 0.5]).collect();
    refused(CloudView { points: line, ..seen }, "views[0].points: seen from camera_position, only").await;
}
