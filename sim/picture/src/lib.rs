//! Meshes, what a depth camera sees of them, and shaded pictures of scenes and grasps. Knows no physics.

mod mesh;
mod picture;
mod raster;

pub use mesh::Mesh;
pub use picture::{Color, Picture, PictureError, object_color, quality_color, save_sheet};
pub use raster::{Frame, Instance, NOTHING, TABLE, render};
