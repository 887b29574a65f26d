//! The physics: a table, rigid objects and a hand. Only this module uses the physics engine.
//!
//! The interface uses metres, kilograms and f64. The engine works in centimetres and f32, because its collision
//! detection is wrong by millimetres at this scale when lengths are in metres.

mod gripper;
mod hand;
mod world;

pub use gripper::Gripper;
pub use hand::{HandPart, OPEN_HAND};
pub use world::{Body, BodyId, CONTACT_GAP, STEPS_PER_SECOND, World};
