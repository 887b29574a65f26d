use anyhow::Context;
use clap::Args;
use grasp_sim::benchmark::{Benchmark, Summary};
use grasp_sim::planner::PlannerSpec;
use indicatif::ProgressBar;

use super::SceneArgs;

/// The scenes depend on the seed alone, so every planner meets the same ones. Prints one JSON object a planner.
#[derive(Args)]
pub struct Bench {
    /// The planners: `random`, an .onnx file, or `grpc:ADDRESS`, a running graspd.
    #[arg(long = "planner", required = true)]
    planners: Vec<String>,

    #[command(flatten)]
    scene: SceneArgs,

    /// Scenes to clear.
    #[arg(long, default_value_t = 100)]
    rounds: u64,

    /// Objects a scene.
    #[arg(long, default_value_t = 5)]
    count: usize,
}

impl Bench {
    pub fn run(self) -> anyhow::Result<()> {
        let benchmark = Benchmark {
            kind: self.scene.kind(),
            objects: self.scene.objects()?,
            count: self.count,
            views: self.scene.views()?,
            noise: !self.scene.no_noise,
            rounds: self.rounds,
            seed: self.scene.seed,
        };
        for name in &self.planners {
            let progress = ProgressBar::new(self.rounds).with_message(name.clone());
            let rounds = benchmark
                .run(&PlannerSpec::from(name.as_str()), || progress.inc(1))
                .with_context(|| format!("planner `{name}`"))?;
            progress.finish_and_clear();
            let mut line = serde_json::to_value(Summary::of(&rounds))?;
            line["planner"] = name.as_str().into();
            println!("{line}");
        }
        Ok(())
    }
}
