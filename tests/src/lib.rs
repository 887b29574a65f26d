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

use grasp_proto::pb;

/// No collision check, which with views is not the default. The hand of the test models points into the table.
#[must_use]
pub fn no_collision_check() -> Option<pb::CollisionCheck> {
    Some(pb::CollisionCheck { mode: Some(pb::collision_check::Mode::Off.into()), ..Default::default() })
}
