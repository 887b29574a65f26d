//! Benchmark runs in PyBullet, with planners that graspd serves.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::available_parallelism;

use anyhow::{Context, ensure};
use grasp_client::LocalServer;
use grasp_sim::planner::PlannerSpec;
use grasp_sim::score::Summary;
use grasp_sim::tables::Condition;
use tempfile::TempDir;

use super::{FORCE, scene_of};

/// Relative to the root of a checkout.
pub(super) const FOLDER: &str = "sim/pybullet";

/// Runs the benchmark in PyBullet.
pub(super) struct PyBullet {
    python: PathBuf,
    graspd: PathBuf,
    /// One server per model folder.
    servers: BTreeMap<PathBuf, LocalServer>,
    /// URDF files of the test objects, by scenario.
    objects: BTreeMap<String, TempDir>,
}

/// A model that graspd serves.
pub(super) struct Model<'a> {
    folder: &'a Path,
    name: String,
    /// Smallest quality of a grasp, without `force`; `None` for networks, which use ε and `force`.
    threshold: Option<&'static str>,
}

/// The served model of a planner; `None` if graspd does not serve it. `zoo` is the model folder for planners without a
/// network.
pub(super) fn model<'a>(planner: &'a PlannerSpec, zoo: &'a Path) -> Option<Model<'a>> {
    let classical =
        |name: &str, threshold| Some(Model { folder: zoo, name: name.to_owned(), threshold: Some(threshold) });
    let network = |file: &Path, folder| {
        let name = file.file_stem()?.to_string_lossy().into_owned();
        Some(Model { folder, name, threshold: None })
    };
    match planner {
        PlannerSpec::Highest => classical("shaf", "0.000001"),
        PlannerSpec::Gpd(_) => classical("gpd", "0.5"),
        PlannerSpec::Network(path) => network(path, path.parent()?),
        PlannerSpec::Evaluated { evaluator, network: path } => network(evaluator, path.parent()?),
        PlannerSpec::Random | PlannerSpec::Server(_) | PlannerSpec::HighestProposed(_) => None,
    }
}

impl PyBullet {
    pub(super) fn new(python: &Path, graspd: &Path) -> Self {
        let (python, graspd) = (python.to_owned(), graspd.to_owned());
        Self { python, graspd, servers: BTreeMap::new(), objects: BTreeMap::new() }
    }

    /// Runs the benchmark; without a model, with random grasps. `folder` has the objects; `None`: the test objects.
    pub(super) fn run(
        &mut self,
        condition: &Condition,
        model: Option<&Model>,
        folder: Option<&Path>,
        rounds: u64,
        seed: u64,
    ) -> anyhow::Result<Summary> {
        let objects = match folder {
            Some(folder) => folder.to_owned(),
            None => self.test_objects(&condition.scenario)?,
        };
        let mut command = Command::new(&self.python);
        command
            .arg(Path::new(FOLDER).join("clear.py"))
            .args(["--scene", &condition.scenario])
            .arg("--objects")
            .arg(objects);
        if let Some(model) = model {
            let address = self.server(model.folder)?;
            let epsilon = format!("0.{}", condition.epsilon);
            let (threshold, force) = match model.threshold {
                Some(threshold) => (threshold, "none".to_owned()),
                None => (epsilon.as_str(), FORCE.to_string()),
            };
            command.args(["--planner", &format!("grpc:{address}"), "--model", &model.name]);
            command.args(["--threshold", threshold, "--force", &force]);
        }
        if condition.is_scale_corrected {
            command.arg("--correct-depth-scale");
        }
        let jobs = available_parallelism().map_or(1, |n| n.get());
        command.args(["--rounds", &rounds.to_string(), "--seed", &seed.to_string(), "--jobs", &jobs.to_string()]);
        let output = command.output().with_context(|| format!("cannot run {}", self.python.display()))?;
        let stderr = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "{command:?} failed ({}): {stderr}", output.status);
        let text = String::from_utf8_lossy(&output.stdout);
        let last = text.lines().last().with_context(|| format!("{command:?} printed nothing"))?;
        serde_json::from_str(last).with_context(|| format!("{command:?} printed `{last}`"))
    }

    fn test_objects(&mut self, scenario: &str) -> anyhow::Result<PathBuf> {
        if let Some(written) = self.objects.get(scenario) {
            return Ok(written.path().to_owned());
        }
        let folder = TempDir::with_prefix("grasp-sim-objects-").context("no temporary folder")?;
        for object in scene_of(scenario).objects("test")?.listed() {
            object.save(folder.path())?;
        }
        let path = folder.path().to_owned();
        self.objects.insert(scenario.to_owned(), folder);
        Ok(path)
    }

    fn server(&mut self, models: &Path) -> anyhow::Result<String> {
        if !self.servers.contains_key(models) {
            let arguments = ["--log".as_ref(), "warn".as_ref(), "--models".as_ref(), models.as_os_str()];
            self.servers.insert(models.to_owned(), LocalServer::spawn(&self.graspd, arguments)?);
        }
        Ok(self.servers[models].grpc().to_string())
    }
}
