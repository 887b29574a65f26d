//! The grasp evaluator: predicts from a [`Patch`] whether a grasp succeeds. As in 6-DOF GraspNet (Mousavian et al., ICCV
//! 2019), it scores the grasps that another network proposes.

use grasp::Patch;

use crate::gpd::{INPUT, OUTPUT, describe};
use crate::graph::{Builder, Conv};
use crate::onnx::{AttributeProto, ModelProto};

/// Output channels of the convolutions.
const CHANNELS: [usize; 2] = [64, 96];

/// Units of the dense layer.
const DENSE: usize = 192;

/// Failure, success after a contact on the approach, success without a contact.
const CLASSES: usize = 3;

/// Creates an evaluator with random weights: two 2D convolutions over the plane of the approach and the closing axis,
/// each followed by max pooling by 2; a dense layer; the logits of the classes. The slices are channels, because the
/// hand is narrow along x.
#[must_use]
pub fn evaluator(seed: u64) -> ModelProto {
    let mut builder = Builder::new("evaluator", seed);
    let b = &mut builder;
    let mut x = b.input(INPUT, &Patch::SHAPE);
    let [mut inputs, rows, columns] = Patch::SHAPE;
    for (layer, outputs) in CHANNELS.into_iter().enumerate() {
        let conv = Conv { inputs, outputs, kernel: 3, stride: 1, bias: true };
        x = b.conv_2d(&format!("conv.{layer}"), &x, conv, 1);
        x = b.node("Relu", &[&x], vec![]);
        x = b.max_pool_2d(&x);
        inputs = outputs;
    }
    let pixels = (rows >> CHANNELS.len()) * (columns >> CHANNELS.len());
    x = b.node("Flatten", &[&x], vec![AttributeProto::int("axis", 1)]);
    x = b.linear("dense.0", &x, inputs * pixels, DENSE, true);
    x = b.node("Relu", &[&x], vec![]);
    x = b.linear("dense.1", &x, DENSE, CLASSES, true);
    b.output(OUTPUT, &x, &[CLASSES]);
    let mut model = builder.finish();
    let provenance = [("architecture", "evaluator".to_owned()), ("seed", seed.to_string())];
    describe(&mut model, "evaluator", "1", None, &provenance.map(|(key, value)| (key.to_owned(), value)).into());
    model
}
