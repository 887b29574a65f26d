//! Simulation: objects, scenes, a depth camera, and trials of grasps with a simulated hand. It produces training labels
//! and benchmarks. Only this crate depends on the physics engine; it does not depend on libtorch.
//!
//! The task frame has its origin at a corner of the workspace (a cube of 0.3 m) and z up. The table's top is at
//! [`TABLE_HEIGHT`].

pub mod benchmark;
pub mod camera;
pub mod candidates;
pub mod export;
pub mod hull;
pub mod label;
pub mod objects;
pub mod ordered;
pub mod physics;
pub mod planner;
pub mod proposals;
pub mod reliability;
pub mod scene;
pub mod score;
pub mod statistics;
pub mod tables;
pub mod trial;

pub use grasp::TABLE_HEIGHT;
