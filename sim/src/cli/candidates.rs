use std::path::{Path, PathBuf};
use std::sync::Mutex;

use anyhow::Context;
use clap::Args;
use grasp::DecodeParams;
use grasp_data::Candidates as Tried;
use grasp_models::{Network, Options};
use grasp_planner::{Evaluator, NetworkPlanner, Planner};
use grasp_sim::label::SceneConfig;
use grasp_sim::ordered;
use indicatif::{ProgressBar, ProgressStyle};

use super::SceneArgs;

/// Writes the training data of `grasp-train classify`: an .npz with `images`, `labels` and `scenes`. The same seed
/// gives the same file on any number of threads.
#[derive(Args)]
pub struct Candidates {
    #[command(flatten)]
    scene: SceneArgs,

    /// Try the grasps of this network, moved at random, for an evaluator [default: GPD's candidates, for its
    /// classifier].
    #[arg(long)]
    network: Option<PathBuf>,

    /// Try the grasps of the network that this evaluator has moved, so that the next evaluator learns from the errors of
    /// this one.
    #[arg(long, requires = "network")]
    evaluator: Option<PathBuf>,

    /// Number of scenes. All images are kept in memory: 43 kB per candidate of GPD, 6 kB per grasp of a network.
    #[arg(long)]
    scenes: u64,

    /// Maximum number of randomly drawn candidates per scene.
    #[arg(long, default_value_t = 50)]
    candidates: usize,

    /// Output file, .npz.
    #[arg(long)]
    out: PathBuf,
}

impl Candidates {
    pub fn run(self) -> anyhow::Result<()> {
        let config = SceneConfig {
            kind: self.scene.kind(),
            objects: self.scene.objects("train")?,
            points: self.candidates,
            views: self.scene.views()?,
            observations: 1,
            noise: self.scene.noise,
            seed: self.scene.seed,
        };
        if let Some(folder) = self.out.parent() {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let style = "{wide_bar} {pos}/{len} scenes, {per_sec}, {eta} left";
        let progress = ProgressBar::new(self.scenes).with_style(ProgressStyle::with_template(style)?);
        let planner = self.network.map(|path| planner(&path, self.evaluator.as_deref())).transpose()?;
        let mut tried = Tried::default();
        ordered::for_each(
            0..self.scenes,
            |number| match &planner {
                Some((planner, params)) => config.proposals(number, planner, params),
                None => Ok(config.candidates(number)),
            },
            |_, candidates| {
                tried.append(candidates?);
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        eprintln!("{} candidates tried, {} of them successes", tried.len(), tried.successes());
        Ok(tried.write(&self.out)?)
    }
}

/// The planner whose grasps are tried, and its parameters.
fn planner(network: &Path, evaluator: Option<&Path>) -> anyhow::Result<(Mutex<Box<dyn Planner + Send>>, DecodeParams)> {
    let options = Options::default();
    let network = Network::load(network, &options)?;
    let params = DecodeParams { origin: network.metadata().voxel_origin, ..DecodeParams::benchmark() };
    let evaluator = evaluator.map(|path| Evaluator::load(path, &options)).transpose()?;
    let planner = NetworkPlanner::new(network, evaluator);
    Ok((Mutex::new(Box::new(planner)), Evaluator::proposal_params(&params)))
}
