//! Plays in the second simulator, where servers of this process answer.

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

/// From the root of a checkout.
pub(super) const FOLDER: &str = "sim/pybullet";

/// The second simulator.
pub(super) struct PyBullet {
    python: PathBuf,
    graspd: PathBuf,
    /// A server for each folder of models.
    servers: BTreeMap<PathBuf, LocalServer>,
    /// Our test objects as files, for each scenario.
    objects: BTreeMap<String, TempDir>,
}

/// A model of a folder.
pub(super) struct Model<'a> {
    folder: &'a Path,
    name: String,
    /// Smallest quality of a grasp, and whether the best grasp is taken where nothing reaches it; none for a network's.
    threshold: Option<&'static str>,
}

/// Which model of a server is the planner; `None` where no server has it. `zoo` is the folder of those that are not
/// networks.
pub(super) fn model<'a>(planner: &'a PlannerSpec, zoo: &'a Path) -> Option<Model<'a>> {
    let classical = |name: &str, threshold| Model { folder: zoo, name: name.to_owned(), threshold: Some(threshold) };
    match planner {
        PlannerSpec::Highest => Some(classical("shaf", "0.000001")),
        PlannerSpec::Gpd(_) => Some(classical("gpd", "0.5")),
        PlannerSpec::Network(path) => {
            let name = path.file_stem()?.to_string_lossy().into_owned();
            Some(Model { folder: path.parent()?, name, threshold: None })
        }
        PlannerSpec::Random | PlannerSpec::Server(_) | PlannerSpec::HighestProposed(_) => None,
    }
}

impl PyBullet {
    pub(super) fn new(python: &Path, graspd: &Path) -> Self {
        let (python, graspd) = (python.to_owned(), graspd.to_owned());
        Self { python, graspd, servers: BTreeMap::new(), objects: BTreeMap::new() }
    }

    /// Clears tables; without a model, by random grasps. `folder` has the objects, if they are not ours.
    pub(super) fn play(
        &mut self,
        condition: &Condition,
        model: Option<&Model>,
        folder: Option<&Path>,
        rounds: u64,
        seed: u64,
    ) -> anyhow::Result<Summary> {
        let objects = match folder {
            Some(folder) => folder.to_owned(),
            None => self.ours(&condition.scenario)?,
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
        let jobs = available_parallelism().map_or(1, |n| n.get());
        command.args(["--rounds", &rounds.to_string(), "--seed", &seed.to_string(), "--jobs", &jobs.to_string()]);
        let output = command.output().with_context(|| format!("cannot run {}", self.python.display()))?;
        let said = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "{command:?} failed ({}): {said}", output.status);
        let text = String::from_utf8_lossy(&output.stdout);
        let last = text.lines().last().with_context(|| format!("{command:?} printed nothing"))?;
        serde_json::from_str(last).with_context(|| format!("{command:?} printed `{last}`"))
    }

    fn ours(&mut self, scenario: &str) -> anyhow::Result<PathBuf> {
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
