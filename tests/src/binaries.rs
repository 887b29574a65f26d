use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::LazyLock;

use serde_json::Value;

/// Cargo builds a package's programs for that package's own tests alone, so these are built here, before the first
/// test that runs one; after a `cargo build` there is nothing left to do.
static BINARIES: LazyLock<HashMap<String, PathBuf>> = LazyLock::new(build);

/// The server.
///
/// # Panics
/// When it does not build.
#[must_use]
pub fn graspd() -> &'static Path {
    &BINARIES["graspd"]
}

/// The command-line client.
///
/// # Panics
/// When it does not build.
#[must_use]
pub fn grasp() -> &'static Path {
    &BINARIES["grasp"]
}

/// The simulator.
///
/// # Panics
/// When it does not build.
#[must_use]
pub fn grasp_sim() -> &'static Path {
    &BINARIES["grasp-sim"]
}

/// The client library's example.
///
/// # Panics
/// When it does not build.
#[must_use]
pub fn example() -> &'static Path {
    &BINARIES["detect"]
}

fn build() -> HashMap<String, PathBuf> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut command = Command::new(env!("CARGO"));
    // From the workspace's root, as a relative CARGO_TARGET_DIR is meant.
    // All of the workspace at once, as `make test` tests it: a package alone would want its dependencies built anew.
    command.current_dir(workspace).args(["build", "--bins", "--examples", "--workspace", "--exclude", "grasp-train"]);
    command.args(["--locked", "--message-format", "json-render-diagnostics"]);
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    // What cargo tells this package of itself: build scripts that listen to it (ring's) would run anew, and half of the
    // dependencies be built behind them, back and forth.
    for (name, _) in std::env::vars_os() {
        if ["CARGO_PKG_", "CARGO_MANIFEST_"].iter().any(|own| name.to_string_lossy().starts_with(own)) {
            command.env_remove(name);
        }
    }
    let output = command.stderr(Stdio::inherit()).output().expect("cargo runs, for it runs this test");
    assert!(output.status.success(), "the programs under test do not build");
    let messages = output.stdout.split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
    let executable = |message: Value| {
        let path = message["executable"].as_str()?.into();
        Some((message["target"]["name"].as_str()?.to_owned(), path))
    };
    messages.filter_map(executable).collect()
}
