//! The large model, which is not in the zoo. `ORT_DYLIB_PATH` must name ONNX Runtime's library.

use std::path::Path;

use grasp::{Decoded, decode};
use grasp_models::{Network, Options, Precision};

use crate::scenes;

/// Corners of the block of the scene, metres, and how far from it the fingers may begin.
const BLOCK: [[f64; 3]; 2] = [[0.13, 0.11, 0.05], [0.17, 0.19, 0.15]];
const REACH: f64 = 0.05;

#[test]
fn the_large_transformer_grasps_a_block() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("large/transformer.onnx");
    let mut network = Network::load(&path, &Options::default()).unwrap();
    assert_eq!(network.metadata().name, "transformer");
    assert_eq!(network.backend().precision, Precision::Int8);
    let params = network.metadata().decode_params();
    let mut grasps = |name: &str| {
        let (_, volume) = scenes::all().into_iter().find(|(scene, _)| *scene == name).unwrap();
        let output = network.infer(&[&volume]).unwrap();
        let Decoded { grasps, .. } = decode(&volume, &output.maps(0), &params).unwrap();
        grasps
    };
    let on_block = grasps("a block");
    let best = on_block.first().expect("a grasp on the block");
    let position = best.pose.translation.vector;
    let is_near = |axis: usize| (BLOCK[0][axis] - REACH..BLOCK[1][axis] + REACH).contains(&position[axis]);
    assert!(best.quality > 0.9 && (0..3).all(is_near), "{best:?}");
    assert!((0.03..0.08).contains(&best.width), "the block is 0.04 m wide: {best:?}");
    assert_eq!(grasps("an empty table"), []);
}
