//! Warnings about the geometry of an observation: none for correct views of the benchmark's scenes, and one for each
//! mistake that the volume shows.

use grasp::{DepthImage, Fusion, Intrinsics, RESOLUTION, WORKSPACE_SIZE};
use grasp_perception::Warning;
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, View, Views, observe};
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::scene::SceneKind;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// Views without noise of 12 packed scenes and piles.
fn observations(views: &Views) -> Vec<Vec<View>> {
    let kinds = [(SceneKind::Packed, Split::PackedTest), (SceneKind::Pile, Split::PileTest)];
    let of_kind = |(kind, split)| {
        let objects = ObjectSet::procedural(split);
        let bench =
            Benchmark { kind, objects, count: 5, views: views.clone(), noise: DepthNoise::NONE, rounds: 6, seed: 5 };
        (0..bench.rounds).map(move |number| {
            let (world, mut rng) = bench.scene(number);
            observe(&world, &bench.views, bench.noise, &mut rng)
        })
    };
    kinds.into_iter().flat_map(of_kind).collect()
}

/// The warnings about views that are fused one after the other.
fn warnings(views: &[(View, Intrinsics)]) -> Vec<Warning> {
    let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
    let mut warnings = Vec::new();
    for (index, (view, intrinsics)) in views.iter().enumerate() {
        let image = DepthImage::new(*intrinsics, &view.depth).unwrap();
        let eye = view.camera_from_task.inverse().translation.vector.into();
        warnings.extend(Warning::of_camera(index, &eye, [WORKSPACE_SIZE / 2.0; 2]));
        warnings.extend(Warning::of_view(index, &fusion, &image, &view.camera_from_task));
        assert!(fusion.integrate(&image, &view.camera_from_task) > 0, "the camera sees the workspace");
    }
    warnings.extend(Warning::of_coverage(&fusion, 0));
    let volume = fusion.volume(Isometry3::identity());
    warnings.extend(volume.ok().and_then(|volume| Warning::of_table(&volume, TABLE_HEIGHT)));
    warnings
}

fn correct(views: Vec<View>) -> Vec<(View, Intrinsics)> {
    views.into_iter().map(|view| (view, Intrinsics::BENCHMARK)).collect()
}

/// The warnings about each scene, whose only view is changed.
fn after(change: impl Fn(&mut View, &mut Intrinsics)) -> Vec<Vec<Warning>> {
    let changed = |mut views: Vec<View>| {
        let mut intrinsics = Intrinsics::BENCHMARK;
        change(&mut views[0], &mut intrinsics);
        warnings(&[(views.remove(0), intrinsics)])
    };
    observations(&Views::Side { azimuth: 0.0 }).into_iter().map(changed).collect()
}

fn moved(by: Isometry3<f64>) -> impl Fn(&mut View, &mut Intrinsics) {
    move |view, _| view.camera_from_task *= by
}

#[test]
fn correct_views_give_no_warning() {
    for views in [Views::Side { azimuth: 0.0 }, Views::Circle, Views::Random(1..=1), Views::Random(2..=6)] {
        for (scene, observed) in observations(&views).into_iter().enumerate() {
            assert_eq!(warnings(&correct(observed)), [], "scene {scene}, {views:?}");
        }
    }
}

#[test]
fn a_wrong_height_is_measured() {
    for found in after(moved(Isometry3::translation(0.0, 0.0, -0.02))) {
        let [Warning::TableHeight { height, .. }] = found[..] else { panic!("{found:?}") };
        assert!((height - 0.07).abs() < 0.003, "{height}");
    }
}

#[test]
fn a_tilted_camera_pose_is_measured() {
    let middle = Translation3::new(0.15, 0.15, TABLE_HEIGHT);
    for axis in [Vector3::x_axis(), Vector3::y_axis()] {
        let rotation = UnitQuaternion::from_axis_angle(&axis, 0.14);
        for found in after(moved(middle * rotation * middle.inverse())) {
            let [Warning::TableTilted { tilt }] = found[..] else { panic!("{found:?}") };
            assert!((tilt - 0.14).abs() < 0.01, "{tilt}");
        }
    }
}

#[test]
fn the_intrinsics_of_another_camera_tilt_the_table() {
    for found in after(|_, k| (k.fx, k.fy) = (700.0, 700.0)) {
        assert!(matches!(found[..], [Warning::TableTilted { .. }]), "{found:?}");
    }
}

#[test]
fn an_image_upside_down_shows_no_level_table() {
    for found in after(|view, _| view.depth.reverse()) {
        let of_table = |w: &Warning| matches!(w, Warning::NoTable { .. } | Warning::TableTilted { .. });
        assert!(found.iter().any(of_table), "{found:?}");
    }
}

#[test]
fn a_table_that_was_cut_away_is_missed() {
    for found in after(moved(Isometry3::translation(0.0, 0.0, 0.07))) {
        assert!(matches!(found[..], [.., Warning::NoTable { .. }]), "{found:?}");
    }
}

#[test]
fn views_with_different_poses_contradict_one_another() {
    for mut views in observations(&Views::Circle) {
        // Three centimetres, as when the frames of two cameras are not the same.
        views[3].camera_from_task *= Isometry3::translation(0.0, 0.0, -0.03);
        let found = warnings(&correct(views));
        assert!(found.iter().any(|w| matches!(w, Warning::ViewsDisagree { view: 3, .. })), "{found:?}");
    }
}

#[test]
fn a_camera_out_of_the_range_of_the_training_is_named() {
    let distant = after(|view, _| view.camera_from_task = Translation3::new(0.0, 0.0, 0.4) * view.camera_from_task);
    for found in distant {
        let is_distance = |w: &&Warning| matches!(w, Warning::CameraDistance { view: 0, .. });
        let Some(Warning::CameraDistance { distance, .. }) = found.iter().find(is_distance) else {
            panic!("{found:?}")
        };
        assert!((distance - 1.0).abs() < 0.03, "{distance}");
    }
}

#[test]
fn a_workspace_at_the_side_of_the_image_is_mostly_unseen() {
    for found in after(|view, _| {
        // Only the right half of the image has depth.
        let width = Intrinsics::BENCHMARK.width;
        view.depth.chunks_exact_mut(width).for_each(|row| row[..width * 3 / 5].fill(0.0));
    }) {
        assert!(found.iter().any(|w| matches!(w, Warning::MostlyUnseen { .. })), "{found:?}");
    }
}
