//! The domain types of graspd: volumes, depth fusion, grasps, and decoding of network outputs into grasps.
//!
//! Data flow with a network: [`DepthImage`] + [`Intrinsics`] → [`Fusion`] → [`Volume`] → network → [`Maps`] →
//! [`decode`] → [`Grasp`]s. Data flow of the classical planners: depth → [`gpd::Cloud`] → [`gpd::Candidate`]s →
//! [`Grasp`]s. This crate does no I/O and starts no threads.
//!
//! Conventions, unless stated otherwise: lengths in metres, angles in radians, unit quaternions as x, y, z, w; a pose
//! or transform `T_a_b` maps points of frame b into frame a; voxel arrays are indexed `[x][y][z]` with z varying
//! fastest.

#![warn(missing_docs)]

mod camera;
mod constraints;
mod convention;
mod decode;
mod details;
mod error;
mod filter;
mod fusion;
pub mod gpd;
mod grasp;
mod hand;
mod maps;
mod measurement;
mod object_map;
mod obstacles;
mod params;
mod patch;
mod selection;
mod surface;
mod volume;

pub use camera::{CameraError, DepthImage, Intrinsics, Unit};
pub use constraints::{Cone, Constraints, Region, Violation};
pub use convention::{ClosingAxis, Convention, Origin, Retreat, pregrasp};
pub use decode::{Border, DecodeParams, decode, quality_at};
pub use details::Details;
pub use error::{Code, RequestError, on_a_line};
pub use fusion::{DEPTH_MAX, Fusion, NoMeasurement, TRUNCATION_VOXELS};
pub use grasp::{FINGER_DEPTH, Grasp, MAX_OPENING};
pub use hand::{Hand, HandError};
pub use maps::{DecodeError, Maps, VoxelOrigin};
pub use object_map::ObjectMap;
pub use obstacles::{Clearance, Obstacles};
pub use params::{Candidate, Collision, DetectParams, Priority, TABLE_HEIGHT};
pub use patch::Patch;
pub use selection::{Decoded, Dropped, Selection};
pub use surface::{SurfaceMesh, SurfacePoint};
pub use volume::{Volume, VolumeError};

/// Edge of the workspace cube, metres (the paper, section "Problem formulation").
pub const WORKSPACE_SIZE: f64 = 0.3;

/// Voxels along one edge of the volume that the networks of the papers read.
pub const RESOLUTION: usize = 40;
