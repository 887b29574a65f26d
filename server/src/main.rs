//! The `graspd` binary; see the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    graspd::run()
}
