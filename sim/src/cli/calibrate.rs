use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use grasp_models::onnx::ModelProto;
use grasp_models::{Calibration, gpd};
use grasp_sim::reliability::{Reliability, calibration};

use super::reliability::read;

/// Fit the qualities of an evaluator to the success rate of executed grasps, on objects that it was not trained on.
#[derive(Args)]
pub struct Calibrate {
    /// The evaluator that predicted the qualities.
    #[arg(long)]
    evaluator: PathBuf,

    /// Files of `bench --attempts` or `sim/pybullet/clear.py --attempts`.
    #[arg(long, required = true, num_args = 1..)]
    attempts: Vec<PathBuf>,

    /// Output file: the evaluator with the calibration.
    #[arg(long)]
    out: PathBuf,
}

impl Calibrate {
    pub fn run(self) -> anyhow::Result<()> {
        let attempts = self.attempts.iter().map(|path| read(path)).collect::<anyhow::Result<Vec<_>>>()?.concat();
        let fitted = calibration(&attempts).context(
            "no calibration found: the success rate of these attempts does not rise with their quality; use more \
             attempts, with successes and failures",
        )?;
        let mut model = ModelProto::read(&self.evaluator)?;
        let input = model.graph.as_ref().and_then(|graph| graph.input.first()).map(|input| input.name().to_owned());
        ensure!(
            input.as_deref() == Some(gpd::INPUT),
            "--evaluator {} is not an evaluator: its input is `{}`, must be `{}`",
            self.evaluator.display(),
            input.unwrap_or_default(),
            gpd::INPUT
        );
        let earlier = Calibration::from_model(&model).with_context(|| self.evaluator.display().to_string())?;
        let all = fitted.after(&earlier);
        all.write_to(&mut model);
        model.write(&self.out)?;
        let before = Reliability::new(&attempts);
        println!(
            "{} attempts, {:.1} % succeeded, mean quality {:.1} %, expected calibration error {:.1} %",
            attempts.len(),
            100.0 * before.whole.lifted as f64 / attempts.len() as f64,
            100.0 * before.whole.quality,
            100.0 * before.error
        );
        println!("calibration: log-odds × {} {:+}", all.slope, all.offset);
        Ok(())
    }
}
