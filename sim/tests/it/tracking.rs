//! A tracked volume of a scene in which an object moves: it must show what a fresh volume shows, and what stands still as
//! well as a volume that forgets nothing.

use std::f64::consts::{FRAC_PI_4, TAU};

use grasp::{DepthImage, Fusion, Intrinsics, RESOLUTION, WORKSPACE_SIZE};
use grasp_picture::{Instance, render};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, View, Views, add_stereo_noise, look_at};
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::physics::World;
use grasp_sim::scene::SceneKind;
use nalgebra::{Isometry3, Point3, Translation3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const FRAMES: usize = 30;

/// The half-life in views that the documents recommend for scenes that move.
const HALF_LIFE: f64 = 10.0;

fn scenes() -> impl Iterator<Item = World> {
    let objects = ObjectSet::procedural(Split::PackedTest);
    let views = Views::Side { azimuth: 0.0 };
    let bench =
        Benchmark { kind: SceneKind::Packed, objects, count: 4, views, noise: DepthNoise::NONE, rounds: 4, seed: 17 };
    (0..bench.rounds).map(move |number| bench.scene(number).0)
}

/// The scene without noise in a frame. The first object is moved by `step` metres per frame.
fn frame(world: &World, number: usize, step: f64) -> View {
    let camera = look_at(&Point3::new(0.15, 0.15, 0.08), 0.6, FRAC_PI_4, -TAU / 4.0 + 0.01 * number as f64);
    let instances: Vec<Instance> = world
        .objects()
        .iter()
        .zip(0..)
        .map(|(body, id)| {
            let moved = if id == 0 { step * number as f64 } else { 0.0 };
            let pose = Translation3::new(moved, 0.0, 0.0) * world.pose(body.id);
            Instance { mesh: &body.object.visual, pose, scale: body.scale, id }
        })
        .collect();
    let depth = render(&instances, Some(TABLE_HEIGHT), &Intrinsics::BENCHMARK, &camera, 0.1, 2.0).depth;
    View { depth, camera_from_task: camera }
}

fn integrate(fusion: &mut Fusion, view: &View) {
    fusion.integrate(&DepthImage::new(Intrinsics::BENCHMARK, &view.depth).unwrap(), &view.camera_from_task);
}

fn empty() -> Fusion {
    Fusion::new(RESOLUTION, WORKSPACE_SIZE)
}

/// Share of wrong voxels among those on the surface of the truth or of the field: surfaces where there is free space, and
/// free space where there is a surface.
fn error(fusion: &Fusion, truth: &Fusion) -> f64 {
    let is_surface = |value: f32| value > 0.0 && value <= 0.5;
    let (mut wrong, mut all) = (0, 0);
    let volume = truth.volume(Isometry3::identity()).unwrap();
    let hidden = volume.hidden().unwrap();
    for ((&value, &expected), _) in
        fusion.values().iter().zip(volume.values()).zip(hidden).filter(|(_, hidden)| !**hidden)
    {
        let (actual, expected) = (is_surface(value), is_surface(expected));
        all += usize::from(actual || expected);
        wrong += usize::from(actual != expected);
    }
    wrong as f64 / all as f64
}

/// Mean errors of a field that forgets, of one that does not, and of a fresh one in every frame.
fn errors(step: f64) -> [f64; 3] {
    let mut sums = [0.0; 3];
    let mut count = 0.0;
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for world in scenes() {
        let (mut forgetting, mut plain) = (empty().forgetting(HALF_LIFE), empty());
        for number in 0..FRAMES {
            let clean = frame(&world, number, step);
            let mut noisy = clean.clone();
            add_stereo_noise(&mut noisy, &mut rng);
            let mut truth = empty();
            integrate(&mut truth, &clean);
            let mut fresh = empty();
            integrate(&mut fresh, &noisy);
            integrate(&mut forgetting, &noisy);
            integrate(&mut plain, &noisy);
            if number >= FRAMES / 2 {
                count += 1.0;
                for (sum, fusion) in sums.iter_mut().zip([&forgetting, &plain, &fresh]) {
                    *sum += error(fusion, &truth);
                }
            }
        }
    }
    sums.map(|sum| sum / count)
}

#[test]
fn an_object_that_moves_leaves_no_trace() {
    let [forgetting, plain, fresh] = errors(0.004);
    println!("moving: forgetting {forgetting:.3}, plain {plain:.3}, fresh {fresh:.3}");
    assert!(forgetting <= fresh * 1.1 && forgetting < plain);
}

#[test]
fn what_stands_still_keeps_its_accuracy() {
    let [forgetting, plain, fresh] = errors(0.0);
    println!("still: forgetting {forgetting:.3}, plain {plain:.3}, fresh {fresh:.3}");
    assert!(forgetting <= plain * 1.1 && forgetting < fresh);
}
