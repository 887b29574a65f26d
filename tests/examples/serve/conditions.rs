use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, ensure};
use grasp::Volume;
use grasp_models::init;
use grasp_tests::grasp_sim;

use crate::volume_file;

/// The measured network, with trained weights.
pub(crate) const ZOO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo/vgn-packed.onnx");

/// The conditions of the measurement: CPU, threads, ONNX Runtime, load and time.
pub(crate) fn describe(threads: usize) -> anyhow::Result<String> {
    ensure!(!cfg!(debug_assertions), "a debug build cannot be measured: build it with --release");
    let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpu.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or("\t: an unknown CPU");
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let runtime = init()?;
    let seconds = std::time::SystemTime::UNIX_EPOCH.elapsed()?.as_secs();
    Ok(format!(
        "{} × {threads}, {threads} threads a session, callers on the same CPUs, release build; ONNX Runtime {}; load {} \
         before; Unix time {seconds}",
        cpu.trim_start_matches(['\t', ':', ' ']),
        runtime.version,
        load.split(' ').next().unwrap_or("?"),
    ))
}

/// The volume of a packed scene from the simulator, observed from one side.
pub(crate) fn scene(folder: &Path) -> anyhow::Result<Volume> {
    let out = folder.join("scene");
    let label = "label --scene packed --scenes 1 --points 1 --seed 51 --format processed --out";
    let output = Command::new(grasp_sim()).args(label.split(' ')).arg(&out).output()?;
    ensure!(output.status.success(), "grasp-sim: {}", String::from_utf8_lossy(&output.stderr));
    let path = fs::read_dir(out.join("scenes"))?.next().context("a scene")??.path();
    volume_file::read(&path)
}
