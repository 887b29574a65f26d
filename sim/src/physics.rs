//! The physics: a table, rigid objects on it, and a hand. Everything that knows the engine is in here.
//!
//! The interface is in metres, kilograms and f64; the engine's world is in centimetres and f32, because at the size of
//! a grasp its collision code loses millimetres when it counts in metres.

mod gripper;
mod hand;
mod world;

pub use gripper::Gripper;
pub use hand::{HandPart, OPEN_HAND};
pub use world::{Body, BodyId, CONTACT_GAP, STEPS_PER_SECOND, World};
