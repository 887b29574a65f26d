//! `make demo` with the shipped models.

use std::fs;
use std::path::Path;
use std::process::Command;

use grasp_tests::{grasp_sim, graspd};

#[test]
fn the_demo_detects_executes_and_draws_grasps_and_stops_its_server() {
    let picture = tempfile::tempdir().unwrap();
    let picture = picture.path().join("demo.png");
    let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/zoo");
    let mut command = Command::new(grasp_sim());
    command.args(["demo".as_ref(), "--graspd".as_ref(), graspd().as_os_str(), "--models".as_ref(), zoo.as_os_str()]);
    let output = command.arg("--picture").arg(&picture).output().unwrap();
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{stdout}{stderr}");
    for expected in ["grasps from vgn-refined", "latency: queue", "the best one, executed:", "graspd stopped cleanly"] {
        assert!(stdout.contains(expected), "`{expected}` is missing from:\n{stdout}");
    }
    assert!(fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
}
