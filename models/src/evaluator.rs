//! The grasp evaluators: they predict from a [`Patch`] whether a grasp succeeds. As in 6-DOF GraspNet (Mousavian et al.,
//! ICCV 2019), they score the grasps that another network proposes. A coarse evaluator chooses which of many poses are
//! worth an evaluation.

use grasp::Patch;

use crate::gpd::{INPUT, OUTPUT, describe};
use crate::graph::{Builder, Conv};
use crate::onnx::{AttributeProto, ModelProto};

/// A convolutional classifier of patches.
struct Shape {
    name: &'static str,
    /// Slices, rows and columns of the input. The slices are channels, because the hand is narrow along x.
    input: [usize; 3],
    /// Output channels and stride of the convolutions over the plane of the approach and the closing axis.
    convolutions: [(usize, usize); 2],
    /// Whether max pooling by 2 follows each convolution.
    pooled: [bool; 2],
    /// Units of the dense layer.
    dense: usize,
    classes: usize,
}

/// Creates an evaluator with random weights. The classes are failure, success after a contact on the approach, success
/// without a contact.
#[must_use]
pub fn evaluator(seed: u64) -> ModelProto {
    let convolutions = [(64, 1), (96, 1)];
    let input = Patch::SHAPE;
    Shape { name: "evaluator", input, convolutions, pooled: [true; 2], dense: 192, classes: 3 }.build(seed)
}

/// Creates a coarse evaluator with random weights, which needs an eighth of the multiplications of an [`evaluator`]. The classes
/// are failure and success.
#[must_use]
pub fn coarse_evaluator(seed: u64) -> ModelProto {
    let convolutions = [(32, 2), (64, 1)];
    let input = Patch::COARSE_SHAPE;
    Shape { name: "coarse-evaluator", input, convolutions, pooled: [false, true], dense: 96, classes: 2 }.build(seed)
}

impl Shape {
    /// The logits of the classes: two convolutions and two dense layers.
    fn build(self, seed: u64) -> ModelProto {
        let mut builder = Builder::new(self.name, seed);
        let b = &mut builder;
        let mut x = b.input(INPUT, &self.input);
        let [mut inputs, rows, columns] = self.input;
        let mut pixels = rows * columns;
        for (layer, ((outputs, stride), pooled)) in self.convolutions.into_iter().zip(self.pooled).enumerate() {
            let conv = Conv { inputs, outputs, kernel: 3, stride, bias: true };
            x = b.conv_2d(&format!("conv.{layer}"), &x, conv, 1);
            x = b.node("Relu", &[&x], vec![]);
            pixels /= stride * stride;
            if pooled {
                x = b.max_pool_2d(&x);
                pixels /= 4;
            }
            inputs = outputs;
        }
        x = b.node("Flatten", &[&x], vec![AttributeProto::int("axis", 1)]);
        x = b.linear("dense.0", &x, inputs * pixels, self.dense, true);
        x = b.node("Relu", &[&x], vec![]);
        x = b.linear("dense.1", &x, self.dense, self.classes, true);
        b.output(OUTPUT, &x, &[self.classes]);
        let mut model = builder.finish();
        let provenance = [("architecture", self.name.to_owned()), ("seed", seed.to_string())];
        describe(&mut model, self.name, "1", None, &provenance.map(|(key, value)| (key.to_owned(), value)).into());
        model
    }
}
