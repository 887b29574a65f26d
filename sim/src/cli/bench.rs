use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, anyhow, bail};
use clap::Args;
use grasp::{Clearance, DecodeParams, FINGER_DEPTH, Grasp};
use grasp_models::{Choice, Options, Precision, Provider};
use grasp_picture::{Picture, quality_color, save_sheet};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::{Benchmark, Event};
use grasp_sim::planner::PlannerSpec;
use grasp_sim::score::{OfRoom, Spread, Summary, wilson};
use indicatif::ProgressBar;
use serde_json::{Value, json};

use super::{SceneArgs, parse_quality, parse_share, show};

/// The scenes depend only on the seed, so that all planners are evaluated on the same scenes.
#[derive(Args)]
pub struct Bench {
    /// Planner; can be repeated: a model that comes with graspd (`vgn-refined`, `vgn-packed`, `gpd`, `shaf`); the path of an
    /// .onnx network; `EVALUATOR.onnx:NETWORK.onnx` (a network and the evaluator of its grasps); `grpc:ADDRESS` (a
    /// running graspd); `shaf:FILE` (the highest of a network's proposals with a quality above 0.5); `gpd:FILE`
    /// (candidates scored by a classifier of `grasp-train classify`); `random`. `grpc` uses only --threshold and --force
    /// of the options of decoding, `shaf:FILE` only --out-th, --no-border and --clear; `random`, `shaf` and `gpd` use none.
    #[arg(long = "planner", required = true, value_name = "MODEL|FILE")]
    planners: Vec<String>,

    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    decoding: DecodingArgs,

    /// Rounds (scenes) per seed.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    rounds: u64,

    /// Number of seeds, starting with --seed. The papers use 5.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,

    /// Initial number of objects per scene.
    #[arg(long, default_value_t = 5)]
    count: usize,

    /// Execution provider of the networks: cpu, openvino, cuda, tensorrt, or auto (the fastest available).
    #[arg(long, default_value = "cpu")]
    provider: Choice<Provider>,

    /// Number format of the networks: fp32, bf16, fp16, int8, or auto.
    #[arg(long, default_value = "auto")]
    precision: Choice<Precision>,

    /// Print a JSON object per planner instead of a Markdown table.
    #[arg(long)]
    json: bool,

    /// Also write every attempt to this file, as JSON lines: the grasp, the nearest object and the outcome.
    #[arg(long)]
    attempts: Option<PathBuf>,

    /// Also draw every attempt into this folder: the scene, the proposals and the hand, green for a success and red for
    /// a failure.
    #[arg(long)]
    pictures: Option<PathBuf>,

    /// Also draw the first six failures of the last planner into this file and print their outcomes.
    #[arg(long)]
    failures: Option<PathBuf>,
}

/// Decoding of a network's output; the defaults are those of GIGA's evaluation. A running graspd uses only the
/// threshold and `force`.
#[derive(Args)]
struct DecodingArgs {
    /// Smallest quality of a grasp (ε).
    #[arg(long, default_value_t = 0.9, value_parser = parse_quality)]
    threshold: f32,

    /// If no grasp reaches the threshold, execute the best grasp if its quality is at least this; `none` disables this.
    #[arg(long, default_value = "0.5", value_parser = parse_force)]
    force: Force,

    /// Values above this count as in front of a surface when grasps are decoded (out_th).
    #[arg(long, default_value_t = 0.1, value_parser = parse_out_th)]
    out_th: f32,

    /// Keep grasps at the borders of the volume.
    #[arg(long)]
    no_border: bool,

    /// Drop grasps whose open hand would collide with the observed surface.
    #[arg(long)]
    clear: bool,
}

#[derive(Clone, Copy)]
struct Force(Option<f32>);

fn parse_force(text: &str) -> Result<Force, String> {
    match text {
        "none" => Ok(Force(None)),
        quality => match parse_quality(quality) {
            Ok(floor) => Ok(Force(Some(floor))),
            Err(expected) => Err(format!("{expected}, or `none`")),
        },
    }
}

fn parse_out_th(text: &str) -> Result<f32, String> {
    parse_share(text).map(|value| value as f32)
}

impl fmt::Display for DecodingArgs {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { threshold, force, out_th, no_border, clear } = self;
        write!(f, "ε {threshold}, ")?;
        match force.0 {
            Some(floor) => write!(f, "or the best grasp if its quality is at least {floor}, ")?,
            None => f.write_str("no force, ")?,
        }
        write!(f, "out_th {out_th}")?;
        f.write_str(if *no_border { ", with borders" } else { "" })?;
        f.write_str(if *clear { ", collision check" } else { "" })
    }
}

impl DecodingArgs {
    fn params(&self) -> DecodeParams {
        let benchmark = DecodeParams::benchmark();
        DecodeParams {
            threshold: self.threshold,
            force: self.force.0,
            outside_above: self.out_th,
            clearance: self.clear.then(Clearance::default),
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
            noise: self.scene.noise(),
            rounds: self.rounds,
            seed: self.scene.seed,
        };
        let setup = format!(
            "{}, objects {}{}, views {}, noise {} ({}){}, {} {} per scene, {} {}, seed {}",
            self.scene.scene.name(),
            self.scene.objects.as_deref().unwrap_or("test"),
            self.scene.part.suffix(),
            self.scene.views,
            benchmark.noise.share,
            self.scene.sensor.name(),
            if benchmark.noise.is_scale_corrected { ", scale corrected" } else { "" },
            benchmark.count,
            if benchmark.count == 1 { "object" } else { "objects" },
            benchmark.rounds,
            if benchmark.rounds == 1 { "round" } else { "rounds" },
            benchmark.seed
        );
        let planners: Vec<(&String, PlannerSpec)> = self
            .planners
            .iter()
            .map(|name| Ok((name, name.parse().map_err(|reason: String| anyhow!("--planner: {reason}"))?)))
            .collect::<anyhow::Result<_>>()?;
        let watcher = Watcher::new(&self)?;
        let params = self.decoding.params();
        let options = Options { provider: self.provider.0, precision: self.precision.0, ..Options::default() };
        let is_stopped = stopped_by_ctrl_c()?;
        let mut rooms = Vec::new();
        for (index, (name, planner)) in planners.into_iter().enumerate() {
            let progress = ProgressBar::new(self.rounds * self.seeds).with_message(name.clone());
            let mut conditions = Vec::new();
            for seed in benchmark.seed..benchmark.seed + self.seeds {
                let benchmark = Benchmark { seed, ..benchmark.clone() };
                let rounds = benchmark.run(&planner, &params, &options, &is_stopped, |event| match event {
                    Event::Round => progress.inc(1),
                    Event::Attempt { .. } => watcher.attempt(name, seed, &event),
                });
                conditions.push(rounds.with_context(|| format!("planner `{name}`"))?);
                watcher.finish()?;
            }
            progress.finish_and_clear();
            let is_interrupted = is_stopped.load(Ordering::Relaxed);
            if is_interrupted {
                conditions.retain(|rounds| !rounds.is_empty());
            }
            let whole = Summary::new(&conditions.concat());
            let each: Vec<Summary> = conditions.iter().map(|rounds| Summary::new(rounds)).collect();
            let spread = |figure: fn(&Summary) -> f64| Spread::new(&each.iter().map(figure).collect::<Vec<_>>());
            let (gsr, dr) = (spread(|summary| summary.gsr), spread(|summary| summary.dr));
            if self.json {
                let mut line = serde_json::to_value(&whole)?;
                line["seeds"] = json!({ "gsr": gsr, "dr": dr });
                line["planner"] = name.as_str().into();
                line["decoding"] = decoding(&planner, &params);
                line["provider"] = format!("{} {}", self.provider, self.precision).into();
                line["setup"] = setup.as_str().into();
                println!("{line}");
            } else {
                // Before the first row, not before the first round: without a row there is no table.
                if index == 0 {
                    println!("{setup}, seeds: {}, networks with {}\n\n{MARKDOWN_HEAD}", self.seeds, self.decoding);
                }
                println!("{}", markdown(name, &whole, gsr, dr));
                rooms.push(format!("{name}: {}", of_rooms(&whole.by_room)));
            }
            // After the figures, so that an error does not lose them.
            if let Some(path) = &self.failures {
                watcher.draw_failures(path)?;
            }
            if is_interrupted {
                print_rooms(&rooms);
                bail!("interrupted: {} of {} rounds of `{name}`", whole.rounds, self.rounds * self.seeds);
            }
        }
        print_rooms(&rooms);
        Ok(())
    }
}

/// The successes by the room beside the fingers.
fn of_rooms(rooms: &[OfRoom; 4]) -> String {
    let names = ["no room", "up to 4 mm", "4 to 8 mm", "from 8 mm"];
    let share = |(name, OfRoom { attempts, successes }): (&str, &OfRoom)| format!("{name} {successes} of {attempts}");
    names.into_iter().zip(rooms).map(share).collect::<Vec<_>>().join(", ")
}

/// After the table, because a line between two rows would end it.
fn print_rooms(rooms: &[String]) {
    if !rooms.is_empty() {
        println!("\nlifted, by the room beside each finger of the open hand:\n");
        rooms.iter().for_each(|line| println!("- {line}"));
    }
}

/// A flag that Ctrl-C sets, so that the rounds that have ended are printed after the attempts in progress.
fn stopped_by_ctrl_c() -> anyhow::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    ctrlc::set_handler(move || set.store(true, Ordering::Relaxed)).context("cannot install the handler of Ctrl-C")?;
    Ok(flag)
}

/// The decoding parameters that a planner uses; null for random grasps.
fn decoding(planner: &PlannerSpec, params: &DecodeParams) -> Value {
    let Some(params) = planner.decode_params(params) else { return Value::Null };
    let DecodeParams { threshold, force, outside_above, border, clearance, .. } = params;
    if let PlannerSpec::Server(_) = planner {
        return json!({ "threshold": threshold, "force": force });
    }
    json!({
        "threshold": threshold, "force": force, "out_th": outside_above, "no_border": border.is_none(),
        "clear": clearance.is_some(),
    })
}

const MARKDOWN_HEAD: &str = "\
| planner | GSR % | DR % | attempts | failed: blocked, empty, lost (stopped short) | \
rounds ended: cleared, unseen, no proposal, gave up | fusion ms, p50 / p95 | planning ms, p50 / p95 |
|---|---|---|---|---|---|---|---|";

/// A row of the table: mean ± standard deviation over the seeds, or with one seed the 95 % interval.
fn markdown(planner: &str, whole: &Summary, gsr: Option<Spread>, dr: Option<Spread>) -> String {
    let figure = |spread: Option<Spread>, all: usize| match spread {
        Some(spread @ Spread { std: Some(_), .. }) => spread.percent(),
        _ if all == 0 => "–".to_owned(),
        _ => {
            let [low, high] = wilson(whole.successes as u64, all as u64).map(|share| share * 100.0);
            format!("{:.1} ({low:.1}–{high:.1})", 100.0 * whole.successes as f64 / all as f64)
        }
    };
    let Summary { attempts, blocked_at_pregrasp, closed_on_nothing, lost_in_lift, stopped_short, .. } = whole;
    let Summary { cleared, nothing_seen, nothing_proposed, gave_up, .. } = whole;
    format!(
        "| {planner} | {} | {} | {attempts} | {blocked_at_pregrasp}, {closed_on_nothing}, {lost_in_lift} \
         ({stopped_short}) | {cleared}, {nothing_seen}, {nothing_proposed}, {gave_up} | {:.2} / {:.2} | {:.1} / {:.1} |",
        figure(gsr, whole.attempts),
        figure(dr, whole.objects),
        whole.fusion_p50_ms,
        whole.fusion_p95_ms,
        whole.planning_p50_ms,
        whole.planning_p95_ms,
    )
}

/// Records attempts as `--attempts`, `--pictures` and `--failures` specify.
struct Watcher<'a> {
    lines: Option<(&'a Path, Mutex<BufWriter<File>>)>,
    pictures: Option<&'a Path>,
    /// The first failures by seed, round and attempt: outcome and picture.
    failures: Option<Mutex<BTreeMap<Number, (&'static str, Picture)>>>,
    /// The first error while recording.
    error: Mutex<Option<anyhow::Error>>,
}

/// Seed, round and number of an attempt.
type Number = (u64, u64, usize);

/// Failures on a sheet, and per row.
const FAILURES: usize = 6;
const FAILURES_IN_A_ROW: usize = 3;

impl<'a> Watcher<'a> {
    fn new(bench: &'a Bench) -> anyhow::Result<Self> {
        let open = |path: &'a Path| {
            let file = File::create(path).with_context(|| path.display().to_string())?;
            anyhow::Ok((path, Mutex::new(BufWriter::new(file))))
        };
        let Bench { attempts, pictures, failures, .. } = bench;
        if let Some(folder) = pictures {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        if let Some(path) = failures {
            // Written after the rounds; a wrong path is an error before them.
            OpenOptions::new().append(true).create(true).open(path).with_context(|| path.display().to_string())?;
        }
        Ok(Self {
            lines: attempts.as_deref().map(open).transpose()?,
            pictures: pictures.as_deref(),
            failures: failures.as_ref().map(|_| Mutex::default()),
            error: Mutex::new(None),
        })
    }

    fn attempt(&self, planner: &str, seed: u64, event: &Event) {
        if let Err(error) = self.keep(planner, seed, event) {
            self.error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    }

    fn keep(&self, planner: &str, seed: u64, event: &Event) -> anyhow::Result<()> {
        let Event::Attempt { round, number, before, proposals, attempt } = event else { return Ok(()) };
        let outcome = attempt.outcome.name();
        if let Some((path, file)) = &self.lines {
            let Grasp { pose, width, quality } = attempt.grasp;
            let nearest = before.nearest(&pose.translation.vector.into());
            let object = nearest.map(|index| &before.objects()[index].object.name);
            let line = json!({
                "planner": planner, "seed": seed, "round": round, "attempt": number, "outcome": outcome,
                "object": object, "short_by": attempt.short_by, "position": pose.translation.vector.as_slice(),
                "quaternion_xyzw": pose.rotation.coords.as_slice(), "width": width, "quality": quality,
                "proposals": proposals.len(), "objects": before.objects().len(),
                "room": attempt.room,
            });
            let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
            writeln!(file, "{line}").with_context(|| path.display().to_string())?;
        }
        let picture = || {
            let color = if attempt.outcome.is_success() { quality_color(1.0) } else { quality_color(0.0) };
            let mut picture = Picture::of_workspace(480, 360, TABLE_HEIGHT);
            show(&mut picture, before).hand(&attempt.grasp.pose, attempt.grasp.width, color);
            for grasp in proposals.iter().skip(1) {
                picture.gripper(&grasp.pose, grasp.width, FINGER_DEPTH, quality_color(f64::from(grasp.quality)));
            }
            picture
        };
        if let Some(folder) = self.pictures {
            let planner: String = planner.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
            let name = format!("{planner}-{seed}-{round:04}-{number:02}-{outcome}.png");
            picture().save(&folder.join(name))?;
        }
        if let Some(failures) = self.failures.as_ref().filter(|_| !attempt.outcome.is_success()) {
            // Rounds run in parallel. Sorting by number makes the choice the same in every run.
            let mut failures = failures.lock().unwrap_or_else(PoisonError::into_inner);
            failures.insert((seed, *round, *number), (outcome, picture()));
            if failures.len() > FAILURES {
                failures.pop_last();
            }
        }
        Ok(())
    }

    /// Draws the failures of a planner on a sheet.
    fn draw_failures(&self, path: &Path) -> anyhow::Result<()> {
        let Some(failures) = &self.failures else { return Ok(()) };
        let failures = std::mem::take(&mut *failures.lock().unwrap_or_else(PoisonError::into_inner));
        let pictures: Vec<&Picture> = failures.values().map(|(_, picture)| picture).collect();
        save_sheet(path, &pictures, FAILURES_IN_A_ROW)?;
        if failures.is_empty() {
            eprintln!("{}: not written, because no attempt failed", path.display());
        }
        for ((seed, round, number), (outcome, _)) in &failures {
            eprintln!("{}: seed {seed}, round {round}, attempt {number}: {outcome}", path.display());
        }
        Ok(())
    }

    /// Returns the first error, and flushes the lines to disk.
    fn finish(&self) -> anyhow::Result<()> {
        if let Some(error) = self.error.lock().unwrap_or_else(PoisonError::into_inner).take() {
            return Err(error);
        }
        if let Some((path, file)) = &self.lines {
            let flushed = file.lock().unwrap_or_else(PoisonError::into_inner).flush();
            flushed.with_context(|| path.display().to_string())?;
        }
        Ok(())
    }
}
