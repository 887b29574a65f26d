//! `grasp-sim`: makes clutter, labels it, and benchmarks grasp planners on it.

mod cli;

use clap::Parser;

fn main() -> anyhow::Result<()> {
    cli::Command::parse().run()
}
