use anyhow::Context;
use clap::Args;
use grasp::DecodeParams;
use grasp_sim::benchmark::{Benchmark, Summary};
use grasp_sim::planner::PlannerSpec;
use indicatif::ProgressBar;

use super::SceneArgs;

/// The scenes depend on the seed alone, so every planner meets the same ones. Prints one JSON object a planner.
#[derive(Args)]
pub struct Bench {
    /// The planners: `random`; an .onnx network; `grpc:ADDRESS`, a running graspd; `shaf`, the highest place where the
    /// hand fits; `shaf:FILE`, the highest of a network's proposals above 0.5; `gpd:FILE`, places where the hand fits,
    /// scored by a classifier of `grasp-train classify`.
    #[arg(long = "planner", required = true)]
    planners: Vec<String>,

    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    decoding: DecodingArgs,

    /// Scenes to clear for each seed.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    rounds: u64,

    /// Play so many times, with --seed and the numbers after it: the papers use 5.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,

    /// Objects a scene.
    #[arg(long, default_value_t = 5)]
    count: usize,
}

/// Between a network's output and the grasps; by default as GIGA's evaluation has it. A running graspd takes the first
/// two only.
#[derive(Args)]
struct DecodingArgs {
    /// Smallest quality of a grasp (ε).
    #[arg(long, default_value_t = 0.9)]
    threshold: f32,

    /// Where nothing reaches the threshold, try the best voxel down to this quality; `none` for never.
    #[arg(long, default_value = "0.5", value_parser = parse_force)]
    force: Force,

    /// Voxels above this value are in front of a surface (out_th).
    #[arg(long, default_value_t = 0.1)]
    out_th: f32,

    /// Believe grasps at the borders of the volume too.
    #[arg(long)]
    no_border: bool,
}

#[derive(Clone, Copy)]
struct Force(Option<f32>);

fn parse_force(text: &str) -> Result<Force, String> {
    match text {
        "none" => Ok(Force(None)),
        number => number.parse().map(|floor| Force(Some(floor))).map_err(|_| "a number or `none`".to_owned()),
    }
}

/// Mean and sample standard deviation over the seeds; no deviation from one alone.
fn mean_and_std(values: Vec<f64>) -> serde_json::Value {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let std = (n > 1.0).then(|| (squares / (n - 1.0)).sqrt());
    serde_json::json!({ "mean": mean, "std": std, "n": values.len() })
}

impl DecodingArgs {
    fn params(&self) -> DecodeParams {
        let benchmark = DecodeParams::benchmark();
        DecodeParams {
            threshold: self.threshold,
            force: self.force.0,
            outside_above: self.out_th,
            border: benchmark.border.filter(|_| !self.no_border),
            ..benchmark
        }
    }
}

impl Bench {
    pub fn run(self) -> anyhow::Result<()> {
        let benchmark = Benchmark {
            kind: self.scene.kind(),
            objects: self.scene.objects("test")?,
            count: self.count,
            views: self.scene.views()?,
            noise: self.scene.noise,
            rounds: self.rounds,
            seed: self.scene.seed,
        };
        let params = self.decoding.params();
        for name in &self.planners {
            let progress = ProgressBar::new(self.rounds * self.seeds).with_message(name.clone());
            let mut games = Vec::new();
            for seed in benchmark.seed..benchmark.seed + self.seeds {
                let benchmark = Benchmark { seed, ..benchmark.clone() };
                let rounds = benchmark.run(&PlannerSpec::from(name.as_str()), &params, || progress.inc(1));
                games.push(rounds.with_context(|| format!("planner `{name}`"))?);
            }
            progress.finish_and_clear();
            let mut line = serde_json::to_value(Summary::of(&games.concat()))?;
            let each: Vec<Summary> = games.iter().map(|rounds| Summary::of(rounds)).collect();
            line["seeds"] = serde_json::json!({
                "gsr": mean_and_std(each.iter().map(|summary| summary.gsr).collect()),
                "dr": mean_and_std(each.iter().map(|summary| summary.dr).collect()),
            });
            line["planner"] = name.as_str().into();
            line["decoding"] = format!("{params:?}").into();
            line["setup"] = format!(
                "{:?}, objects {}, views {}, noise {}, {} objects a scene, {} rounds, seed {}",
                benchmark.kind,
                self.scene.objects.as_deref().unwrap_or("test"),
                self.scene.views,
                benchmark.noise,
                benchmark.count,
                benchmark.rounds,
                benchmark.seed
            )
            .into();
            println!("{line}");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_averaged() {
        assert_eq!(mean_and_std(vec![0.5]), serde_json::json!({ "mean": 0.5, "std": null, "n": 1 }));
        assert_eq!(mean_and_std(vec![1.0, 3.0]), serde_json::json!({ "mean": 2.0, "std": 2f64.sqrt(), "n": 2 }));
    }
}
