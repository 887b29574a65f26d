//! Perception: from what the cameras saw to the scenes of a planner.
//!
//! Data flow: [`Frames`] + [`Workspace`] → [`Observation`] (in the task frame) → cubes → [`Scenes`]. [`perceive`] does
//! this for one request, and a [`Track`] for a stream of requests. This crate does no I/O and starts no threads.
//!
//! Conventions are those of the crate [`grasp`].

#![warn(missing_docs)]

mod cubes;
mod depth_scale;
mod frame;
mod grid;
mod layout;
mod observation;
mod point_sampler;
mod rendering;
mod scene;
mod segmentation;
mod table;
mod tabletop;
mod tracking;
mod warning;
mod workspace;

pub use cubes::perceive;
pub use depth_scale::{DepthScale, depth_factor, image_depth_factor, measured_shift, plausible_depth_factor};
pub use frame::{CameraPose, Cloud, Frame, View};
pub use grid::{InputGrid, NetworkGrid, check_margin};
pub use observation::{Frames, Observation};
pub use rendering::{overview, seen_from};
pub use scene::{Scene, Scenes};
pub use table::Table;
pub use tabletop::{NoTabletop, Tabletop};
pub use tracking::{Start, Track};
pub use warning::{TARGET_HEIGHT, TRAINED_ANGLE, TRAINED_DISTANCE, Warning, table_warning};
pub use workspace::{FoundTable, Workspace};
