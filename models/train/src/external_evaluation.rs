//! Evaluation of a network by another program, such as the benchmark in simulation.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use grasp_train::BenchmarkRates;

/// Placeholder of the network's file in the command.
pub(crate) const PLACEHOLDER: &str = "{}";

/// Runs `command` on a network. Every line of its output must be a JSON object with `gsr` and `dr`, as of
/// `grasp-sim bench`. Returns their mean.
pub(crate) fn evaluate(command: &str, network: &Path) -> Result<BenchmarkRates> {
    let quoted = format!("'{}'", network.display().to_string().replace('\'', "'\\''"));
    let command = command.replace(PLACEHOLDER, &quoted);
    // The command inherits stderr: its errors appear in the output of the training.
    let run = Command::new("sh").args(["-c", &command]).stderr(Stdio::inherit()).output();
    let output = run.with_context(|| format!("--evaluate `{command}`"))?;
    ensure!(output.status.success(), "--evaluate `{command}` failed: {}", output.status);
    let text = String::from_utf8_lossy(&output.stdout);
    let mut all = Vec::new();
    for line in text.lines().filter(|line| !line.trim().is_empty()) {
        match serde_json::from_str::<BenchmarkRates>(line) {
            Ok(BenchmarkRates { gsr, dr }) if gsr.is_finite() && dr.is_finite() => all.push([gsr, dr]),
            _ => bail!("--evaluate `{command}` printed `{line}`, must print JSON objects with `gsr` and `dr`"),
        }
    }
    ensure!(!all.is_empty(), "--evaluate `{command}` printed nothing, must print JSON objects with `gsr` and `dr`");
    let mean = |index: usize| all.iter().map(|rates| rates[index]).sum::<f64>() / all.len() as f64;
    Ok(BenchmarkRates { gsr: mean(0), dr: mean(1) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_results_are_averaged() {
        let command = r#"test -e {} && echo '{"gsr":0.5,"dr":0.25,"more":1}' && echo '{"gsr":1,"dr":0.75}'"#;
        let folder = tempfile::tempdir().unwrap();
        let network = folder.path().join("it's a network.onnx");
        std::fs::write(&network, "").unwrap();
        assert_eq!(evaluate(command, &network).unwrap(), BenchmarkRates { gsr: 0.75, dr: 0.5 });
    }

    #[test]
    fn unusable_output_is_an_error() {
        let refused = |command: &str| evaluate(command, Path::new("network.onnx")).unwrap_err().to_string();
        assert!(refused("false").contains("failed"));
        assert!(refused("true").contains("printed nothing"));
        assert!(refused("echo GSR 80").contains("printed `GSR 80`"));
    }
}
