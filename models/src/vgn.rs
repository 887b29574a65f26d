//! The Volumetric Grasping Network: Breyer et al., "Volumetric Grasping Network: Real-time 6 DOF Grasp Detection in
//! Clutter", CoRL 2020, with the layer sizes of its released code.

use crate::graph::{Builder, Conv};
use crate::onnx::{AttributeProto, ModelProto};
use crate::output_heads::{Orientation, output_heads, volume_input};

/// VGN for volumes of `resolution`³ voxels (a multiple of 8). With quaternions it has 313,238 parameters at every
/// resolution.
pub(crate) fn vgn(resolution: usize, orientation: Orientation, seed: u64) -> ModelProto {
    let mut builder = Builder::new("vgn", seed);
    let b = &mut builder;
    let mut x = volume_input(b, resolution);

    for (layer, [inputs, outputs, kernel]) in [[1, 16, 5], [16, 32, 3], [32, 64, 3]].into_iter().enumerate() {
        x = conv_relu(b, &format!("encoder.{layer}"), &x, Conv { inputs, outputs, kernel, stride: 2, bias: true });
    }
    for (layer, [inputs, outputs, kernel]) in [[64, 64, 3], [64, 32, 3], [32, 16, 5]].into_iter().enumerate() {
        x = conv_relu(b, &format!("decoder.{layer}"), &x, Conv { inputs, outputs, kernel, stride: 1, bias: true });
        x = double(b, &x);
    }
    output_heads(b, &x, 16, resolution, orientation);
    builder.finish()
}

fn conv_relu(b: &mut Builder, name: &str, x: &str, conv: Conv) -> String {
    let x = b.conv(name, x, conv);
    b.node("Relu", &[&x], vec![])
}

/// Nearest-neighbour upsampling by 2 along each axis.
fn double(b: &mut Builder, x: &str) -> String {
    let scales = b.numbers(&[1.0, 1.0, 2.0, 2.0, 2.0]);
    let attributes = vec![
        AttributeProto::string("mode", "nearest"),
        AttributeProto::string("coordinate_transformation_mode", "asymmetric"),
        AttributeProto::string("nearest_mode", "floor"),
    ];
    b.node("Resize", &[x, "", &scales], attributes)
}
