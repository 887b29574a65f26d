//! The classifier of grasp candidates: LeNet as in ten Pas et al., "Grasp Pose Detection in Point Clouds", IJRR 2017,
//! and its authors' code.

use std::collections::BTreeMap;

use grasp::gpd::{CHANNELS, IMAGE_SIZE};

use crate::graph::{Builder, Conv};
use crate::metadata::PROVENANCE;
use crate::metadata_error::PREFIX;
use crate::onnx::{AttributeProto, ModelProto, StringStringEntryProto};

/// Input of the classifier: f32 `[batch, CHANNELS, IMAGE_SIZE, IMAGE_SIZE]` in [0, 1].
pub const INPUT: &str = "images";

/// Output of the classifier: f32 `[batch, 2]`, the logits of failure and of success.
pub const OUTPUT: &str = "scores";

/// Units of the dense layer. GPD uses 500, which gives a file of 14 MB.
const DENSE: usize = 64;

/// Creates a classifier with random weights: two convolutions with 20 and 50 channels and kernels of 5, each followed
/// by max pooling by 2; a dense layer; two logits.
#[must_use]
pub fn gpd(seed: u64) -> ModelProto {
    let mut builder = Builder::new("gpd", seed);
    let b = &mut builder;
    let mut x = b.input(INPUT, &[CHANNELS, IMAGE_SIZE, IMAGE_SIZE]);
    let mut size = IMAGE_SIZE;
    for (layer, [inputs, outputs]) in [[CHANNELS, 20], [20, 50]].into_iter().enumerate() {
        x = b.conv_2d(&format!("conv.{layer}"), &x, Conv { inputs, outputs, kernel: 5, stride: 1, bias: true }, 0);
        x = b.max_pool_2d(&x);
        x = b.node("Relu", &[&x], vec![]);
        size = (size - 4) / 2;
    }
    x = b.node("Flatten", &[&x], vec![AttributeProto::int("axis", 1)]);
    x = b.linear("dense.0", &x, 50 * size * size, DENSE, true);
    x = b.node("Relu", &[&x], vec![]);
    x = b.linear("dense.1", &x, DENSE, 2, true);
    b.output(OUTPUT, &x, &[2]);
    let mut model = builder.finish();
    let provenance = [("architecture", "gpd".to_owned()), ("seed", seed.to_string())];
    describe(&mut model, "gpd", "1", None, &provenance.map(|(key, value)| (key.to_owned(), value)).into());
    model
}

/// Replaces the metadata of the file: `graspd.name`, `graspd.version`, for an evaluator `graspd.network`, and
/// `graspd.provenance.…`.
pub fn describe(
    model: &mut ModelProto,
    name: &str,
    version: &str,
    network: Option<&str>,
    provenance: &BTreeMap<String, String>,
) {
    model.metadata_props.retain(|property| !property.key().starts_with(PREFIX));
    let mut put = |key: &str, value: &str| {
        let key = Some(format!("{PREFIX}{key}"));
        model.metadata_props.push(StringStringEntryProto { key, value: Some(value.to_owned()) });
    };
    put("name", name);
    put("version", version);
    if let Some(network) = network {
        put("network", network);
    }
    for (key, value) in provenance {
        put(&format!("{PROVENANCE}{key}"), value);
    }
}
