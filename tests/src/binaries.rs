use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// The server.
///
/// # Panics
/// If it was not built.
#[must_use]
pub fn graspd() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| program("graspd"));
    &PROGRAM
}

/// The command-line client.
///
/// # Panics
/// If it was not built.
#[must_use]
pub fn grasp() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| program("grasp"));
    &PROGRAM
}

/// The simulator.
///
/// # Panics
/// If it was not built.
#[must_use]
pub fn grasp_sim() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| program("grasp-sim"));
    &PROGRAM
}

/// The client library's example.
///
/// # Panics
/// If it was not built.
#[must_use]
pub fn example() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| program("examples/detect"));
    &PROGRAM
}

/// A program of the workspace, built with the same profile as this test: Cargo puts it into the folder above that of the
/// test. Tests do not call Cargo, because it would compile while other tests run.
fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a running program has a path");
    let folder = test.ancestors().nth(2).expect("Cargo puts tests into a folder `deps`");
    let path = folder.join(name);
    assert!(
        path.exists(),
        "{} not found: run `make test`, or `cargo build --workspace --bins --example detect` before `cargo test`",
        path.display()
    );
    path
}
