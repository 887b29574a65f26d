use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use grasp::{DecodeParams, Maps, RESOLUTION, Volume, WORKSPACE_SIZE, decode};
use grasp_models::onnx::ModelProto;
use grasp_models::{Metadata, Options};
use grasp_sim::benchmark::{Benchmark, Event};
use grasp_sim::label::Recipe;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::planner::PlannerSpec;
use grasp_sim::score::{Spread, Summary};
use grasp_sim::tables::{EPSILON, EPSILONS, Game, LEARNT_BOTH, RELEASED, Results, SCENARIOS, VIEWS};
use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::Isometry3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{Scene, parse_views};

/// Plays what the paper's tables need, and writes them beside the published figures. What was played is kept beside the
/// tables as JSON lines and not played again, unless the network, the simulator or the settings have changed.
#[derive(Args)]
pub struct Tables {
    /// Folder of our networks: NAME-packed.onnx and NAME-pile.onnx learnt from one scenario, NAME.onnx from both;
    /// classifiers/gpd.onnx is GPD's.
    #[arg(long, default_value = "models/zoo")]
    models: PathBuf,

    /// Folder with VGN's released weights as vgn_packed.onnx and vgn_pile.onnx.
    #[arg(long)]
    released: Option<PathBuf>,

    /// The tables.
    #[arg(long, default_value = "docs/tables.md")]
    out: PathBuf,

    /// Scenes to clear for each seed.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    rounds: u64,

    /// How many seeds; the cameras and ε that the paper does not have are played with the first two.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,

    /// The first seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,

    /// Observations to time each planner on.
    #[arg(long, default_value_t = 50)]
    timed: u64,
}

/// Seeds of the cameras and ε that the paper does not have.
const SEEDS_ELSEWHERE: u64 = 2;

/// A planner and what it is called.
#[derive(Clone)]
struct Entry {
    method: String,
    learnt: Option<&'static str>,
    planner: String,
    /// Of the planner's network.
    sha256: Option<String>,
}

/// A line of what was played.
#[derive(Clone, Serialize, Deserialize)]
struct Played {
    /// A hash of everything that it depends on.
    key: String,
    #[serde(flatten)]
    game: Game,
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    summary: Option<Summary>,
    #[serde(skip_serializing_if = "Option::is_none")]
    milliseconds: Option<Spread>,
}

/// Something to play.
struct Task {
    key: String,
    game: Game,
    planner: String,
    seed: u64,
    timed: bool,
}

impl Tables {
    pub fn run(self) -> anyhow::Result<()> {
        let entries = self.entries()?;
        let fingerprint = digest(&format!("{} {}", simulator(), decoding()));
        let tasks = self.tasks(&entries, &fingerprint);
        let mut log = Log::open(&self.out.with_extension("jsonl"))?;
        let missing: Vec<&Task> = tasks.iter().filter(|task| !log.played.contains_key(&task.key)).collect();
        eprintln!("{} of {} games are to be played", missing.len(), tasks.len());
        let progress = ProgressBar::new(missing.iter().map(|task| self.effort(task)).sum())
            .with_style(ProgressStyle::with_template("{wide_bar} {pos}/{len} scenes, {eta} left {msg}")?);
        for task in missing {
            progress.set_message(format!("{} on {}", task.game.method, task.game.scenario));
            let played = self.play(task, &progress).with_context(|| format!("planner `{}`", task.planner))?;
            log.append(played)?;
        }
        progress.finish_and_clear();
        log.keep(&tasks)?;

        let results = self.results(&entries, &tasks, &log)?;
        let text = self.head(&fingerprint) + &results.markdown();
        fs::write(&self.out, text).with_context(|| self.out.display().to_string())?;
        println!("{}", self.out.display());
        Ok(())
    }

    /// Every planner there is, with each network in it.
    fn entries(&self) -> anyhow::Result<Vec<Entry>> {
        let entry = |method: &str, learnt, planner: &str, file: Option<&Path>| {
            let sha256 = file.map(|path| hash(path).with_context(|| path.display().to_string())).transpose()?;
            anyhow::Ok(Entry { method: method.to_owned(), learnt, planner: planner.to_owned(), sha256 })
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
                None => format!("{name}{LEARNT_BOTH}"),
            };
            entries.push(entry(&method, scenario, &planner, Some(path))?);
            if method == "vgn" {
                entries.push(entry("shaf (proposals)", scenario, &format!("shaf:{planner}"), Some(path))?);
            }
        }
        if let Some(folder) = &self.released {
            for scenario in SCENARIOS {
                let path = folder.join(format!("vgn_{scenario}.onnx"));
                let planner = path.display().to_string();
                entries.push(entry(RELEASED, Some(scenario), &planner, Some(&path))?);
            }
        }
        Ok(entries)
    }

    fn tasks(&self, entries: &[Entry], fingerprint: &str) -> Vec<Task> {
        let mut tasks = Vec::new();
        for entry in entries {
            for scenario in SCENARIOS {
                let crossed = entry.learnt.is_some_and(|learnt| learnt != scenario);
                let is_network = entry.learnt.is_some() || entry.method.ends_with(LEARNT_BOTH);
                let of_proposals = entry.planner.starts_with("shaf:");
                if crossed && of_proposals {
                    continue;
                }
                let mut add = |views: &str, epsilon, forced, seed, timed| {
                    let game = Game {
                        method: entry.method.clone(),
                        learnt: entry.learnt.map(str::to_owned),
                        scenario: scenario.to_owned(),
                        views: views.to_owned(),
                        epsilon,
                        forced,
                    };
                    let file = &entry.sha256;
                    let kind = entry.planner.split(':').next().filter(|_| !is_network || of_proposals);
                    let on =
                        (scenario, views, epsilon, forced, seed, if timed { self.timed } else { self.rounds }, timed);
                    let key = digest(&format!("{kind:?} {file:?} {on:?} {fingerprint}"));
                    tasks.push(Task { key, game, planner: entry.planner.clone(), seed, timed });
                };
                for (index, (views, _)) in VIEWS.into_iter().enumerate() {
                    let seeds = if index == 0 { self.seeds } else { self.seeds.min(SEEDS_ELSEWHERE) };
                    if index == 0 || is_network && !of_proposals && !crossed {
                        (self.seed..self.seed + seeds).for_each(|seed| add(views, EPSILON, true, seed, false));
                    }
                }
                if is_network && !of_proposals && !crossed {
                    let seeds = self.seed..self.seed + self.seeds.min(SEEDS_ELSEWHERE);
                    for epsilon in EPSILONS {
                        seeds.clone().for_each(|seed| add(VIEWS[0].0, epsilon, false, seed, false));
                    }
                }
                if !crossed {
                    add(VIEWS[0].0, EPSILON, true, self.seed, true);
                }
            }
        }
        tasks
    }

    fn effort(&self, task: &Task) -> u64 {
        if task.timed { self.timed } else { self.rounds }
    }

    fn benchmark(&self, game: &Game, seed: u64) -> anyhow::Result<Benchmark> {
        let scene = if game.scenario == "pile" { Scene::Pile } else { Scene::Packed };
        Ok(Benchmark {
            kind: scene.kind(),
            objects: scene.objects("test")?,
            count: 5,
            views: parse_views(&game.views).context("views of a table")?,
            noise: 1.0,
            rounds: self.rounds,
            seed,
        })
    }

    fn play(&self, task: &Task, progress: &ProgressBar) -> anyhow::Result<Played> {
        let benchmark = self.benchmark(&task.game, task.seed)?;
        let (params, planner) = (params(&task.game), PlannerSpec::from(task.planner.as_str()));
        let (mut summary, mut milliseconds) = (None, None);
        if task.timed {
            let mut planner = planner.build(&params, &Options::default())?;
            let mut times = Vec::new();
            // The first is for warming up.
            for number in 0..=self.timed {
                let (world, mut rng) = benchmark.scene(number);
                let Some(observation) = benchmark.observe(&world, &mut rng) else { continue };
                let start = Instant::now();
                planner.plan(&observation, &mut rng)?;
                times.push(start.elapsed().as_secs_f64() * 1e3);
                progress.inc(u64::from(number > 0));
            }
            milliseconds = Spread::of(times.get(1..).unwrap_or_default());
        } else {
            let rounds = benchmark.run(&planner, &params, &Options::default(), |event| {
                if let Event::Round = event {
                    progress.inc(1);
                }
            })?;
            summary = Some(Summary::of(&rounds));
        }
        Ok(Played { key: task.key.clone(), game: task.game.clone(), seed: task.seed, summary, milliseconds })
    }

    fn results(&self, entries: &[Entry], tasks: &[Task], log: &Log) -> anyhow::Result<Results> {
        let mut results = Results::default();
        for played in tasks.iter().filter_map(|task| log.played.get(&task.key)) {
            if let Some(summary) = &played.summary {
                results.games.entry(played.game.clone()).or_default().push(summary.clone());
            }
            if let Some(milliseconds) = played.milliseconds {
                results.times.insert((played.game.method.clone(), played.game.scenario.clone()), milliseconds);
            }
        }
        for entry in entries.iter().filter(|entry| entry.method != RELEASED) {
            let path = Path::new(&entry.planner);
            let Some(name) = path.file_name().filter(|_| entry.sha256.is_some() && !entry.planner.contains(':')) else {
                continue;
            };
            let metadata = Metadata::of(&ModelProto::read(path)?, path)?;
            let noted = |key: &str| metadata.provenance.get(key).map_or_else(|| "?".to_owned(), |n| thousands(n));
            results.data.insert(name.to_string_lossy().into_owned(), (noted("scenes"), noted("grasps")));
        }
        for (scenario, scene) in SCENARIOS.into_iter().zip([Scene::Packed, Scene::Pile]) {
            results.test_objects.insert(scenario.to_owned(), scene.objects("test")?.listed().len());
        }
        Ok(results)
    }

    fn head(&self, fingerprint: &str) -> String {
        format!(
            "# The paper's tables, here and there\n\n\
             *6-DoF Robotic Grasping with Transformer*, Tables 1–4, beside what `make tables` measured: {} scenes of five unseen\n\
             procedural objects for each of {} seeds from {} (other cameras and ε than the paper's: {} seeds), noisy depth from\n\
             one side view, ε = 0.9, `force` down to 0.5, the best grasp first, out_th 0.1. GSR is the share of the grasps that\n\
             lifted an object, DR that of the objects cleared away; mean ± standard deviation over the seeds. VGN-R are VGN's\n\
             released weights; the paper states its times for an RTX 3090, here it is {} with {} cores,\n\
             ONNX Runtime's CPU provider, one observation after another. Simulator and decoding {}.\n\n",
            self.rounds,
            self.seeds,
            self.seed,
            self.seeds.min(SEEDS_ELSEWHERE),
            processor(),
            std::thread::available_parallelism().map_or(1, |n| n.get()),
            &fingerprint[..12],
        )
    }
}

/// Between a network's output and the grasps, in a game.
fn params(game: &Game) -> DecodeParams {
    let benchmark = DecodeParams::benchmark();
    let force = benchmark.force.filter(|_| game.forced);
    DecodeParams { threshold: f32::from(game.epsilon) / 100.0, force, ..benchmark }
}

/// What was played, in a file.
struct Log {
    path: PathBuf,
    file: File,
    played: BTreeMap<String, Played>,
}

impl Log {
    fn open(path: &Path) -> anyhow::Result<Self> {
        let context = || path.display().to_string();
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).with_context(context)?;
        }
        let mut played = BTreeMap::new();
        if path.exists() {
            for line in BufReader::new(File::open(path).with_context(context)?).lines() {
                // What a killed run left half written is played again.
                if let Ok(line) = serde_json::from_str::<Played>(&line.with_context(context)?) {
                    played.insert(line.key.clone(), line);
                }
            }
        }
        let file = OpenOptions::new().append(true).create(true).open(path).with_context(context)?;
        Ok(Self { path: path.to_owned(), file, played })
    }

    fn append(&mut self, played: Played) -> anyhow::Result<()> {
        // After a half-written line a new one begins.
        let line = format!("\n{}\n", serde_json::to_string(&played)?);
        self.file.write_all(line.as_bytes()).with_context(|| self.path.display().to_string())?;
        self.played.insert(played.key.clone(), played);
        Ok(())
    }

    /// Drops what no table needs any more, and puts the rest in the order of the tables.
    fn keep(&mut self, tasks: &[Task]) -> anyhow::Result<()> {
        let context = || self.path.display().to_string();
        let lines = tasks.iter().filter_map(|task| self.played.get(&task.key));
        let text = lines.map(|line| Ok(serde_json::to_string(line)? + "\n")).collect::<anyhow::Result<String>>()?;
        let partial = self.path.with_extension("jsonl.partial");
        fs::write(&partial, text).with_context(context)?;
        fs::rename(&partial, &self.path).with_context(context)
    }
}

/// Changes when the simulator does: a hash of two labelled scenes.
fn simulator() -> String {
    let scenes = [Scene::Pile, Scene::Packed].map(|scene| {
        let recipe = Recipe {
            kind: scene.kind(),
            objects: ObjectSet::procedural(Split::PileTest),
            points: 10,
            views: parse_views(VIEWS[0].0).expect("the paper's view is one"),
            looks: 1,
            noise: 1.0,
            seed: 1,
        };
        recipe.label(1)
    });
    digest(&format!("{scenes:?}"))
}

/// Changes when decoding does: a hash of what is found in a volume and maps by chance.
fn decoding() -> String {
    /// The edge of a block in which quality is the same: smoothing must leave something to be found.
    const BLOCK: usize = 8;
    let blocks = RESOLUTION / BLOCK;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut draw = |count: usize| (0..count).map(|_| rng.random()).collect::<Vec<f32>>();
    let (coarse, values) = (draw(blocks.pow(3)), draw(RESOLUTION.pow(3)));
    let width: Vec<f32> = draw(RESOLUTION.pow(3)).iter().map(|width| 10.0 * width).collect();
    let block =
        |i: usize| [i / (RESOLUTION * RESOLUTION), i / RESOLUTION % RESOLUTION, i % RESOLUTION].map(|c| c / BLOCK);
    let quality: Vec<f32> =
        (0..RESOLUTION.pow(3)).map(block).map(|[x, y, z]| coarse[(x * blocks + y) * blocks + z]).collect();
    let rotation = [[0.5; RESOLUTION.pow(3)]; 4].concat();
    let maps = Maps { quality: &quality, rotation: &rotation, width: &width };
    let voxel_size = WORKSPACE_SIZE / RESOLUTION as f64;
    let volume = Volume::new(RESOLUTION, voxel_size, Isometry3::identity(), values).expect("values in [0, 1]");
    let game = |forced| Game {
        method: String::new(),
        learnt: None,
        scenario: String::new(),
        views: String::new(),
        epsilon: EPSILON,
        forced,
    };
    let found = [true, false].map(|forced| {
        let decoded = decode(&volume, &maps, &params(&game(forced))).expect("maps of the volume's size");
        decoded.grasps
    });
    digest(&format!("{found:?}"))
}

fn digest(text: &str) -> String {
    Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn hash(path: &Path) -> std::io::Result<String> {
    Ok(Sha256::digest(fs::read(path)?).iter().map(|byte| format!("{byte:02x}")).collect())
}

fn thousands(number: &str) -> String {
    let mut text = number.to_owned();
    (1..number.len())
        .rev()
        .filter(|place| (number.len() - place).is_multiple_of(3))
        .for_each(|place| text.insert(place, ','));
    text
}

fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    name.map_or_else(|| "an unnamed processor".to_owned(), |(_, name)| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thousands_are_separated() {
        assert_eq!(["7", "303", "16640", "1564546"].map(thousands), ["7", "303", "16,640", "1,564,546"]);
    }
}
