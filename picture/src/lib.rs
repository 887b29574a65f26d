//! Meshes, a depth camera renderer, and shaded pictures of scenes and grasps. This crate has no physics.

mod color;
mod light;
mod mesh;
mod picture;
mod raster;

pub use color::{Color, object_color, quality_color};
pub use mesh::Mesh;
pub use picture::{Picture, PictureError, save_sheet};
pub use raster::{Frame, Instance, NOTHING, TABLE, render, toward};
