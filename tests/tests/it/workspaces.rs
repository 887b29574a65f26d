//! Workspaces of any size, objects, the caller's own grasps, and the space that the cameras did not see.

use std::path::Path;

use grasp_client::{
    Client, DepthView, DetectOptions, Error, Extrinsics, FindTable, Observation, Options, Proposal, Workspace, pb,
};
use grasp_tests::scene::{TABLE, camera, camera_at, labelled, view};
use grasp_tests::{Server, TestModel};
use nalgebra::{Isometry3, Point3, Vector3};
use pb::score::Violation;
use tonic::Code;

/// A box of 4 × 6 × 8 cm with its middle at (x, y).
const fn block(x: f64, y: f64) -> [[f64; 3]; 2] {
    [[x - 0.02, y - 0.03, TABLE], [x + 0.02, y + 0.03, TABLE + 0.08]]
}

/// Four boxes on a table of 0.9 × 0.5 m.
const BOXES: [[[f64; 3]; 2]; 4] = [block(0.1, 0.1), block(0.36, 0.25), block(0.6, 0.4), block(0.82, 0.12)];

fn tabletop() -> Workspace {
    Workspace { extent: Some([0.9, 0.5]), ..Workspace::default() }
}

/// The boxes from two sides, with labels.
fn views() -> [DepthView; 2] {
    let camera = |azimuth| camera_at(Point3::new(0.45, 0.25, 0.08), 0.8, 35.0, azimuth);
    [-90.0, 90.0].map(|azimuth| labelled(&BOXES, &camera(azimuth)))
}

/// A server with the default model of the zoo.
async fn server(args: &[&str]) -> (Server, Client) {
    let server = Server::run(&[TestModel::new("mirror")], args);
    let zoo = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo"));
    std::fs::create_dir(server.models().join("evaluators")).unwrap();
    for file in ["vgn-packed.onnx", "evaluators/vgn-refined.onnx"] {
        std::fs::copy(zoo.join(file), server.models().join(file)).unwrap();
    }
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    let client = server.client().await;
    (server, client)
}

fn options(detect: DetectOptions) -> Options {
    let model = if detect.model.is_empty() { "vgn-refined".to_owned() } else { detect.model.clone() };
    Options { detect: DetectOptions { model, ..detect }, ..Options::default() }
}

fn collision(mode: pb::collision_check::Mode, hidden: bool) -> Option<pb::CollisionCheck> {
    Some(pb::CollisionCheck { mode: Some(mode.into()), hidden, ..Default::default() })
}

fn refusal<T: std::fmt::Debug>(outcome: Result<T, Error>) -> String {
    match outcome {
        Err(Error::Refused { code: Code::InvalidArgument, message, .. }) => message,
        other => panic!("{other:?}"),
    }
}

/// The number of the box between the fingertips, counted from 1.
fn box_of(grasp: &Proposal) -> Option<u32> {
    let between = grasp.pose * Point3::new(0.0, 0.0, 0.04);
    let is_in = |corners: &[[f64; 3]; 2]| {
        (0..3).all(|axis| (corners[0][axis] - 0.02..=corners[1][axis] + 0.02).contains(&between[axis]))
    };
    BOXES.iter().position(is_in).map(|index| index as u32 + 1)
}

#[tokio::test]
async fn a_large_workspace_has_the_grasps_of_all_objects() {
    let (server, client) = server(&[]).await;
    for model in ["vgn-refined", "shaf"] {
        let detect = DetectOptions { model: model.to_owned(), explain: true, ..DetectOptions::default() };
        let detection = client.detect_from_depth(&views(), &tabletop(), options(detect)).await.unwrap();
        for number in 1..=4 {
            let of_box = detection.grasps.iter().filter(|grasp| box_of(grasp) == Some(number));
            let best = of_box.map(|grasp| grasp.quality).fold(0.0, f32::max);
            assert!(best > 0.5 || model == "shaf" && best > 0.0, "{model}, box {number}: {best}");
        }
        assert!(detection.grasps.is_sorted_by(|a, b| a.quality >= b.quality));
        for grasp in &detection.grasps {
            let number = box_of(grasp);
            assert!(number.is_none() || grasp.object == number, "{model}: {grasp:?} is on the box {number:?}");
        }
        let positions = || detection.grasps.iter().enumerate();
        for (index, grasp) in positions() {
            let same = |(other, twin): (usize, &Proposal)| {
                other != index && (twin.pose.translation.vector - grasp.pose.translation.vector).norm() < 1e-6
            };
            assert!(!positions().any(same), "{model}: two cubes give the same grasp");
        }
    }
    let cubes = server.metric("graspd_batch_size_sum{model=\"vgn-refined 9\"}");
    assert!((4.0..15.0).contains(&cubes), "{cubes} of 15 cubes have an object");

    // A single cube has the grasps of the box in it.
    let single = client.detect_from_depth(&views(), &Workspace::default(), options(DetectOptions::default())).await;
    assert!(single.unwrap().grasps.iter().all(|grasp| box_of(grasp) == Some(1)));
}

#[tokio::test]
async fn cubes_that_margins_fill_are_refused_before_they_need_memory() {
    let (_server, client) = server(&[]).await;
    let refused = async |size: f64, margin: f64| {
        let workspace = Workspace { size: Some(size), extent: Some([2.0, 2.0]), ..Workspace::default() };
        let model = "shaf".to_owned();
        let detect = DetectOptions { model, margin: Some(margin), ..DetectOptions::default() };
        refusal(client.detect_from_depth(&views(), &workspace, options(detect)).await)
    };
    for (size, margin) in [(0.1, 0.0), (0.02, 0.0), (0.2, 0.1)] {
        let message = refused(size, margin).await;
        assert!(
            message.starts_with("workspace.extent: cubes with an edge of") && message.contains("options.margin"),
            "{message}"
        );
    }
    let message = refused(0.1001, 0.0).await;
    assert!(message.contains("which needs 400") && message.contains("at most 100"), "{message}");
}

#[tokio::test]
async fn a_cube_of_another_size_has_its_middle_over_the_objects_too() {
    let (_server, client) = server(&[]).await;
    let camera = camera_at(Point3::new(0.36, 0.25, 0.08), 0.6, 30.0, -90.0);
    let of_camera = Extrinsics::FrameFromCamera(Isometry3::identity());
    let view = DepthView { extrinsics: of_camera, ..labelled(&BOXES[1..2], &camera) };
    let mut middles = Vec::new();
    for size in [None, Some(0.5)] {
        let workspace = Workspace { size, find_table: Some(FindTable::default()), ..Workspace::default() };
        let model = "shaf".to_owned();
        let detect = DetectOptions { model, ..DetectOptions::default() };
        let views = std::slice::from_ref(&view);
        let table = client.detect_from_depth(views, &workspace, options(detect)).await.unwrap().table.unwrap();
        let half = size.unwrap_or(0.3) / 2.0;
        let pose = grasp_proto::pose(table.workspace.as_ref().unwrap(), "workspace").unwrap();
        middles.push(pose * Point3::new(half, half, TABLE));
    }
    assert!((middles[0] - middles[1]).norm() < 1e-6, "{middles:?}");
}

#[tokio::test]
async fn a_large_workspace_is_placed_over_the_table_that_was_found() {
    let (_server, client) = server(&[]).await;
    let camera = camera_at(Point3::new(0.45, 0.25, 0.08), 0.8, 30.0, -90.0);
    let of_camera = Extrinsics::FrameFromCamera(Isometry3::identity());
    let view = DepthView { extrinsics: of_camera, ..labelled(&BOXES, &camera) };
    let workspace =
        Workspace { extent: Some([1.0, 0.7]), find_table: Some(FindTable::default()), ..Workspace::default() };
    let detection = client.detect_from_depth(&[view], &workspace, options(DetectOptions::default())).await.unwrap();
    let mut found: Vec<u32> = detection.grasps.iter().filter_map(|grasp| grasp.object).collect();
    found.sort_unstable();
    found.dedup();
    assert_eq!(found, [1, 2, 3, 4]);
    let in_task = Proposal { pose: camera.inverse() * detection.grasps[0].pose, ..detection.grasps[0] };
    assert_eq!(box_of(&in_task), detection.grasps[0].object);
}

/// The view of a camera whose pose is unknown, without labels.
fn unlabelled(boxes: &[[[f64; 3]; 2]], camera: &Isometry3<f64>) -> DepthView {
    let extrinsics = Extrinsics::FrameFromCamera(Isometry3::identity());
    DepthView { extrinsics, labels: None, ..labelled(boxes, camera) }
}

#[tokio::test]
async fn one_image_without_labels_has_the_grasps_of_all_objects_and_of_nothing_else() {
    let (_server, client) = server(&[]).await;
    let camera = camera_at(Point3::new(0.45, 0.25, 0.08), 0.8, 30.0, -90.0);
    // A wall behind the table, as thick as a hand opens.
    let wall = [[-0.6, 0.62, TABLE], [1.6, 0.66, TABLE + 0.15]];
    let view = unlabelled(&[BOXES.as_slice(), &[wall]].concat(), &camera);
    let workspace = Workspace { find_table: Some(FindTable::default()), ..Workspace::default() };
    let detect = DetectOptions { max_grasps_per_object: 2, explain: true, ..DetectOptions::default() };
    let detection = client.detect_from_depth(&[view], &workspace, options(detect)).await.unwrap();
    let table = detection.table.unwrap();
    let extent = table.extent.unwrap();
    assert_eq!(table.objects, 4);
    assert!(extent.x > 0.9 && extent.y > 0.5, "{extent:?}");
    let in_task = |grasp: &Proposal| Proposal { pose: camera.inverse() * grasp.pose, ..*grasp };
    let mut found = Vec::new();
    for grasp in &detection.grasps {
        let number = box_of(&in_task(grasp));
        assert!(number.is_some(), "{grasp:?} is on no box");
        assert!((1..=4).contains(&grasp.object.unwrap()));
        found.push((number, grasp.object));
    }
    found.sort_unstable();
    found.dedup();
    assert_eq!(found.len(), 4, "each box has one number: {found:?}");
    assert!(detection.dropped.unwrap().object > 0, "the wall has grasps, which are counted");
    // The camera is 0.8 m from the middle of the whole workspace.
    let warnings = &detection.warnings;
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!((warnings[0].figures["distance_m"] - 0.8).abs() < 0.1, "{warnings:?}");

    // Cubes without room between the margins stay one.
    let small = Workspace { size: Some(0.09), ..workspace };
    let shaf = DetectOptions { model: "shaf".to_owned(), ..DetectOptions::default() };
    let found = client.detect_from_depth(&[unlabelled(&BOXES, &camera)], &small, options(shaf)).await.unwrap();
    assert_eq!(found.table.unwrap().extent, Some(pb::Extent { x: 0.09, y: 0.09 }));
}

#[tokio::test]
async fn objects_beyond_the_queue_are_left_out_with_a_warning() {
    let (_server, client) = server(&["--queue", "2", "--workers", "1"]).await;
    let camera = camera_at(Point3::new(0.45, 0.25, 0.08), 0.8, 30.0, -90.0);
    let workspace = Workspace { find_table: Some(FindTable::default()), ..Workspace::default() };
    let view = unlabelled(&BOXES, &camera);
    let detection = client.detect_from_depth(&[view], &workspace, options(DetectOptions::default())).await.unwrap();
    let warning = &detection.warnings[0];
    assert_eq!(warning.code(), pb::geometry_warning::Code::ObjectsLeftOut);
    assert!(warning.message.starts_with("2 of the 4 objects on the table are not in the workspace, which has 2 cubes"));
}

#[tokio::test]
async fn collisions_are_checked_across_cubes_and_by_default_with_views() {
    let (_server, client) = server(&[]).await;
    // Too little room between the boxes for a finger.
    let boxes: Vec<_> = (0..6).map(|index| block(0.1 + 0.05 * f64::from(index), 0.25)).collect();
    let camera = camera_at(Point3::new(0.25, 0.25, 0.08), 0.7, 30.0, -90.0);
    let views = [DepthView { extrinsics: Extrinsics::FrameFromCamera(camera.inverse()), ..labelled(&boxes, &camera) }];
    // With this margin the voxels of all cubes are those of one grid.
    let workspace = Workspace { extent: Some([0.45, 0.45]), ..Workspace::default() };
    let detect = async |collision| {
        let detect = DetectOptions { collision, margin: Some(0.075), ..DetectOptions::default() };
        client.detect_from_depth(&views, &workspace, options(detect)).await.unwrap().grasps
    };
    use pb::collision_check::Mode;
    let (by_default, filtered) = (detect(None).await, detect(collision(Mode::Filter, false)).await);
    assert_eq!(by_default, filtered);
    let flagged = detect(collision(Mode::Flag, false)).await;
    assert!(flagged.iter().any(|grasp| grasp.collides == Some(true)), "{flagged:?}");
    assert!(detect(collision(Mode::Off, false)).await.iter().all(|grasp| grasp.collides.is_none()));
    // Scored in a cube around it, a grasp is as good as in the cube that it comes from, and free of collisions.
    for grasp in by_default.iter().take(5) {
        let at = grasp.pose * Point3::new(0.0, 0.0, 0.05);
        let [x, y] = [at.x, at.y].map(|c| ((c - 0.15) / 0.0075).round() * 0.0075);
        let corner = Isometry3::translation(x, y, 0.0);
        let centred = Workspace { pose: corner, ..Workspace::default() };
        let seen = Observation::Depth(&views, &centred);
        let scores = client.score(seen, &[grasp.pose], options(DetectOptions::default())).await.unwrap().scores;
        assert!(!scores[0].violations.contains(&Violation::Collision.into()), "{grasp:?}: {scores:?}");
        assert!((scores[0].quality - grasp.quality).abs() < 0.05, "{grasp:?}: {scores:?}");
    }
}

#[tokio::test]
async fn a_workspace_that_the_queue_cannot_hold_is_refused() {
    let (_server, client) = server(&["--queue", "1", "--workers", "1"]).await;
    let refused = refusal(client.detect_from_depth(&views(), &tabletop(), options(DetectOptions::default())).await);
    assert!(refused.starts_with("workspace.extent is a workspace of ") && refused.ends_with("(--queue)"), "{refused}");
    let fine = options(DetectOptions { margin: Some(0.1), ..DetectOptions::default() });
    let large = Workspace { extent: Some([2.0, 1.5]), ..Workspace::default() };
    let refused = refusal(client.detect_from_depth(&views(), &large, fine).await);
    assert!(
        refused.starts_with("workspace.extent is 2 × 1.5 m, which needs 300 cubes, must need at most 100"),
        "{refused}"
    );
    let long = Workspace { extent: Some([0.5, 3.0]), ..Workspace::default() };
    let refused = refusal(client.detect_from_depth(&views(), &long, options(DetectOptions::default())).await);
    assert_eq!(refused, "workspace.extent.y is 3, must be above 0 and at most 2 m");
}

#[tokio::test]
async fn grasps_of_chosen_objects_only() {
    let (_server, client) = server(&[]).await;
    let detect = async |detect: DetectOptions, workspace: &Workspace| {
        client.detect_from_depth(&views(), workspace, options(detect)).await.unwrap()
    };
    let chosen = DetectOptions { objects: vec![2, 4], explain: true, ..DetectOptions::default() };
    let detection = detect(chosen, &tabletop()).await;
    let of = |number| detection.grasps.iter().filter(|grasp| grasp.object == Some(number)).count();
    assert!(of(2) > 0 && of(4) > 0 && of(2) + of(4) == detection.grasps.len(), "{:?}", detection.grasps);
    assert!(detection.dropped.unwrap().object > 0);

    let limited = DetectOptions { max_grasps_per_object: 1, ..DetectOptions::default() };
    let mut objects: Vec<_> = detect(limited, &tabletop()).await.grasps.iter().map(|grasp| grasp.object).collect();
    objects.sort_unstable();
    assert_eq!(objects, [1, 2, 3, 4].map(Some));

    let absent = options(DetectOptions { objects: vec![2, 9], ..DetectOptions::default() });
    let refused = refusal(client.detect_from_depth(&views(), &tabletop(), absent).await);
    assert_eq!(refused, "options.objects: no pixel or point with a depth has the label 9");

    let unlabelled = views().map(|view| DepthView { labels: None, ..view });
    let asked = options(DetectOptions { objects: vec![2], ..DetectOptions::default() });
    let refused = refusal(client.detect_from_depth(&unlabelled, &tabletop(), asked).await);
    assert_eq!(refused, "options.objects: object 2 needs views with labels");
    let [mut first, second] = views();
    first.labels = Some(vec![1; 7]);
    let refused =
        refusal(client.detect_from_depth(&[first, second], &tabletop(), options(DetectOptions::default())).await);
    assert!(refused.starts_with("views[0].labels.data: 7 bytes; 160 × 120 pixels need 19200"), "{refused}");
}

#[tokio::test]
async fn the_callers_grasps_are_scored_in_their_order() {
    let (_server, client) = server(&[]).await;
    let views = [-90.0, 90.0].map(|azimuth| view(&camera(35.0, azimuth)));
    let workspace = Workspace::default();
    let detection = client.detect_from_depth(&views, &workspace, options(DetectOptions::default())).await.unwrap();
    let best = detection.grasps[0];
    let elsewhere = Isometry3::translation(2.0, 0.0, 0.0) * best.pose;
    let into_table = Isometry3::translation(0.0, 0.0, -0.08) * best.pose;
    let candidates = [elsewhere, best.pose, into_table];
    let seen = Observation::Depth(&views, &workspace);
    let checked = DetectOptions { collision: collision(pb::collision_check::Mode::Flag, false), ..Default::default() };
    let scores = client.score(seen, &candidates, options(checked.clone())).await.unwrap();
    assert_eq!((scores.model.as_str(), scores.scores.len()), ("vgn-refined", 3));
    let violations = |index: usize| scores.scores[index].violations().collect::<Vec<_>>();
    assert_eq!(scores.scores[0].quality, 0.0);
    assert_eq!(violations(0), [Violation::Quality, Violation::Region]);
    assert!(
        (scores.scores[1].quality - best.quality).abs() < 0.01,
        "{} not {}",
        scores.scores[1].quality,
        best.quality
    );
    assert!(scores.scores[1].open_width.is_some_and(|width| width > best.width && width <= 0.08 + 1e-6));
    assert!(violations(2).contains(&Violation::Collision) && scores.scores[2].open_width.is_none());

    // A network alone predicts the quality at the position.
    let network = DetectOptions { model: "vgn-packed".to_owned(), threshold: Some(0.3), ..DetectOptions::default() };
    let detection = client.detect_from_depth(&views, &workspace, options(network.clone())).await.unwrap();
    let poses: Vec<_> = detection.grasps.iter().map(|grasp| grasp.pose).collect();
    let scores = client.score(seen, &poses, options(network)).await.unwrap();
    for (score, grasp) in scores.scores.iter().zip(&detection.grasps) {
        assert!((score.quality - grasp.quality).abs() < 1e-4 && score.violations.is_empty(), "{score:?} {grasp:?}");
    }

    let shaf = options(DetectOptions { model: "shaf".to_owned(), ..DetectOptions::default() });
    let refused = refusal(client.score(seen, &poses, shaf).await);
    assert_eq!(refused, "options.model is `shaf`, which has no network and cannot score");
    assert!(refusal(client.score(seen, &[], options(checked)).await).starts_with("candidates has 0 entries"));
    let [mut first, second] = views.clone();
    first.width = 0;
    let refused = refusal(
        client.score(Observation::Depth(&[first, second], &workspace), &poses, options(Default::default())).await,
    );
    assert!(refused.starts_with("depth.views[0].camera.width is 0"), "{refused}");
    let large = tabletop();
    let refused = refusal(client.score(Observation::Depth(&views, &large), &poses, options(Default::default())).await);
    assert_eq!(refused, "depth.workspace.extent is given, must be absent");
}

#[tokio::test]
async fn hidden_space_is_an_obstacle_on_request() {
    let (_server, client) = server(&[]).await;
    // The hand closes along x, the shorter side of the block; from +x one of its fingers is hidden.
    let views = [view(&camera(60.0, 0.0))];
    let detect = async |hidden| {
        let collision = collision(pb::collision_check::Mode::Flag, hidden);
        let model = "vgn-packed".to_owned();
        let detect = DetectOptions { model, threshold: Some(0.05), collision, ..DetectOptions::default() };
        client.detect_from_depth(&views, &Workspace::default(), options(detect)).await.unwrap().grasps
    };
    let collisions = |grasps: &[Proposal]| grasps.iter().filter(|grasp| grasp.collides == Some(true)).count();
    let (free, occupied) = (detect(false).await, detect(true).await);
    assert_eq!(free.len(), occupied.len());
    assert!(collisions(&occupied) > collisions(&free), "{} and {}", collisions(&occupied), collisions(&free));
    for (free, occupied) in free.iter().zip(&occupied) {
        let [wide, narrow] = [free, occupied].map(|grasp| grasp.open_width.unwrap_or_default());
        assert!(narrow <= wide, "less room with hidden space");
    }

    let volume = grasp_tests::blobs(40, Isometry3::identity(), &[[20, 20, 14]]);
    let detect = DetectOptions { collision: collision(pb::collision_check::Mode::Filter, true), ..Default::default() };
    let refused = refusal(client.detect(&volume, options(detect)).await);
    assert!(refused.starts_with("options.collision.hidden is true, needs depth images"), "{refused}");
}

#[tokio::test]
async fn a_margin_keeps_grasps_away_from_the_sides() {
    let (_server, client) = server(&[]).await;
    // The block in the middle of the scene is near a side of this cube.
    let pose = Isometry3::translation(0.11, 0.0, 0.0);
    let workspace = Workspace { pose, ..Workspace::default() };
    let camera_from_task = |azimuth| Extrinsics::FrameFromCamera(camera(35.0, azimuth).inverse());
    let views = [-90.0, 90.0]
        .map(|azimuth| DepthView { extrinsics: camera_from_task(azimuth), ..view(&camera(35.0, azimuth)) });
    let detect = async |margin| {
        let detect = DetectOptions { margin, threshold: Some(0.05), ..DetectOptions::default() };
        client.detect_from_depth(&views, &workspace, options(detect)).await.unwrap().grasps
    };
    let nearest = |grasps: &[Proposal]| {
        let between = |grasp: &Proposal| (grasp.pose * Point3::from(Vector3::z() * 0.05)).x - 0.11;
        grasps.iter().map(between).fold(f64::INFINITY, f64::min)
    };
    let small = Workspace { size: Some(0.15), ..workspace };
    let wide = DetectOptions { margin: Some(0.1), model: "shaf".to_owned(), ..DetectOptions::default() };
    let message = refusal(client.detect_from_depth(&views, &small, options(wide)).await);
    assert_eq!(message, "options.margin is 0.1, must be below 0.075 m, half of the cube's edge");
    let (all, inner) = (detect(None).await, detect(Some(0.05)).await);
    assert!(!all.is_empty() && nearest(&all) < 0.05, "{}", nearest(&all));
    assert!(nearest(&inner) >= 0.05, "{}", nearest(&inner));
}
