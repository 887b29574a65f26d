//! Arbitrary bytes as a model file: its metadata are read, and its graph is rewritten as when it is loaded, without ONNX
//! Runtime.

#![no_main]

use std::path::Path;
use std::sync::LazyLock;

use grasp_models::onnx::ModelProto;
use grasp_models::{Architecture, Metadata, averaged_over_rotations, upsampled_convolutions, with_half_weights};
use libfuzzer_sys::fuzz_target;
use prost::Message;

/// Random bytes almost never decode to a network, so the fuzzer overwrites parts of one.
static VGN: LazyLock<Vec<u8>> = LazyLock::new(|| Architecture::Vgn.build(8, 0).expect("it is defined").encode_to_vec());

fuzz_target!(|bytes: &[u8]| {
    let Some((&[first, second], rest)) = bytes.split_first_chunk() else { return };
    let mut file = VGN.clone();
    // The nodes and shapes are in the first and last bytes, the weights between them.
    let at = usize::from(u16::from_be_bytes([first, second]));
    let at = if at % 2 == 0 { at } else { file.len().saturating_sub(at) };
    file.iter_mut().skip(at).zip(rest).for_each(|(old, new)| *old = *new);
    for file in [rest, &file] {
        let Ok(model) = ModelProto::decode(file) else { continue };
        let _ = Metadata::from_model(&model, Path::new("model.onnx"));
        let _ = averaged_over_rotations(&model);
        let _ = with_half_weights(&model);
        if let Some(graph) = &model.graph {
            let _ = upsampled_convolutions(graph);
        }
    }
});
