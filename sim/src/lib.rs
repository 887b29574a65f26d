//! Simulated clutter: objects, scenes, a depth camera, a hand that tries grasps, and what is made of them: labels to
//! train on, and benchmarks. Nothing outside this crate knows physics; this crate knows nothing of libtorch.
//!
//! The task frame: origin at a corner of the 0.3 m workspace cube, z up, the table's top at [`TABLE_HEIGHT`].

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
pub mod reliability;
pub mod scene;
pub mod score;
pub mod statistics;
pub mod tables;
pub mod trial;

/// Height of the table's top in the task frame, metres.
pub const TABLE_HEIGHT: f64 = 0.05;
