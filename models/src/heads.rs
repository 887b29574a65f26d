//! What every network here ends in (the paper, section "Grasping Heads"; the layers are VGN's).

use crate::graph::{Builder, Conv};
use crate::onnx::AttributeProto;

/// Declares the network's input and returns it: the volume, `[batch, 1, N, N, N]`.
pub(crate) fn volume(b: &mut Builder, resolution: usize) -> String {
    b.input("tsdf", &[1, resolution, resolution, resolution])
}

/// Declares the three outputs over `features`, `[batch, channels, N, N, N]`:
/// quality (sigmoid), rotation (a unit quaternion x y z w) and width (linear, in voxels).
///
/// The three 5³ convolutions read the same features, so they are one convolution with six channels: the mathematics
/// is the same and it takes half the time of the whole of VGN.
pub(crate) fn heads(b: &mut Builder, features: &str, channels: usize, resolution: usize) {
    let all = b.conv("heads", features, Conv { inputs: channels, outputs: 6, kernel: 5, stride: 1, bias: true });
    let sizes = b.whole(&[1, 4, 1]);
    let [quality, rotation, width] = b.nodes("Split", &[&all, &sizes], vec![AttributeProto::int("axis", 1)]);
    let quality = b.node("Sigmoid", &[&quality], vec![]);
    let rotation = normalize(b, &rotation);
    for (name, value, channels) in [("quality", quality, 1), ("rotation", rotation, 4), ("width", width, 1)] {
        b.output(name, &value, &[channels, resolution, resolution, resolution]);
    }
}

/// Scales to length 1 over the channels; no length below 1e-12 is divided by (PyTorch's `normalize`).
fn normalize(b: &mut Builder, x: &str) -> String {
    let axes = AttributeProto::ints("axes", &[1]);
    let length = b.node("ReduceL2", &[x], vec![axes, AttributeProto::int("keepdims", 1)]);
    let smallest = b.number(1e-12);
    let length = b.node("Clip", &[&length, &smallest], vec![]);
    b.node("Div", &[x, &length], vec![])
}
