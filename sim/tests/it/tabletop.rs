//! The table in depth images of simulated scenes, from cameras in random poses.

use grasp::{DepthImage, Intrinsics, WORKSPACE_SIZE};
use grasp_perception::{NoTabletop, Tabletop, overview};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, View, Views, add_stereo_noise, look};
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::physics::World;
use grasp_sim::scene::SceneKind;
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Scenes, each with a view from a random camera.
fn scenes(views: &Views) -> Vec<(World, View, ChaCha8Rng)> {
    let kinds = [(SceneKind::Packed, Split::PackedTest), (SceneKind::Pile, Split::PileTest)];
    let of_kind = |(kind, split)| {
        let objects = ObjectSet::procedural(split);
        let bench =
            Benchmark { kind, objects, count: 5, views: views.clone(), noise: DepthNoise::NONE, rounds: 12, seed: 11 };
        (0..bench.rounds).map(move |number| {
            let (world, mut rng) = bench.scene(number);
            let camera = bench.views.sample(&mut rng);
            let view = look(&world, &camera).remove(0);
            (world, view, rng)
        })
    };
    kinds.into_iter().flat_map(of_kind).collect()
}

fn found(view: &View, gravity: Option<Unit<Vector3<f64>>>) -> Result<Tabletop, NoTabletop> {
    Tabletop::find(&DepthImage::new(Intrinsics::BENCHMARK, &view.depth).unwrap(), gravity, TABLE_HEIGHT)
}

/// Height error of the table, metres, and tilt, radians, of a found workspace.
fn errors(table: &Tabletop, view: &View) -> (f64, f64) {
    let true_from_found = view.camera_from_task.inverse() * table.camera_from_task;
    let middle = true_from_found * Point3::new(WORKSPACE_SIZE / 2.0, WORKSPACE_SIZE / 2.0, TABLE_HEIGHT);
    ((middle.z - TABLE_HEIGHT).abs(), (true_from_found.rotation * Vector3::z()).angle(&Vector3::z()))
}

#[test]
fn the_table_is_found_from_any_camera_and_the_workspace_holds_the_objects() {
    let scenes = scenes(&Views::Random(1..=1));
    let (count, mut all_inside) = (2 * scenes.len(), 0);
    for (number, (world, mut view, mut rng)) in scenes.into_iter().enumerate() {
        let down = Unit::new_normalize(view.camera_from_task * -Vector3::z());
        let clean = found(&view, None).unwrap();
        let (height, tilt) = errors(&clean, &view);
        assert!(height < 0.002 && tilt.to_degrees() < 0.3, "scene {number}: {height} m, {tilt}, {clean:?}");
        add_stereo_noise(&mut view, &mut rng);
        for gravity in [None, Some(down)] {
            let table = found(&view, gravity).unwrap();
            let (height, tilt) = errors(&table, &view);
            assert!(height < 0.005 && tilt.to_degrees() < 1.0, "scene {number}: {height} m, {tilt}, {table:?}");
            let true_from_found = view.camera_from_task.inverse() * table.camera_from_task;
            let inside = |at: Point3<f64>| {
                let at = true_from_found.inverse() * at;
                at.coords.xy().iter().all(|c| (0.0..WORKSPACE_SIZE).contains(c))
            };
            let objects = world.objects().iter().map(|body| world.pose(body.id).translation.vector.into());
            let outside = objects.filter(|at| !inside(*at)).count();
            assert!(outside <= 1, "scene {number}: {outside} objects are outside");
            all_inside += usize::from(outside == 0);
            assert_eq!(table.tilt.is_some(), gravity.is_some());
        }
    }
    assert!(all_inside * 10 >= count * 9, "all objects are inside in {all_inside} of {count}");
}

#[test]
fn gravity_tells_a_wall_from_the_table() {
    // Seen from the side, the wall of the next room is larger than the table.
    for (_, mut view, _) in scenes(&Views::Side { azimuth: 0.0 }).into_iter().take(4) {
        let down = Unit::new_normalize(view.camera_from_task * -Vector3::z());
        add_surface(&mut view, |eye, ray| Some((0.26 - eye.y) / ray.y));
        let table = found(&view, Some(down)).unwrap();
        let (height, tilt) = errors(&table, &view);
        assert!(height < 0.005 && tilt.to_degrees() < 1.0, "{height} {tilt} {table:?}");
    }
}

/// Adds a surface to a view: where the ray of a pixel, from `eye` along `ray` in the task frame, meets it, as a multiple
/// of `ray`, which is the depth.
fn add_surface(view: &mut View, distance: impl Fn(&Point3<f64>, &Vector3<f64>) -> Option<f64>) {
    let task_from_camera = view.camera_from_task.inverse();
    let eye = task_from_camera * Point3::origin();
    let camera = Intrinsics::BENCHMARK;
    for (index, depth) in view.depth.iter_mut().enumerate() {
        let (u, v) = ((index % camera.width) as f64, (index / camera.width) as f64);
        let ray = task_from_camera * Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
        if let Some(distance) = distance(&eye, &ray).filter(|distance| *distance > 0.0)
            && (*depth == 0.0 || distance < f64::from(*depth))
        {
            *depth = distance as f32;
        }
    }
}

#[test]
fn the_table_is_found_in_point_clouds() {
    for (number, (_, mut view, mut rng)) in scenes(&Views::Random(1..=1)).into_iter().enumerate() {
        add_stereo_noise(&mut view, &mut rng);
        let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).unwrap();
        let Intrinsics { width, height, .. } = Intrinsics::BENCHMARK;
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        let of_camera: Vec<Point3<f64>> = pixels.filter_map(|(u, v)| image.point(u, v)).collect();
        let task_from_camera = view.camera_from_task.inverse();
        // In the frame of the camera, and in that of the task.
        for task_from_cloud in [task_from_camera, Isometry3::identity()] {
            let cloud_from_camera = task_from_cloud.inverse() * task_from_camera;
            let points: Vec<_> = of_camera.iter().map(|point| cloud_from_camera * point).collect();
            let seen = overview(&points, &(cloud_from_camera * Point3::origin())).unwrap();
            let found = Tabletop::find(&seen.image, None, TABLE_HEIGHT).unwrap();
            assert!(found.share <= 1.0, "{}", found.share);
            let true_from_found = task_from_cloud * seen.camera_from_task.inverse() * found.camera_from_task;
            let middle = true_from_found * Point3::new(WORKSPACE_SIZE / 2.0, WORKSPACE_SIZE / 2.0, TABLE_HEIGHT);
            let height = (middle.z - TABLE_HEIGHT).abs();
            let tilt = (true_from_found.rotation * Vector3::z()).angle(&Vector3::z()).to_degrees();
            assert!(height < 0.005 && tilt < 1.0, "scene {number}: {height} m, {tilt}°, {found:?}");
        }
    }
}

#[test]
fn in_a_bin_its_floor_is_the_table() {
    /// Edge of the bin around the middle of the workspace, height of its walls, and depth of the floor around it.
    const BIN: [f64; 3] = [0.4, 0.12, 0.25];
    let [edge, walls, below] = BIN;
    let (low, high) = (WORKSPACE_SIZE / 2.0 - edge / 2.0, WORKSPACE_SIZE / 2.0 + edge / 2.0);
    let is_inside = |at: f64| (low..=high).contains(&at);
    let mut looked_into = 0;
    for (number, (_, mut view, mut rng)) in scenes(&Views::Random(1..=1)).into_iter().enumerate() {
        let task_from_camera = view.camera_from_task.inverse();
        // From the side the walls hide the floor of the bin, and the floor around it is larger.
        if (task_from_camera * Vector3::z()).angle(&-Vector3::z()).to_degrees() > 40.0 {
            continue;
        }
        looked_into += 1;
        // The simulated table is larger than the bin.
        let table: Vec<bool> = {
            let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).unwrap();
            let width = Intrinsics::BENCHMARK.width;
            let outside = |at: Point3<f64>| !is_inside(at.x) || !is_inside(at.y);
            let at = |index: usize| image.point(index % width, index / width).map(|point| task_from_camera * point);
            (0..view.depth.len()).map(|index| at(index).is_some_and(outside)).collect()
        };
        view.depth.iter_mut().zip(table).filter(|(_, outside)| *outside).for_each(|(depth, _)| *depth = 0.0);
        for (axis, side) in [(0, low), (0, high), (1, low), (1, high)] {
            add_surface(&mut view, |eye, ray| {
                let distance = (side - eye[axis]) / ray[axis];
                let at = eye + ray * distance;
                ((TABLE_HEIGHT..TABLE_HEIGHT + walls).contains(&at.z) && is_inside(at[1 - axis])).then_some(distance)
            });
        }
        add_surface(&mut view, |eye, ray| {
            let distance = (TABLE_HEIGHT - below - eye.z) / ray.z;
            let at = eye + ray * distance;
            (!is_inside(at.x) || !is_inside(at.y)).then_some(distance).filter(|distance| *distance < 2.0)
        });
        add_stereo_noise(&mut view, &mut rng);
        let down = Unit::new_normalize(view.camera_from_task * -Vector3::z());
        let table = found(&view, Some(down)).unwrap();
        let (height, tilt) = errors(&table, &view);
        assert!(height < 0.005 && tilt.to_degrees() < 1.0, "scene {number}: {height} m, {tilt}, {table:?}");
    }
    assert!(looked_into >= 5, "{looked_into} cameras look into the bin");
}

#[test]
fn of_two_tables_the_one_in_the_middle_is_found() {
    for (number, (_, mut view, mut rng)) in scenes(&Views::Random(1..=1)).into_iter().enumerate() {
        // Another table beside the workspace, 15 cm higher. A camera over it would see little else.
        if (view.camera_from_task.inverse() * Point3::origin()).x > WORKSPACE_SIZE {
            continue;
        }
        add_surface(&mut view, |eye, ray| {
            let distance = (TABLE_HEIGHT + 0.15 - eye.z) / ray.z;
            ((eye + ray * distance).x > WORKSPACE_SIZE + 0.1).then_some(distance).filter(|distance| *distance < 2.0)
        });
        add_stereo_noise(&mut view, &mut rng);
        let table = found(&view, None).unwrap();
        let (height, tilt) = errors(&table, &view);
        assert!(height < 0.005 && tilt.to_degrees() < 1.0, "scene {number}: {height} m, {tilt}, {table:?}");
    }
}

#[test]
fn an_image_without_a_table_is_refused() {
    let bumps: Vec<f32> = {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let coarse: Vec<f32> = (0..16 * 12).map(|_| rng.random_range(0.3..1.5)).collect();
        (0..640 * 480).map(|index| coarse[index / 640 / 40 * 16 + index % 640 / 40]).collect()
    };
    let view = |depth| View { depth, camera_from_task: Isometry3::identity() };
    let refused = found(&view(bumps), None).unwrap_err();
    assert!(matches!(refused, NoTabletop::NoPlane { share, with_gravity: false } if share < 0.12), "{refused:?}");
    let mut dark = vec![0.0; 640 * 480];
    dark[..1000].fill(0.5);
    let refused = found(&view(dark), None).unwrap_err();
    assert!(matches!(refused, NoTabletop::FewReadings { share } if share < 0.05), "{refused:?}");
    // A table, but gravity along it.
    let flat = vec![0.6; 640 * 480];
    let refused = found(&view(flat.clone()), Some(Vector3::x_axis())).unwrap_err();
    assert!(refused.to_string().contains("largest level plane near the middle of the image covers 0 %"), "{refused}");
    let table = found(&view(flat), None).unwrap();
    assert!((table.distance - 0.6).abs() < 1e-6 && table.angle < 1e-6, "{table:?}");
}
