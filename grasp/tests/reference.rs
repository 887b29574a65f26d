//! Compares fusion with Open3D and decoding with SciPy, on stored values from `fixtures/generate.py`.

use std::fs::File;
use std::io::BufReader;

use grasp::{Border, DecodeParams, DepthImage, Fusion, Intrinsics, Maps, Volume, decode};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use npyz::Deserialize;
use npyz::npz::NpzArchive;

fn load<T: Deserialize>(archive: &mut NpzArchive<BufReader<File>>, name: &str) -> Vec<T> {
    let array = archive.by_name(name).unwrap().unwrap_or_else(|| panic!("no array {name}"));
    array.into_vec().unwrap()
}

fn open(name: &str) -> NpzArchive<BufReader<File>> {
    NpzArchive::open(format!("{}/tests/fixtures/{name}", env!("CARGO_MANIFEST_DIR"))).unwrap()
}

fn fused() -> (Fusion, NpzArchive<BufReader<File>>) {
    let mut archive = open("fusion.npz");
    let depth: Vec<f32> = load(&mut archive, "depth");
    let extrinsics: Vec<f64> = load(&mut archive, "extrinsics");
    let camera = Intrinsics { width: 64, height: 48, fx: 54.0, fy: 54.0, cx: 32.0, cy: 24.0 };
    let mut fusion = Fusion::new(20, 0.3);
    for (depth, m) in depth.chunks(64 * 48).zip(extrinsics.chunks(16)) {
        let rotation = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        let pose = Isometry3::from_parts(Translation3::new(m[3], m[7], m[11]), rotation);
        fusion.integrate(&DepthImage::new(camera, depth).unwrap(), &pose);
    }
    (fusion, archive)
}

#[test]
fn fusion_agrees_with_open3d() {
    let (fusion, mut archive) = fused();
    let expected: Vec<f32> = load(&mut archive, "values");
    let differences: Vec<f32> = fusion.values().iter().zip(&expected).map(|(a, b)| (a - b).abs()).collect();
    // A voxel that projects onto the edge between two pixels may be assigned to either: Open3D accumulates steps.
    let on_an_edge = differences.iter().filter(|&&d| d > 1e-4).count();
    println!("{on_an_edge} of {} voxels differ by more than 1e-4", differences.len());
    assert!(on_an_edge <= differences.len() / 1000, "{on_an_edge} voxels differ");
}

#[test]
fn the_surface_agrees_with_open3d() {
    let (fusion, mut archive) = fused();
    let points: Vec<f64> = load(&mut archive, "points");
    let normals: Vec<f64> = load(&mut archive, "normals");
    let surface = fusion.surface();
    let count = points.len() / 3;
    assert!(surface.len().abs_diff(count) <= count / 100, "{} points instead of {count}", surface.len());
    let mut far = 0;
    for (p, n) in points.chunks(3).zip(normals.chunks(3)) {
        let (p, n) = (Point3::new(p[0], p[1], p[2]), Vector3::new(n[0], n[1], n[2]));
        let distance = |q: &grasp::SurfacePoint| (q.position - p).norm();
        let nearest = surface.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        far += usize::from(distance(nearest) > 1e-5 || nearest.normal.angle(&n) > 1e-2);
    }
    println!("{far} of {count} points have no counterpart within 10 µm and 0.6°");
    assert!(far <= count / 50, "{far} of {count} points have no counterpart");
}

#[test]
fn decoding_agrees_with_scipy() {
    let mut archive = open("decode.npz");
    const N: usize = 24;
    const VOXEL: f64 = 0.0075;
    let tsdf = load(&mut archive, "tsdf");
    let [quality, rotation, width] = ["quality", "rotation", "width"].map(|name| load::<f32>(&mut archive, name));
    let volume = Volume::new(N, VOXEL, Isometry3::identity(), tsdf).unwrap();
    let maps = Maps { quality: &quality, rotation: &rotation, width: &width };
    let cases = [
        ("vgn", DecodeParams::default()),
        (
            "benchmark",
            DecodeParams {
                outside_above: 0.1,
                border: Some(Border { sides: 2, bottom: 7 }),
                ..DecodeParams::default()
            },
        ),
        ("forced", DecodeParams { threshold: 0.999, force: Some(0.5), ..DecodeParams::default() }),
    ];
    for (name, params) in cases {
        let cells: Vec<i64> = load(&mut archive, &format!("{name}_cells"));
        let scores: Vec<f32> = load(&mut archive, &format!("{name}_scores"));
        let grasps = decode(&volume, &maps, &params).unwrap().grasps;
        assert_eq!(grasps.len(), scores.len(), "{name}");
        for ((grasp, cell), score) in grasps.iter().zip(cells.chunks(3)).zip(scores) {
            let index = (cell[0] as usize * N + cell[1] as usize) * N + cell[2] as usize;
            let expected = Vector3::new(cell[0], cell[1], cell[2]).cast::<f64>() * VOXEL;
            assert!((grasp.pose.translation.vector - expected).norm() < 1e-9, "{name}: {cell:?}");
            assert!((grasp.quality - score).abs() < 1e-6, "{name}: {} instead of {score}", grasp.quality);
            assert!((grasp.width - f64::from(width[index]) * VOXEL).abs() < 1e-6, "{name}");
            let q = grasp.pose.rotation.coords;
            for channel in 0..4 {
                let expected = f64::from(rotation[channel * N.pow(3) + index]);
                assert!((q[channel] - expected).abs() < 1e-6, "{name}");
            }
        }
    }
}
