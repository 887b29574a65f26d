//! The command line of graspd.

mod file;
mod show;

use std::fs;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::{Args, Parser, Subcommand};
use grasp_client::{
    Access, Arrivals, Asked, Certificate, Client, Health, Identity, Options, Retry, Token, Until, load,
};
use tonic::Code;

/// Asks a graspd for grasps.
#[derive(Parser)]
#[command(name = "grasp", version, max_term_width = 100)]
struct Cli {
    /// Where the server is.
    #[arg(long, global = true, env = "GRASPD_SERVER", value_name = "ADDR", default_value = "127.0.0.1:50051")]
    server: String,

    #[command(flatten)]
    access: AccessArgs,

    /// Print JSON instead of tables.
    #[arg(long, global = true)]
    json: bool,

    #[command(subcommand)]
    command: Command,
}

#[derive(Args)]
struct AccessArgs {
    /// CA that signed the server's certificate, PEM. By default those that this machine trusts, with https:// addresses.
    #[arg(long, global = true, env = "GRASPD_TLS_CA", value_name = "FILE")]
    tls_ca: Option<PathBuf>,

    /// Certificate to show to a server that wants one, PEM.
    #[arg(long, global = true, value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,

    /// Its private key, PEM.
    #[arg(long, global = true, value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,

    /// File that holds the token that the server wants.
    #[arg(long, global = true, env = "GRASPD_TOKEN_FILE", value_name = "FILE")]
    token_file: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Command {
    /// Finds the grasps in a volume.
    Detect(Detect),
    /// Asks for the grasps in a volume many times, and says how long that took.
    Bench(Bench),
    /// Lists the models that are loaded.
    Models,
    /// Says whether the server is ready; the exit status is 1 when it is not.
    Health,
}

#[derive(Args)]
struct Volume {
    /// A .npy file, or a .npz file with one array or one called `grid`: N×N×N values in [0, 1] (u8: 0 to 255), indexed
    /// x, y, z, 0.5 on the surface and 0 where nothing was observed.
    file: PathBuf,

    /// Edge of a voxel, metres. By default that of a cube of 0.3 m.
    #[arg(long, value_name = "METRES")]
    voxel_size: Option<f64>,

    /// Which model answers. By default the server chooses.
    #[arg(long, default_value = "", hide_default_value = true)]
    model: String,

    /// Which version of it. By default the newest.
    #[arg(long, default_value = "", hide_default_value = true)]
    version: String,
}

#[derive(Args)]
struct Detect {
    #[command(flatten)]
    volume: Volume,

    /// Smallest quality of a grasp, above 0 and at most 1. By default the model's own.
    #[arg(long)]
    threshold: Option<f32>,

    /// At most this many grasps, the best. 0 for all.
    #[arg(long, default_value_t = 0)]
    max_grasps: u32,

    /// Also say why the other voxels hold no grasp.
    #[arg(long)]
    explain: bool,
}

#[derive(Args)]
struct Bench {
    #[command(flatten)]
    volume: Volume,

    /// How many ask at the same time, each again as soon as there is an answer.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..), conflicts_with = "rate")]
    callers: u16,

    /// Requests a second, at moments left to chance, however long the answers take.
    #[arg(long, value_name = "PER_SECOND", value_parser = positive)]
    rate: Option<f64>,

    /// For how long, seconds.
    #[arg(long, default_value_t = 10.0, value_parser = positive)]
    seconds: f64,
}

fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| *number > 0.0 && *number <= 1e6);
    number.ok_or_else(|| "must be a number above 0 and at most a million".to_owned())
}

impl AccessArgs {
    fn read(&self) -> anyhow::Result<Access> {
        let file = |path: &Option<PathBuf>| match path {
            Some(path) => fs::read(path).map(Some).with_context(|| format!("cannot read {}", path.display())),
            None => Ok(None),
        };
        let token =
            |bytes: Vec<u8>| String::from_utf8_lossy(&bytes).lines().next().unwrap_or_default().parse::<Token>();
        Ok(Access {
            ca: file(&self.tls_ca)?.map(Certificate::from_pem),
            identity: file(&self.tls_cert)?.zip(file(&self.tls_key)?).map(|(cert, key)| Identity::from_pem(cert, key)),
            token: file(&self.token_file)?.map(token).transpose().map_err(|fault| anyhow!("--token-file: {fault}"))?,
            retry: Retry::RECOMMENDED,
        })
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    match run(Cli::parse()).await {
        Ok(code) => code,
        Err(error) => {
            eprintln!("grasp: {error:#}");
            ExitCode::FAILURE
        }
    }
}

async fn run(Cli { server, access, json, command }: Cli) -> anyhow::Result<ExitCode> {
    match command {
        Command::Detect(args) => {
            // The file first: a mistake in it needs no server to be found.
            let Detect { volume: Volume { file, voxel_size, model, version }, .. } = args;
            let volume = file::read(&file, voxel_size)?;
            let (threshold, max_grasps, explain) = (args.threshold, args.max_grasps, args.explain);
            let asked = Asked { model, version, threshold, max_grasps, explain, ..Asked::default() };
            let options = Options { asked, ..Options::default() };
            let detection = Client::connect_with(server, access.read()?).await?.detect(&volume, options).await?;
            println!("{}", if json { show::detection_json(&detection) } else { show::detection(&detection) });
        }
        Command::Bench(Bench { volume: Volume { file, voxel_size, model, version }, callers, rate, seconds }) => {
            let volume = Arc::new(file::read(&file, voxel_size)?);
            let asked = Asked { model, version, ..Asked::default() };
            let options = Options { asked, ..Options::default() };
            // What is refused is to be seen, not to be tried again.
            let access = Access { retry: Retry::NONE, ..access.read()? };
            let client = Client::connect_with(server, access).await?;
            // A mistake in the request is told at once, as the error that it is.
            client.detect(&volume, options.clone()).await?;
            let arrivals = rate.map_or(Arrivals::Callers(callers.into()), Arrivals::Rate);
            let until = Until::Elapsed(Duration::from_secs_f64(seconds));
            let report = load(arrivals, until, move |_| {
                let (client, volume, options) = (client.clone(), Arc::clone(&volume), options.clone());
                async move {
                    let detection = client.detect(&volume, options).await;
                    detection.map(drop).map_err(|error| error.code().unwrap_or(Code::Unknown))
                }
            });
            let report = report.await;
            println!("{}", if json { show::report_json(&report) } else { show::report(&report) });
        }
        Command::Models => {
            let models = Client::connect_with(server, access.read()?).await?.list_models().await?;
            println!("{}", if json { show::models_json(&models) } else { show::models(&models) });
        }
        Command::Health => {
            let serving = Client::connect_with(server, access.read()?).await?.health().await? == Health::Serving;
            println!("{}", if json { show::health_json(serving) } else { show::health(serving) });
            if !serving {
                return Ok(ExitCode::FAILURE);
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}
