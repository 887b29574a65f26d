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
    /// The planners: `random`, an .onnx file, or `grpc:ADDRESS`, a running graspd.
    #[arg(long = "planner", required = true)]
    planners: Vec<String>,

    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    decoding: DecodingArgs,

    /// Scenes to clear.
    #[arg(long, default_value_t = 100)]
    rounds: u64,

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
            noise: !self.scene.no_noise,
            rounds: self.rounds,
            seed: self.scene.seed,
        };
        let params = self.decoding.params();
        for name in &self.planners {
            let progress = ProgressBar::new(self.rounds).with_message(name.clone());
            let rounds = benchmark
                .run(&PlannerSpec::from(name.as_str()), &params, || progress.inc(1))
                .with_context(|| format!("planner `{name}`"))?;
            progress.finish_and_clear();
            let mut line = serde_json::to_value(Summary::of(&rounds))?;
            line["planner"] = name.as_str().into();
            line["decoding"] = format!("{params:?}").into();
            line["setup"] = format!(
                "{:?}, objects {}, views {}, noise {}, {} objects a scene, seed {}",
                benchmark.kind,
                self.scene.objects.as_deref().unwrap_or("test"),
                self.scene.views,
                benchmark.noise,
                benchmark.count,
                benchmark.seed
            )
            .into();
            println!("{line}");
        }
        Ok(())
    }
}
