//! Training on a borrowed machine, rehearsed on this one.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use serde_json::Value;

const WORKSPACE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

#[test]
fn a_borrowed_machine_trains_a_model_that_comes_home() {
    let python = std::env::var_os("GRASPD_PYTHON").unwrap_or_else(|| "python3".into());
    let output = Command::new(python)
        .args(["-m", "unittest", "discover", "--verbose", "--pattern", "test_gpu.py", "--start-directory"])
        .arg(format!("{WORKSPACE}/tests/python"))
        .env("GRASP_TRAIN", env!("CARGO_BIN_EXE_grasp-train"))
        .env("GRASP_SIM", grasp_sim())
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let report = String::from_utf8_lossy(&output.stderr);
    // For unittest is content when it finds none at all.
    assert!(output.status.success() && report.contains("test_a_model_comes_home"), "{report}");
}

/// The simulator: cargo builds a package's programs for that package's own tests alone.
fn grasp_sim() -> PathBuf {
    let mut command = Command::new(env!("CARGO"));
    // As the other tests have it built, with whom nothing is left to do.
    command.current_dir(WORKSPACE).args(["build", "--bins", "--workspace", "--exclude", "grasp-train"]);
    command.args(["--locked", "--message-format", "json-render-diagnostics"]);
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    let output = command.stderr(Stdio::inherit()).output().expect("cargo runs, for it runs this test");
    assert!(output.status.success(), "grasp-sim does not build");
    let mut lines = output.stdout.split(|&byte| byte == b'\n');
    let executable = |line: &[u8]| {
        let message: Value = serde_json::from_slice(line).ok()?;
        let path = message["executable"].as_str()?;
        (message["target"]["name"] == "grasp-sim").then(|| PathBuf::from(path))
    };
    lines.find_map(executable).expect("cargo names what it has built")
}
