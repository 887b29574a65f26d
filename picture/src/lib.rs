//! Meshes, a depth camera renderer, and shaded pictures of scenes and grasps. This crate has no physics.

mod mesh;
mod picture;
mod raster;

pub use mesh::Mesh;
pub use picture::{Color, Picture, PictureError, object_color, quality_color, save_sheet};
pub use raster::{Frame, Instance, NOTHING, TABLE, render};
