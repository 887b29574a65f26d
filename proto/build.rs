//! Compiles the .proto files without needing protoc.

use std::env;
use std::error::Error;
use std::fs;
use std::path::PathBuf;

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let descriptors = protox::compile(["grasp/v1/grasp.proto", "inference/inference.proto"], ["proto"])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    // `Bytes` shares the buffer of the received message instead of copying the volume.
    let mut config = tonic_prost_build::configure();
    for field in [
        ".grasp.v1.Volume.data",
        ".grasp.v1.DepthView.data",
        ".grasp.v1.CloudView.points",
        ".grasp.v1.Labels.data",
        ".inference.ModelInferRequest.raw_input_contents",
        ".inference.ModelInferResponse.raw_output_contents",
    ] {
        config = config.bytes(field);
    }
    config.compile_fds(descriptors)?;
    Ok(())
}
