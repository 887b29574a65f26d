use std::path::PathBuf;

use clap::Args;
use grasp_data::packed;

/// All must come from the same `label` command but for the scenes' numbers, `--first` and `--scenes`.
#[derive(Args)]
pub struct Merge {
    /// Folders with a range of scenes each, packed.
    #[arg(required = true, num_args = 1..)]
    folders: Vec<PathBuf>,

    /// Folder to write into.
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
