//! Tests of the simulator and of the programs of `grasp-sim`. One program, because each would be linked with everything else.

mod agreement;
mod camera;
mod candidates;
mod commands;
mod one_image;
mod physics;
mod tabletop;
mod tracking;
mod warnings;
