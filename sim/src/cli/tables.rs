mod fingerprint;
mod log;
mod machine;
mod pybullet;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use clap::Args;
use grasp::DecodeParams;
use grasp_models::onnx::ModelProto;
use grasp_models::{Metadata, Options, Store};
use grasp_sim::benchmark::{Benchmark, Event};
use grasp_sim::camera::DepthNoise;
use grasp_sim::objects::ObjectSet;
use grasp_sim::planner::PlannerSpec;
use grasp_sim::score::{Spread, Summary};
use grasp_sim::tables::{
    Condition, EPSILON, EPSILONS, RELEASED, Results, SCENARIOS, Simulator, TEST_OBJECTS, TRAINED_ON_BOTH, VIEWS,
};
use indicatif::{ProgressBar, ProgressStyle};

use super::{Scene, parse_views};
use fingerprint::{decoding, digest, hash, hash_folder, simulator};
use log::{Log, Measurement};
use machine::machine;
use pybullet::{FOLDER, PyBullet, model};

/// Measures the paper's tables and writes them with the published figures. Each benchmark run is stored in --results
/// and is repeated only if the network, the simulator or the settings have changed.
#[derive(Args)]
pub struct Tables {
    /// Folder of the networks. NAME-packed.onnx and NAME-pile.onnx were trained on one scenario, NAME.onnx on both;
    /// classifiers/gpd.onnx is the classifier of GPD, and evaluators/ has the evaluators of networks.
    #[arg(long, default_value = "models/zoo")]
    models: PathBuf,

    /// Folder with VGN's released weights, vgn_packed.onnx and vgn_pile.onnx.
    #[arg(long)]
    released: Option<PathBuf>,

    /// Also evaluate on the objects of this folder of URDF files. The tables use the folder's name, which must not be
    /// `test` or that of another of these folders.
    #[arg(long, value_name = "DIR")]
    objects: Vec<PathBuf>,

    /// Also evaluate in PyBullet, with this Python interpreter. It needs the packages of sim/pybullet/requirements.txt.
    #[arg(long, value_name = "PYTHON", requires = "graspd")]
    pybullet: Option<PathBuf>,

    /// The graspd binary that serves the networks in PyBullet.
    #[arg(long, value_name = "PROGRAM")]
    graspd: Option<PathBuf>,

    /// Output file, Markdown.
    #[arg(long, default_value = "docs/tables.md")]
    out: PathBuf,

    /// Results of all benchmark runs, JSON lines. Runs found in it are not repeated, except for timings on another
    /// processor. Results of networks, objects, simulators and seeds that this command does not measure stay in it.
    #[arg(long, default_value = "models/tables.jsonl")]
    results: PathBuf,

    /// Scenes per seed.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    rounds: u64,

    /// Number of seeds. Views, ε and objects that are not in the paper, and PyBullet, use only the first seed.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,

    /// The first seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,

    /// Observations per timing of a planner.
    #[arg(long, default_value_t = 50)]
    timed: u64,
}

/// If no grasp of a network reaches ε, the best grasp is executed if its quality is at least this.
const FORCE: f32 = 0.5;

/// A planner and its name.
#[derive(Clone)]
struct Entry {
    method: String,
    trained_on: Option<&'static str>,
    planner: String,
    /// Whether the grasps are those of a network, which tables of views, ε and the correction compare.
    is_network: bool,
    /// SHA-256 of the planner's network.
    sha256: Option<String>,
}

/// A benchmark run, or a timing.
struct Task {
    key: String,
    condition: Condition,
    planner: String,
    seed: u64,
    timed: bool,
}

impl Tables {
    pub fn run(self) -> anyhow::Result<()> {
        self.check_object_names()?;
        let entries = self.entries()?;
        let fingerprint = digest(&format!("{} {}", simulator(), decoding()));
        let tasks = self.tasks(&entries, &fingerprint)?;
        let mut log = Log::open(&self.results)?;
        if let Some(folder) = self.out.parent() {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let missing: Vec<&Task> = tasks.iter().filter(|task| !log.measurements.contains_key(&task.key)).collect();
        eprintln!("{} of {} runs are missing", missing.len(), tasks.len());
        let progress = ProgressBar::new(missing.iter().map(|task| self.effort(task)).sum())
            .with_style(ProgressStyle::with_template("{wide_bar} {pos}/{len} scenes, {eta} left {msg}")?);
        let mut pybullet = self.pybullet.as_deref().zip(self.graspd.as_deref()).map(|(p, g)| PyBullet::new(p, g));
        for task in missing {
            let Condition { method, scenario, objects, simulator, .. } = &task.condition;
            progress.set_message(format!("{method} on {scenario}, {objects}, {}", simulator.name()));
            let measurement = match (simulator, &mut pybullet) {
                (Simulator::PyBullet, Some(pybullet)) => self.run_in_pybullet(task, pybullet, &progress),
                _ => self.run_in_rapier(task, &progress),
            };
            log.append(measurement.with_context(|| format!("planner `{}`", task.planner))?)?;
        }
        progress.finish_and_clear();
        let measured = tasks.iter().map(|task| (task.key.as_str(), &task.condition));
        log.keep(measured, |measurement| !self.measures(&entries, measurement))?;

        let results = self.results(&entries, &tasks, &log)?;
        let text = self.head(&fingerprint) + &results.markdown();
        fs::write(&self.out, text).with_context(|| self.out.display().to_string())?;
        println!("{}", self.out.display());
        Ok(())
    }

    /// Checks that the names of the object sets differ, because results are stored by name.
    fn check_object_names(&self) -> anyhow::Result<()> {
        for (index, folder) in self.objects.iter().enumerate() {
            let name = name_of(folder);
            ensure!(
                name != TEST_OBJECTS,
                "--objects is {}, but `{name}` is the name of the procedural test objects; rename the folder",
                folder.display()
            );
            if let Some(other) = self.objects[..index].iter().find(|other| name_of(other) == name) {
                bail!(
                    "--objects {} and --objects {} have the same name, `{name}`; rename one of the folders",
                    other.display(),
                    folder.display()
                );
            }
        }
        Ok(())
    }

    /// All planners, with each network.
    fn entries(&self) -> anyhow::Result<Vec<Entry>> {
        let entry = |method: &str, trained_on, planner: &str, file: Option<&Path>| {
            let sha256 = file.map(hash).transpose()?;
            let (method, planner) = (method.to_owned(), planner.to_owned());
            anyhow::Ok(Entry { method, trained_on, planner, is_network: false, sha256 })
        };
        let network = |method: &str, trained_on, planner: &str, file: &Path| {
            anyhow::Ok(Entry { is_network: true, ..entry(method, trained_on, planner, Some(file))? })
        };
        let mut entries = vec![entry("random", None, "random", None)?, entry("shaf", None, "shaf", None)?];
        let classifier = self.models.join("classifiers/gpd.onnx");
        if classifier.exists() {
            entries.push(entry("gpd", None, &format!("gpd:{}", classifier.display()), Some(&classifier))?);
        }
        let mut files: Vec<PathBuf> = fs::read_dir(&self.models)
            .and_then(|files| files.map(|file| Ok(file?.path())).collect())
            .with_context(|| self.models.display().to_string())?;
        files.retain(|path| path.extension().is_some_and(|extension| extension == "onnx"));
        files.sort();
        for path in &files {
            let (name, planner) = (path.file_stem().unwrap_or_default().to_string_lossy(), path.display().to_string());
            let scenario = SCENARIOS.into_iter().find(|scenario| name.ends_with(&format!("-{scenario}")));
            let method = match scenario {
                Some(scenario) => name.trim_end_matches(&format!("-{scenario}")).to_owned(),
                None => format!("{name}{TRAINED_ON_BOTH}"),
            };
            entries.push(network(&method, scenario, &planner, path)?);
            if method == "vgn" {
                entries.push(entry("shaf (proposals)", scenario, &format!("shaf:{planner}"), Some(path))?);
            }
        }
        for (name, evaluator, proposals) in self.evaluators()? {
            let scenario = SCENARIOS.into_iter().find(|scenario| name.ends_with(&format!("-{scenario}")));
            let method = scenario.map_or(&*name, |scenario| name.trim_end_matches(&format!("-{scenario}")));
            let planner = format!("{}:{}", evaluator.display(), proposals.display());
            let mut evaluated = network(method, scenario, &planner, &evaluator)?;
            evaluated.sha256 = evaluated.sha256.map(|sha256| anyhow::Ok(sha256 + &hash(&proposals)?)).transpose()?;
            entries.push(evaluated);
        }
        if let Some(folder) = &self.released {
            for scenario in SCENARIOS {
                let path = folder.join(format!("vgn_{scenario}.onnx"));
                let planner = path.display().to_string();
                entries.push(network(RELEASED, Some(scenario), &planner, &path)?);
            }
        }
        Ok(entries)
    }

    /// The names and files of the evaluators, with the files of their networks.
    fn evaluators(&self) -> anyhow::Result<Vec<(String, PathBuf, PathBuf)>> {
        let folder = self.models.join("evaluators");
        if !folder.is_dir() {
            return Ok(Vec::new());
        }
        let networks = Store::open(&self.models)?;
        let evaluators = Store::open(&folder)?;
        let with_network = |evaluator: &grasp_models::Entry| {
            let Metadata { name, network, .. } = &evaluator.metadata;
            let network = networks.get(network.as_deref().unwrap_or_default(), None)?;
            Ok((name.clone(), evaluator.path.clone(), network.path.clone()))
        };
        evaluators.entries().iter().map(with_network).collect()
    }

    fn tasks(&self, entries: &[Entry], fingerprint: &str) -> anyhow::Result<Vec<Task>> {
        let mut tasks = Vec::new();
        let machine = machine();
        let object_sets =
            self.objects.iter().map(|folder| Ok((name_of(folder), hash_folder(folder, &["urdf", "obj"])?)));
        let object_sets: Vec<(String, String)> = object_sets.collect::<anyhow::Result<_>>()?;
        let pybullet_files = match &self.pybullet {
            Some(_) => {
                Some(hash_folder(Path::new(FOLDER), &["py"])? + &hash_folder(Path::new("sim/hand"), &["urdf", "obj"])?)
            }
            None => None,
        };
        for entry in entries {
            for scenario in SCENARIOS {
                let crossed = entry.trained_on.is_some_and(|trained_on| trained_on != scenario);
                if crossed && !entry.is_network {
                    continue;
                }
                let as_published = Condition {
                    method: entry.method.clone(),
                    trained_on: entry.trained_on.map(str::to_owned),
                    scenario: scenario.to_owned(),
                    objects: TEST_OBJECTS.to_owned(),
                    simulator: Simulator::Rapier,
                    views: VIEWS[0].0.to_owned(),
                    epsilon: EPSILON,
                    forced: true,
                    is_scale_corrected: false,
                };
                let kind = entry.planner.split(':').next().filter(|_| !entry.is_network);
                let mut add = |condition: Condition, of_objects: &str, seed, timed| {
                    let Condition { views, epsilon, forced, is_scale_corrected, .. } = &condition;
                    let scenes = if timed { self.timed } else { self.rounds };
                    let on = (scenario, views, epsilon, forced, seed, scenes, timed);
                    let simulator = pybullet_files.as_ref().filter(|_| condition.simulator == Simulator::PyBullet);
                    let corrected = if *is_scale_corrected { " corrected" } else { "" };
                    // All times of a table are measured on one machine.
                    let machine = if timed { format!(" {machine}") } else { String::new() };
                    let key = digest(&format!(
                        "{kind:?} {:?} {on:?} {fingerprint} {of_objects} {simulator:?}{corrected}{machine}",
                        entry.sha256
                    ));
                    tasks.push(Task { key, condition, planner: entry.planner.clone(), seed, timed });
                };
                (self.seed..self.seed + self.seeds).for_each(|seed| add(as_published.clone(), "", seed, false));
                if crossed {
                    continue;
                }
                let mut more = Vec::new();
                if entry.is_network {
                    let other_views = VIEWS.into_iter().skip(1);
                    more.extend(
                        other_views.map(|(views, _)| Condition { views: views.to_owned(), ..as_published.clone() }),
                    );
                    more.extend(EPSILONS.map(|epsilon| Condition { epsilon, forced: false, ..as_published.clone() }));
                }
                more.into_iter().for_each(|condition| add(condition, "", self.seed, false));
                add(as_published.clone(), "", self.seed, true);

                let planner = entry.planner.parse::<PlannerSpec>().map_err(anyhow::Error::msg)?;
                let runs_in_pybullet = pybullet_files.is_some()
                    && (matches!(planner, PlannerSpec::Random) || model(&planner, &self.models).is_some());
                let test_objects = (TEST_OBJECTS.to_owned(), String::new());
                for (objects, hash) in std::iter::once(&test_objects).chain(&object_sets) {
                    for simulator in [Simulator::Rapier, Simulator::PyBullet] {
                        let condition = Condition { objects: objects.clone(), simulator, ..as_published.clone() };
                        if simulator == Simulator::PyBullet && !runs_in_pybullet {
                            continue;
                        }
                        if entry.is_network {
                            let corrected = Condition { is_scale_corrected: true, ..condition.clone() };
                            add(corrected, hash, self.seed, false);
                        }
                        if condition != as_published {
                            add(condition, hash, self.seed, false);
                        }
                    }
                }
            }
        }
        Ok(tasks)
    }

    /// Whether a measurement is one of those that this command makes, perhaps with another version of its network.
    fn measures(&self, entries: &[Entry], Measurement { condition, seed, .. }: &Measurement) -> bool {
        let has_planner =
            |entry: &Entry| entry.method == condition.method && entry.trained_on == condition.trained_on.as_deref();
        (condition.objects == TEST_OBJECTS || self.folder(condition).is_some())
            && (condition.simulator == Simulator::Rapier || self.pybullet.is_some())
            && entries.iter().any(has_planner)
            && (self.seed..self.seed + self.seeds).contains(seed)
    }

    fn effort(&self, task: &Task) -> u64 {
        if task.timed { self.timed } else { self.rounds }
    }

    /// The folder of a condition's objects; `None` for the test objects.
    fn folder(&self, condition: &Condition) -> Option<&Path> {
        self.objects.iter().map(PathBuf::as_path).find(|folder| name_of(folder) == condition.objects)
    }

    fn benchmark(&self, condition: &Condition, seed: u64) -> anyhow::Result<Benchmark> {
        let scene = scene_of(&condition.scenario);
        let objects = match self.folder(condition) {
            Some(folder) => ObjectSet::load(folder)?,
            None => scene.objects("test")?,
        };
        Ok(Benchmark {
            kind: scene.kind(),
            objects,
            count: 5,
            views: parse_views(&condition.views).context("views of a table")?,
            noise: DepthNoise { is_scale_corrected: condition.is_scale_corrected, ..DepthNoise::BENCHMARK },
            rounds: self.rounds,
            seed,
        })
    }

    fn run_in_pybullet(
        &self,
        task: &Task,
        pybullet: &mut PyBullet,
        progress: &ProgressBar,
    ) -> anyhow::Result<Measurement> {
        let planner = task.planner.parse::<PlannerSpec>().map_err(anyhow::Error::msg)?;
        let model = model(&planner, &self.models);
        let summary =
            pybullet.run(&task.condition, model.as_ref(), self.folder(&task.condition), self.rounds, task.seed)?;
        progress.inc(self.rounds);
        let (key, condition) = (task.key.clone(), task.condition.clone());
        Ok(Measurement { key, condition, seed: task.seed, summary: Some(summary), milliseconds: None })
    }

    fn run_in_rapier(&self, task: &Task, progress: &ProgressBar) -> anyhow::Result<Measurement> {
        let benchmark = self.benchmark(&task.condition, task.seed)?;
        let planner = task.planner.parse::<PlannerSpec>().map_err(anyhow::Error::msg)?;
        let params = params(task.condition.epsilon, task.condition.forced);
        let (mut summary, mut milliseconds) = (None, None);
        if task.timed {
            let mut planner = planner.build(&params, &Options::default())?;
            let mut times = Vec::new();
            // The first one is a warm-up.
            for number in 0..=self.timed {
                let (world, mut rng) = benchmark.scene(number);
                let Some(observation) = benchmark.observe(&world, &mut rng) else { continue };
                let start = Instant::now();
                planner.plan(&observation, &mut rng)?;
                times.push(start.elapsed().as_secs_f64() * 1e3);
                progress.inc(u64::from(number > 0));
            }
            milliseconds = Spread::new(times.get(1..).unwrap_or_default());
        } else {
            let rounds = benchmark.run(&planner, &params, &Options::default(), &AtomicBool::new(false), |event| {
                if let Event::Round = event {
                    progress.inc(1);
                }
            })?;
            summary = Some(Summary::new(&rounds));
        }
        Ok(Measurement {
            key: task.key.clone(),
            condition: task.condition.clone(),
            seed: task.seed,
            summary,
            milliseconds,
        })
    }

    fn results(&self, entries: &[Entry], tasks: &[Task], log: &Log) -> anyhow::Result<Results> {
        let mut results = Results::default();
        for task in tasks {
            let Some(measurement) = log.measurements.get(&task.key) else { continue };
            // The names of the stored condition may be older than those of the task.
            let condition = &task.condition;
            if let Some(summary) = &measurement.summary {
                results.conditions.entry(condition.clone()).or_default().push(summary.clone());
            }
            if let Some(milliseconds) = measurement.milliseconds {
                results.times.insert((condition.method.clone(), condition.scenario.clone()), milliseconds);
            }
        }
        for entry in entries.iter().filter(|entry| entry.method != RELEASED) {
            let path = Path::new(&entry.planner);
            let Some(name) = path.file_name().filter(|_| entry.sha256.is_some() && !entry.planner.contains(':')) else {
                continue;
            };
            let metadata = Metadata::from_model(&ModelProto::read(path)?, path)?;
            let provenance = |key: &str| metadata.provenance.get(key).map_or_else(|| "?".to_owned(), |n| thousands(n));
            results.data.insert(name.to_string_lossy().into_owned(), (provenance("scenes"), provenance("grasps")));
        }
        for (scenario, scene) in SCENARIOS.into_iter().zip([Scene::Packed, Scene::Pile]) {
            results.test_objects.insert(scenario.to_owned(), scene.objects("test")?.listed().len());
        }
        Ok(results)
    }

    fn head(&self, fingerprint: &str) -> String {
        let pybullet = match &self.pybullet {
            Some(_) => format!(
                " In PyBullet\n  ({FOLDER}) graspd serves the networks, with out_th 0.5, and keeps grasps at the border of the\n  \
                 volume; in rapier they are dropped, as in GIGA's evaluation."
            ),
            None => String::new(),
        };
        let seeds = match self.seeds {
            1 => format!("seed {}", self.seed),
            n => format!("seeds {} to {}", self.seed, self.seed + n - 1),
        };
        format!(
            "# The paper's tables\n\n\
             Tables 1–4 of *6-DoF Robotic Grasping with Transformer*, measured by `make tables`, with the published figures.\n\n\
             - Scenes: {} per seed, {seeds}, with up to five unseen procedural objects each: those for which a packed scene has\n\
             \x20 room, and those that stay in the workspace of a pile. PyBullet, and views, ε, objects and corrections that are not\n\
             \x20 in the paper, use only the first seed.\n\
             - Observation: one side view with depth noise. Grasps of networks: ε = 0.9, out_th 0.1, the best grasp first. If no\n\
             \x20 grasp reaches ε, the best grasp is executed if its quality is at least 0.5 (`force`). gpd and shaf have their own\n\
             \x20 thresholds.\n\
             - GSR: share of the grasps that lifted an object. DR: share of the objects that were removed. ±: standard deviation\n\
             \x20 over the seeds, if there are several.\n\
             - vgn, transformer: `vgn-packed` and `transformer-packed` on packed scenes, `vgn-pile` and `transformer-pile` on piles.\n\
             \x20 These transformers have 3.0 M parameters, the paper's has 87 M; our network of that size is not in these tables\n\
             \x20 ([card](../models/large/transformer.md)). VGN-R: VGN's released weights. vgn-refined: the evaluator with the grasps of\n\
             \x20 `vgn-packed`, in both scenarios.\n\
             - Times: {}, one thread of ONNX Runtime's CPU provider in fp32, one observation\n\
             \x20 at a time. The paper's times are for an RTX 3090.\n\
             - Simulator and decoding {}.{pybullet}\n\n",
            self.rounds,
            machine(),
            &fingerprint[..12],
        )
    }
}

/// Decoding parameters: ε in hundredths, and whether the best grasp is executed if none reaches it.
fn params(epsilon: u8, forced: bool) -> DecodeParams {
    let force = Some(FORCE).filter(|_| forced);
    DecodeParams { threshold: f32::from(epsilon) / 100.0, force, ..DecodeParams::benchmark() }
}

fn scene_of(scenario: &str) -> Scene {
    if scenario == "pile" { Scene::Pile } else { Scene::Packed }
}

fn name_of(folder: &Path) -> String {
    folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned()
}

fn thousands(number: &str) -> String {
    let mut text = number.to_owned();
    (1..number.len())
        .rev()
        .filter(|place| (number.len() - place).is_multiple_of(3))
        .for_each(|place| text.insert(place, ','));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thousands_are_separated() {
        assert_eq!(["7", "303", "16640", "1564546"].map(thousands), ["7", "303", "16,640", "1,564,546"]);
    }
}
