use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::LazyLock;

use serde_json::Value;

/// Cargo builds the programs of a package only for the tests of that package, so they are built here, before the first
/// test that runs one. After a `cargo build` they are up to date.
static BINARIES: LazyLock<HashMap<String, PathBuf>> = LazyLock::new(build);

/// The server.
///
/// # Panics
/// If it does not build.
#[must_use]
pub fn graspd() -> &'static Path {
    &BINARIES["graspd"]
}

/// The command-line client.
///
/// # Panics
/// If it does not build.
#[must_use]
pub fn grasp() -> &'static Path {
    &BINARIES["grasp"]
}

/// The simulator.
///
/// # Panics
/// If it does not build.
#[must_use]
pub fn grasp_sim() -> &'static Path {
    &BINARIES["grasp-sim"]
}

/// The client library's example.
///
/// # Panics
/// If it does not build.
#[must_use]
pub fn example() -> &'static Path {
    &BINARIES["detect"]
}

fn build() -> HashMap<String, PathBuf> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut command = Command::new(env!("CARGO"));
    // In the root of the workspace, because CARGO_TARGET_DIR may be relative to it.
    // The whole workspace, as in `make test`: with a single package, Cargo may select other features and build the
    // dependencies again.
    command.current_dir(workspace).args(["build", "--bins", "--examples", "--workspace", "--exclude", "grasp-train"]);
    command.args(["--locked", "--message-format", "json-render-diagnostics"]);
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    // Cargo sets these variables for this package. Build scripts that depend on them, such as that of ring, would run
    // again, and half of the dependencies would be built again.
    for (name, _) in std::env::vars_os() {
        if ["CARGO_PKG_", "CARGO_MANIFEST_"].iter().any(|own| name.to_string_lossy().starts_with(own)) {
            command.env_remove(name);
        }
    }
    let output = command.stderr(Stdio::inherit()).output().expect("cargo can be run, because it runs this test");
    assert!(output.status.success(), "the programs under test do not build");
    let messages = output.stdout.split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
    let executable = |message: Value| {
        let path = message["executable"].as_str()?.into();
        Some((message["target"]["name"].as_str()?.to_owned(), path))
    };
    messages.filter_map(executable).collect()
}
