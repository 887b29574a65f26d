//! Shared parts of the end-to-end tests: the programs under test, models with known outputs, volumes, a running server.
//!
//! The tests are in `tests/`, one file for each behaviour. They need ONNX Runtime: run them with `make test`.

mod binaries;
mod models;
mod raw;
pub mod scene;
mod server;
mod stolen;
mod volumes;

pub use binaries::{example, grasp, grasp_sim, graspd};
pub use models::{RESOLUTION, TestModel, WIDTH};
pub use raw::Raw;
pub use server::{Server, metric, peak_bytes, resident_bytes};
pub use stolen::Stolen;
pub use volumes::{blobs, expected};
