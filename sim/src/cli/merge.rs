use std::path::PathBuf;

use clap::Args;
use grasp_data::packed;

/// All folders must come from the same `label` command, except for `--first` and `--scenes`.
#[derive(Args)]
pub struct Merge {
    /// Packed data sets, each with a range of scenes.
    #[arg(required = true, num_args = 1..)]
    folders: Vec<PathBuf>,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,
}

impl Merge {
    pub fn run(self) -> anyhow::Result<()> {
        let scenes = packed::merge(&self.folders, &self.out)?;
        println!("{scenes} scenes from {} folders in {}", self.folders.len(), self.out.display());
        Ok(())
    }
}
