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
mod cloud;
mod constraints;
mod convention;
mod decode;
mod depth_scale;
mod filter;
mod fusion;
pub mod gpd;
mod grasp;
mod hand;
mod maps;
mod object_map;
mod obstacles;
mod patch;
mod selection;
mod surface;
mod table;
mod tabletop;
mod tile;
mod volume;
mod warning;

pub use camera::{CameraError, DepthImage, Intrinsics, Unit};
pub use cloud::{View, overview, seen_from};
pub use constraints::{Cone, Constraints, Region, Violation};
pub use convention::{ClosingAxis, Convention, Origin, Retreat, before};
pub use decode::{Border, DecodeParams, decode, quality_at};
pub use depth_scale::depth_factor;
pub use fusion::{Blind, DEPTH_MAX, Fusion, TRUNCATION_VOXELS};
pub use grasp::{FINGER_DEPTH, Grasp, MAX_OPENING};
pub use hand::{Hand, HandError};
pub use maps::{DecodeError, Maps, VoxelOrigin};
pub use object_map::ObjectMap;
pub use obstacles::{Clearance, Obstacles};
pub use patch::Patch;
pub use selection::{Decoded, Dropped, select};
pub use surface::{SurfaceMesh, SurfacePoint};
pub use table::Table;
pub use tabletop::{NoTabletop, Tabletop};
pub use tile::Tile;
pub use volume::{Volume, VolumeError};
pub use warning::{TARGET_HEIGHT, TRAINED_ANGLE, TRAINED_DISTANCE, Warning};

/// Edge of the workspace cube, metres (the paper, section "Problem formulation").
pub const WORKSPACE_SIZE: f64 = 0.3;

/// Voxels along one edge of the volume that the networks of the papers read.
pub const RESOLUTION: usize = 40;
