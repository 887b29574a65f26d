//! The depth camera against scenes with an analytic depth.

use std::sync::Arc;

use grasp::Intrinsics;
use grasp_picture::Mesh;
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::camera::{Views, add_noise, add_stereo_noise, look};
use grasp_sim::objects::Object;
use grasp_sim::physics::World;
use nalgebra::{Isometry3, Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn world(mesh: Mesh, pose: &Isometry3<f64>) -> World {
    let object = Object { name: "it".into(), parts: vec![mesh.clone()], visual: mesh, mass: 0.1, friction: 1.0 };
    let mut world = World::new();
    world.add(&Arc::new(object), 1.0, pose);
    world
}

/// Distances along a ray to its intersection with the table, a cuboid centred at `pose`, and a sphere.
fn table(eye: &Point3<f64>, ray: &Vector3<f64>) -> f64 {
    let distance = (TABLE_HEIGHT - eye.z) / ray.z;
    if distance > 0.0 { distance } else { f64::INFINITY }
}

fn cuboid(eye: &Point3<f64>, ray: &Vector3<f64>, pose: &Isometry3<f64>, size: &Vector3<f64>) -> f64 {
    let (eye, ray) = (pose.inverse_transform_point(eye), pose.inverse_transform_vector(ray));
    let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let at = |side: f64| (side * size[axis] / 2.0 - eye[axis]) / ray[axis];
        enter = enter.max(at(-1.0).min(at(1.0)));
        leave = leave.min(at(-1.0).max(at(1.0)));
    }
    if enter < leave { enter } else { f64::INFINITY }
}

fn sphere(eye: &Point3<f64>, ray: &Vector3<f64>, centre: &Point3<f64>, radius: f64) -> f64 {
    let to = centre - eye;
    let (along, norm) = (to.dot(ray), ray.norm_squared());
    let under_root = along * along - norm * (to.norm_squared() - radius * radius);
    if under_root < 0.0 { f64::INFINITY } else { (along - under_root.sqrt()) / norm }
}

/// Shares of the pixels that show the object, and of those with a depth error above `error` metres.
fn compare(world: &World, nearer: impl Fn(&Point3<f64>, &Vector3<f64>) -> f64, error: f64) -> (f64, f64) {
    let camera = Intrinsics::BENCHMARK;
    let (mut seen, mut wrong, mut all) = (0, 0, 0);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut cameras = Views::Circle.sample(&mut rng);
    cameras.extend(Views::Side { azimuth: 0.3 }.sample(&mut rng));
    for view in look(world, &cameras) {
        let eye = view.camera_from_task.inverse() * Point3::origin();
        for (index, &depth) in view.depth.iter().enumerate() {
            let (u, v) = ((index % camera.width) as f64, (index / camera.width) as f64);
            // The third component is 1, so that lengths along the ray are depths.
            let ray = Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
            let ray = view.camera_from_task.rotation.inverse() * ray;
            let (object, table) = (nearer(&eye, &ray), table(&eye, &ray));
            let expected = object.min(table);
            let expected = if expected < 2.0 { expected } else { 0.0 };
            seen += usize::from(object < table);
            wrong += usize::from((expected - f64::from(depth)).abs() > error);
            all += 1;
        }
    }
    (seen as f64 / f64::from(all), wrong as f64 / f64::from(all))
}

#[test]
fn a_cuboid_on_the_table_has_its_depth() {
    let size = Vector3::new(0.08, 0.05, 0.12);
    let pose = Isometry3::new(Vector3::new(0.14, 0.17, TABLE_HEIGHT + 0.1), Vector3::new(0.3, -0.2, 0.8));
    let (seen, wrong) = compare(&world(Mesh::cuboid(size), &pose), |eye, ray| cuboid(eye, ray, &pose, &size), 1e-5);
    assert!(seen > 0.02, "the object covers {seen} of the images");
    assert!(wrong < 1e-4, "{wrong} of the pixels have an error above 0.01 mm; only a few at the edges may");
}

#[test]
fn the_depth_of_a_sphere_is_right_except_for_its_facets() {
    let centre = Point3::new(0.16, 0.13, TABLE_HEIGHT + 0.05);
    let pose = Isometry3::translation(centre.x, centre.y, centre.z);
    let (seen, wrong) =
        compare(&world(Mesh::sphere(0.05, 256), &pose), |eye, ray| sphere(eye, ray, &centre, 0.05), 1e-4);
    assert!(seen > 0.02 && wrong < 1e-3, "seen {seen}, wrong {wrong}");
}

#[test]
fn noise_has_the_documented_magnitude() {
    let pose = Isometry3::translation(0.15, 0.15, TABLE_HEIGHT + 0.02);
    let world = world(Mesh::cuboid(Vector3::repeat(0.04)), &pose);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let clean = look(&world, &Views::Side { azimuth: 0.0 }.sample(&mut rng)).remove(0);
    let (mut factors, mut additive) = (Vec::new(), Vec::new());
    for _ in 0..60 {
        let mut noisy = clean.clone();
        add_noise(&mut noisy, &mut rng);
        let pairs = || clean.depth.iter().zip(&noisy.depth).filter(|(clean, _)| **clean > 0.0);
        assert!(clean.depth.iter().zip(&noisy.depth).all(|(clean, noisy)| (*clean == 0.0) == (*noisy == 0.0)));
        let factor: f64 = pairs().map(|(a, b)| f64::from(b / a)).sum::<f64>() / pairs().count() as f64;
        let squares: f64 = pairs().map(|(a, b)| (f64::from(*b) - factor * f64::from(*a)).powi(2)).sum();
        factors.push(factor);
        additive.push((squares / pairs().count() as f64).sqrt());
    }
    let mean = factors.iter().sum::<f64>() / 60.0;
    let std = (factors.iter().map(|factor| (factor - mean).powi(2)).sum::<f64>() / 59.0).sqrt();
    // Gamma(1000, 0.001): mean 1, standard deviation 0.0316.
    assert!((mean - 1.0).abs() < 0.015 && (0.024..0.04).contains(&std), "factor {mean} ± {std}");
    let noisy: Vec<f64> = additive.iter().copied().filter(|&size| size > 1e-4).collect();
    assert!((18..=42).contains(&noisy.len()), "{} of 60 images have additive noise, about half must", noisy.len());
    // 5 mm on the coarse grid. Bilinear interpolation reduces it by two thirds in each direction on average.
    assert!(noisy.iter().all(|size| (0.0028..0.0042).contains(size)), "{noisy:?}");
}

#[test]
fn stereo_noise_keeps_pixels_without_a_measurement() {
    let pose = Isometry3::translation(0.15, 0.15, TABLE_HEIGHT + 0.02);
    let world = world(Mesh::cuboid(Vector3::repeat(0.04)), &pose);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    // In its upper rows the table is further away than the camera measures.
    let clean = look(&world, &Views::Side { azimuth: 0.0 }.sample(&mut rng)).remove(0);
    let mut noisy = clean.clone();
    add_stereo_noise(&mut noisy, &mut rng);
    let unmeasured: Vec<_> = clean.depth.iter().zip(&noisy.depth).filter(|(clean, _)| **clean == 0.0).collect();
    assert!(unmeasured.len() > 1000 && unmeasured.iter().all(|(_, noisy)| **noisy == 0.0));
    // Nothing is nearer than 0.3 m, and no pixel flies towards those without a measurement.
    assert!(noisy.depth.iter().all(|&depth| depth == 0.0 || (0.3..2.1).contains(&depth)));
}
