//! `grasp-sim`: generates and labels scenes, and benchmarks grasp planners.

mod cli;

use clap::Parser;

fn main() -> anyhow::Result<()> {
    cli::Command::parse().run()
}
