//! Command line client of graspd.

mod calibration;
mod camera;
mod cloud;
mod demo;
mod detect_args;
mod distortion;
mod document;
mod drawing;
mod export;
mod files;
mod image;
mod labels;
mod live;
mod messages;
mod notes;
mod numbers;
mod overlay;
mod pose;
mod record;
mod replay;
mod scene;
mod show;
mod table;
mod view;
mod volume;
mod watch;

use std::env;
use std::fs;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, anyhow, ensure};
use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand};
use clap_complete::{Shell, generate};
use grasp_client::{
    Access, Arrivals, Certificate, Client, DetectOptions, Detection, Health, Identity, Options, Retry, Token, Until,
    load,
};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use tonic::Code;

use crate::demo::Demo;
use crate::detect_args::DetectArgs;
use crate::pose::Poses;
use crate::replay::Replay;
use crate::scene::{Scene, SceneArgs};
use crate::table::Table;
use crate::view::ViewArgs;
use crate::watch::Watch;

/// Detects grasps with a graspd server.
#[derive(Parser)]
#[command(name = "grasp", version, max_term_width = 100)]
struct Cli {
    /// Address of the server.
    #[arg(long, global = true, env = "GRASP_SERVER", value_name = "ADDR", default_value = "127.0.0.1:50051")]
    server: String,

    #[command(flatten)]
    access: AccessArgs,

    /// Print JSON instead of tables.
    #[arg(long, global = true)]
    json: bool,

    #[command(subcommand)]
    command: Command,
}

/// Arguments whose variables had the prefix of the server until version 0.1, and these variables.
const FORMER_VARIABLES: [(&str, &str); 3] =
    [("server", "GRASPD_SERVER"), ("tls_ca", "GRASPD_TLS_CA"), ("token_file", "GRASPD_TOKEN_FILE")];

impl Cli {
    /// Reads the command line and the environment. The process ends on `--help` and on unknown arguments.
    fn from_args() -> Self {
        let mut command = Self::command();
        for (argument, former) in FORMER_VARIABLES {
            let variable = former.replacen("GRASPD", "GRASP", 1);
            if env::var_os(former).is_some() && env::var_os(&variable).is_none() {
                eprintln!("grasp: {former} is the former name of {variable}; set {variable} instead");
                command = command.mut_arg(argument, |given| given.env(former));
            }
        }
        Self::from_arg_matches(&command.get_matches()).unwrap_or_else(|error| error.exit())
    }
}

#[derive(Args)]
struct AccessArgs {
    /// CA that signed the server's certificate, PEM. Default for https:// addresses: the system's CAs.
    #[arg(long, global = true, help_heading = "Connection", env = "GRASP_TLS_CA", value_name = "FILE")]
    tls_ca: Option<PathBuf>,

    /// Client certificate for servers that require one, PEM.
    #[arg(long, global = true, help_heading = "Connection", value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,

    /// Private key of the client certificate, PEM.
    #[arg(long, global = true, help_heading = "Connection", value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,

    /// File with the bearer token, for servers that require one.
    #[arg(long, global = true, help_heading = "Connection", env = "GRASP_TOKEN_FILE", value_name = "FILE")]
    token_file: Option<PathBuf>,

    /// Time limit of each attempt of a request, seconds. It is sent to the server as the deadline.
    #[arg(
        long,
        global = true,
        help_heading = "Connection",
        value_name = "SECONDS",
        default_value_t = 10.0,
        value_parser = positive
    )]
    timeout: f64,
}

#[derive(Subcommand)]
enum Command {
    /// Detect grasps in a depth image that comes with the program. Starts a server for it if none runs.
    Demo(Demo),
    /// Detect grasps in a volume, depth images or point clouds.
    Detect(Detect),
    /// Detect grasps again whenever an input file changes.
    Watch(Watch),
    /// Find the table in a depth image or a point cloud, and the workspace over what stands on it. Needs no server.
    Table(Table),
    /// Score your own grasps: the predicted quality of each, and which of the options it violates.
    Score(Score),
    /// Draw the grasps, or record them for Foxglove and Rerun.
    View(View),
    /// Measure latency and throughput of the server with repeated requests.
    Bench(Bench),
    /// Send recorded requests again and compare the answers; exit status 1 if any has changed.
    Replay(Replay),
    /// List the models of the server.
    Models,
    /// Print whether the server is ready; exit status 1 if it is not.
    Health,
    /// Print the completions of a shell, for example: source <(grasp completions bash)
    Completions {
        /// The shell.
        shell: Shell,
    },
}

#[derive(Args)]
struct Detect {
    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    detect: DetectArgs,

    /// Also write the grasps as CSV.
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    csv: Option<PathBuf>,

    /// Also write the grasps as a list of moveit_msgs/Grasp, YAML.
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    moveit: Option<PathBuf>,

    /// Also write the grasps as isaac_grasp, YAML.
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    isaac: Option<PathBuf>,
}

#[derive(Args)]
struct Score {
    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    detect: DetectArgs,

    /// T_frame_grasp of each grasp, in the convention of --origin and --closing. Formats as for --camera-from-task, and
    /// the output of `grasp detect --json`. JSON objects may have a `width`, metres, which is checked too.
    #[arg(long, value_name = "FILE|NUMBERS", allow_hyphen_values = true)]
    grasps: Poses,
}

#[derive(Args)]
struct View {
    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    detect: DetectArgs,

    #[command(flatten)]
    view: ViewArgs,
}

#[derive(Args)]
struct Bench {
    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    detect: DetectArgs,

    /// Closed loop: number of callers, each with one request in flight.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..), conflicts_with = "rate")]
    callers: u16,

    /// Open loop: Poisson arrivals at this rate, requests per second, independent of the response times.
    #[arg(long, value_name = "PER_SECOND", value_parser = per_second)]
    rate: Option<f64>,

    /// Duration, seconds.
    #[arg(long, default_value_t = 10.0, value_parser = positive)]
    seconds: f64,
}

fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| *number > 0.0 && *number <= 1e6);
    number.ok_or_else(|| "must be a number greater than 0 and at most 1000000".to_owned())
}

/// A rate of the load generator, whose pauses must fit a `Duration`.
fn per_second(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| (1e-3..=1e6).contains(number));
    number.ok_or_else(|| "must be a number from 0.001 to 1000000".to_owned())
}

impl AccessArgs {
    fn read(&self) -> anyhow::Result<Access> {
        let file = |path: &Option<PathBuf>| match path {
            Some(path) => fs::read(path).map(Some).with_context(|| format!("cannot read {}", path.display())),
            None => Ok(None),
        };
        let pem = |flag: &str, path: &Option<PathBuf>, label: &str| {
            let bytes = file(path)?;
            let has_label = bytes.as_ref().is_none_or(|bytes| {
                String::from_utf8_lossy(bytes)
                    .lines()
                    .any(|line| line.starts_with("-----BEGIN") && line.contains(label))
            });
            let path = path.as_deref().unwrap_or(Path::new("")).display();
            ensure!(has_label, "{flag} {path} has no {} in PEM", label.to_lowercase());
            anyhow::Ok(bytes)
        };
        let token =
            |bytes: Vec<u8>| String::from_utf8_lossy(&bytes).lines().next().unwrap_or_default().parse::<Token>();
        Ok(Access {
            ca: pem("--tls-ca", &self.tls_ca, "CERTIFICATE")?.map(Certificate::from_pem),
            identity: pem("--tls-cert", &self.tls_cert, "CERTIFICATE")?
                .zip(pem("--tls-key", &self.tls_key, "PRIVATE KEY")?)
                .map(|(cert, key)| Identity::from_pem(cert, key)),
            token: file(&self.token_file)?
                .map(token)
                .transpose()
                .map_err(|reason| anyhow!("--token-file: {reason}"))?,
            retry: Retry::RECOMMENDED,
            timeout: Some(Duration::from_secs_f64(self.timeout)),
        })
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    let cli = Cli::from_args();
    let unit = cli.command.unit();
    match run(cli).await {
        Ok(code) => code,
        Err(error) => {
            eprintln!("grasp: {}", described(&error, unit));
            ExitCode::FAILURE
        }
    }
}

/// The flag with the unit of the observation, and its value if it is given.
#[derive(Clone, Copy)]
struct UnitFlag {
    flag: &'static str,
    given: Option<f64>,
}

impl Command {
    fn unit(&self) -> UnitFlag {
        let scene = match self {
            Self::Detect(Detect { scene, .. })
            | Self::Score(Score { scene, .. })
            | Self::View(View { scene, .. })
            | Self::Bench(Bench { scene, .. }) => scene,
            Self::Watch(watch) => watch.scene(),
            Self::Table(table) => return table.unit(),
            _ => return UnitFlag { flag: "--depth-scale", given: None },
        };
        scene.unit()
    }
}

/// Parts of errors whose remedy is the flag of the unit, and values for it.
const UNITS: [(&str, &str); 4] = [
    ("values look like millimetres", "0.001"),
    ("points look like millimetres", "0.001"),
    ("values look like metres", "1"),
    ("the depth unit", "with another unit, such as 0.0001 for tenths of a millimetre"),
];

/// An error with its causes, each once, and the flag that helps.
fn described(error: &anyhow::Error, UnitFlag { flag, given }: UnitFlag) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !text.contains(&cause) {
            text = if text.is_empty() { cause } else { format!("{text}: {cause}") };
        }
    }
    if text.contains("send the header `authorization") {
        return text + " (here: --token-file FILE)";
    }
    match (UNITS.iter().find(|(part, _)| text.contains(part)), given) {
        (Some(_), Some(given)) => format!("{text} (here: {flag} is {given})"),
        (Some((_, value)), None) => format!("{text} (here: {flag} {value})"),
        (None, _) => text,
    }
}

/// Reads the files, before the server is called.
fn read(scene: &SceneArgs, detect: &DetectArgs) -> anyhow::Result<(Scene, DetectOptions)> {
    let (scene, detect) = (scene.read()?, detect.read()?);
    scene.check_objects(&detect.objects)?;
    Ok((scene, detect))
}

fn options(scene: &SceneArgs, detect: DetectOptions) -> Options {
    Options { detect, frame_id: scene.frame_id(), stamp: Some(SystemTime::now()), ..Options::default() }
}

async fn run(Cli { server, access, json, command }: Cli) -> anyhow::Result<ExitCode> {
    let connect = async || anyhow::Ok(Client::connect_with(server.clone(), access.read()?).await?);
    let print = |detection: &Detection| {
        show::print(&if json { show::detection_json(detection) } else { show::detection(detection) })
    };
    match command {
        Command::Demo(demo) => demo.run(server, access.read()?, json).await?,
        Command::Detect(Detect { scene: args, detect, csv, moveit, isaac }) => {
            let (scene, detect) = read(&args, &detect)?;
            let opening = detect.gripper.as_ref().map_or(grasp::MAX_OPENING, |gripper| gripper.max_opening);
            let detection = scene.detect(&connect().await?, options(&args, detect)).await?;
            print(&detection)?;
            let write = |path: Option<PathBuf>, text: &dyn Fn(&Detection) -> String| match path {
                Some(path) => fs::write(&path, text(&detection)).with_context(|| path.display().to_string()),
                None => Ok(()),
            };
            write(csv, &export::csv)?;
            write(moveit, &export::moveit)?;
            write(isaac, &|detection| export::isaac(detection, opening))?;
        }
        Command::Watch(watch) => watch.run(connect, json).await?,
        Command::Score(Score { scene: args, detect, grasps }) => {
            let ((scene, detect), grasps) = (read(&args, &detect)?, grasps.candidates()?);
            let scores = scene.score(&connect().await?, &grasps, options(&args, detect)).await?;
            show::print(&if json { show::scores_json(&scores) } else { show::scores(&scores) })?;
        }
        Command::View(View { scene: args, detect, view }) => {
            let (scene, detect) = read(&args, &detect)?;
            // The drawing needs the finger base frame, so --origin and --closing do not apply.
            let detect = DetectOptions { convention: None, ..detect };
            view.check(&scene)?;
            let detection = scene.detect(&connect().await?, options(&args, detect.clone())).await?;
            let path = view.write(&scene, &detect, &detection)?;
            let grasps = detection.grasps.len();
            show::print(&if json {
                json!({ "grasps": grasps, "file": path }).to_string()
            } else {
                format!("{grasps} grasps in {}", path.display())
            })?;
        }
        Command::Bench(Bench { scene: args, detect, callers, rate, seconds }) => {
            let (scene, detect) = read(&args, &detect)?;
            let (scene, options) = (Arc::new(scene), options(&args, detect));
            // No retries: refusals are part of the result.
            let access = Access { retry: Retry::NONE, ..access.read()? };
            let client = Client::connect_with(server, access).await?;
            // An invalid request ends the benchmark with its error before the load starts.
            scene.detect(&client, options.clone()).await?;
            let arrivals = rate.map_or(Arrivals::Callers(callers.into()), Arrivals::Rate);
            let until = Until::Stopped(Duration::from_secs_f64(seconds), interrupted());
            let report = load(arrivals, until, move |_| {
                let (client, scene, options) = (client.clone(), Arc::clone(&scene), options.clone());
                async move {
                    let detection = scene.detect(&client, options).await;
                    detection.map(drop).map_err(|error| error.code().unwrap_or(Code::Unknown))
                }
            });
            let report = with_progress(seconds, !json, report).await;
            show::print(&if json { show::report_json(&report) } else { show::report(&report) })?;
        }
        Command::Table(table) => table.run(json)?,
        Command::Replay(replay) => {
            if !replay.run(&connect().await?, json).await? {
                return Ok(ExitCode::FAILURE);
            }
        }
        Command::Completions { shell } => {
            let mut script = Vec::new();
            generate(shell, &mut Cli::command(), "grasp", &mut script);
            show::print(String::from_utf8_lossy(&script).trim_end())?;
        }
        Command::Models => {
            let models = connect().await?.list_models().await?;
            show::print(&if json { show::models_json(&models) } else { show::models(&models) })?;
        }
        Command::Health => {
            let serving = connect().await?.health().await? == Health::Serving;
            show::print(&if json { show::health_json(serving) } else { show::health(serving) })?;
            if !serving {
                return Ok(ExitCode::FAILURE);
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// A flag that Ctrl-C sets, so that what was measured is printed after the calls in flight.
fn interrupted() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    tokio::spawn(async move {
        // An error means that Ctrl-C cannot be received; it then ends the process as usual.
        if tokio::signal::ctrl_c().await.is_ok() {
            set.store(true, Ordering::Relaxed);
        }
    });
    flag
}

/// Shows a progress bar during `work`, if `enabled` and stderr is a terminal.
async fn with_progress<T>(seconds: f64, enabled: bool, work: impl Future<Output = T>) -> T {
    if !enabled || !io::stderr().is_terminal() {
        return work.await;
    }
    let started = Instant::now();
    let bar = ProgressBar::new((seconds * 10.0) as u64).with_style(
        ProgressStyle::with_template("{wide_bar} {eta} left").unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let mut work = pin!(work);
    let mut tick = tokio::time::interval(Duration::from_millis(100));
    loop {
        tokio::select! {
            done = &mut work => {
                bar.finish_and_clear();
                return done;
            }
            _ = tick.tick() => bar.set_position((started.elapsed().as_secs_f64() * 10.0) as u64),
        }
    }
}
