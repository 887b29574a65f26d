//! Tests of training in libtorch. One program, because each would be linked with everything else.

mod agreement;
mod augmentation;
mod classifier;
mod command;
mod documented_command;
mod executor;
mod support;
mod training;
