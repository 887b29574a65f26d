//! Measures fusion and decoding on one core: `cargo run --release -p grasp --example fuse_and_decode`.

use std::hint::black_box;
use std::time::Instant;

use grasp::{DecodeParams, DepthImage, Fusion, Intrinsics, Maps, RESOLUTION, WORKSPACE_SIZE, decode};
use nalgebra::Isometry3;

const RUNS: usize = 500;

fn main() {
    // A bumpy wall across the workspace, 0.6 m away. Every voxel is in view.
    let camera = Intrinsics::BENCHMARK;
    let wave =
        |pixel: usize| ((pixel % camera.width) as f32 / 40.0).sin() + ((pixel / camera.width) as f32 / 30.0).cos();
    let depth: Vec<f32> = (0..camera.width * camera.height).map(|pixel| 0.65 + 0.03 * wave(pixel)).collect();
    let image = DepthImage::new(camera, &depth).expect("the image has the size of the camera");
    let camera_from_task = Isometry3::translation(-0.15, -0.15, 0.5);

    let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
    report("fuse one 640×480 view into 40³", || {
        fusion.integrate(black_box(&image), &camera_from_task);
    });
    report("read out the 40³ values", || drop(black_box(fusion.values())));

    let volume = fusion.volume(Isometry3::identity()).expect("the wall is in the workspace");
    let voxels = RESOLUTION.pow(3);
    // Peaks of quality all over the volume. Those near the wall give a few dozen grasps.
    let hill = |c: usize| (c as f32 * std::f32::consts::TAU / 8.0).cos();
    let height =
        |i: usize| hill(i / (RESOLUTION * RESOLUTION)) * hill(i / RESOLUTION % RESOLUTION) * hill(i % RESOLUTION);
    let quality: Vec<f32> = (0..voxels).map(|i| 0.7 + 0.3 * height(i)).collect();
    let (rotation, width) = (vec![0.5; 4 * voxels], vec![5.0; voxels]);
    let maps = Maps { quality: &quality, rotation: &rotation, width: &width };
    let params = DecodeParams { threshold: 0.8, ..DecodeParams::default() };
    let found = decode(&volume, &maps, &params).expect("the maps fit the volume");
    println!("{} grasps, dropped: {:?}", found.grasps.len(), found.dropped);
    report("decode 40³ maps into grasps", || drop(black_box(decode(&volume, black_box(&maps), &params))));
}

fn report(what: &str, mut work: impl FnMut()) {
    let mut times: Vec<f64> = (0..RUNS)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!("{what:32} p50 {:.3} ms, p99 {:.3} ms, n = {RUNS}, one core", times[RUNS / 2], times[RUNS * 99 / 100]);
}
