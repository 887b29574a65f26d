use std::path::{Path, PathBuf};
use std::sync::Mutex;

use clap::Args;
use grasp::DecodeParams;
use grasp_data::{Provenance, Setup, packed};
use grasp_models::{Network, Options};
use grasp_planner::{Evaluator, NetworkPlanner, Planner};
use grasp_sim::ordered;
use grasp_sim::planner::PlannerSpec;

use super::data::DataArgs;
use super::progress;

/// Writes the training data of `grasp-train classify --network evaluator`: a packed data set. Each scene is observed
/// once. Each grasp is moved at random and executed with a pose error. An interrupted run continues where it stopped.
#[derive(Args)]
pub struct Proposals {
    #[command(flatten)]
    data: DataArgs,

    /// The network that proposes grasps: a file, or the name of one that comes with graspd.
    #[arg(long, value_name = "FILE|NAME", value_parser = network)]
    network: PathBuf,

    /// Try the grasps as this evaluator scores and moves them, so that the next evaluator is trained on the errors of
    /// this one: a file, or the name of a model with an evaluator that comes with graspd.
    #[arg(long, value_name = "FILE|NAME", value_parser = evaluator)]
    evaluator: Option<PathBuf>,

    /// Write what was observed in voxels of half the size, with free space: the best input for training an evaluator.
    /// Without it the data have the volumes, for training a network or an evaluator.
    #[arg(long)]
    details: bool,

    /// Number of scenes.
    #[arg(long)]
    scenes: u64,

    /// Grasps tried per scene.
    #[arg(long, default_value_t = 100)]
    grasps: usize,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,
}

impl Proposals {
    pub fn run(self) -> anyhow::Result<()> {
        let config = self.data.config(self.grasps, 1)?;
        let (planner, params) = planner(&self.network, self.evaluator.as_deref())?;
        let setup = Setup::benchmark(Provenance {
            network: Some(name(&self.network)),
            evaluator: self.evaluator.as_deref().map(name),
            details: self.details,
            ..self.data.provenance(&config)
        });
        let mut writer = packed::Writer::open(&self.out, &setup)?;
        let next = writer.next().unwrap_or(0);
        let progress = progress::of_scenes(self.scenes)?;
        progress.set_position(next);
        progress.reset_eta();
        ordered::for_each(
            next..self.scenes.max(next),
            |number| config.proposals(number, &planner, &params, self.details),
            |number, scene| {
                if let Some(scene) = scene? {
                    writer.append(number, &[scene.values], &scene.trials, Some(&scene.occupancy))?;
                }
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        Ok(())
    }
}

/// The file of a network.
fn network(text: &str) -> Result<PathBuf, String> {
    match text.parse()? {
        PlannerSpec::Network(file) => Ok(file),
        _ => Err("is not a network alone".to_owned()),
    }
}

/// The file of an evaluator.
fn evaluator(text: &str) -> Result<PathBuf, String> {
    match text.parse()? {
        PlannerSpec::Evaluated { evaluator: file, .. } => Ok(file),
        // Of files only the ending is known.
        PlannerSpec::Network(file) if file.as_path() == Path::new(text) => Ok(file),
        _ => Err("has no evaluator".to_owned()),
    }
}

/// The name of a model file in the provenance.
fn name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
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
