use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use grasp_data::Candidates as Tried;
use grasp_sim::ordered;

use super::data::DataArgs;
use super::progress;

/// Writes the training data of `grasp-train classify`: an .npz with `images`, `labels` and `scenes`. The same seed
/// gives the same file on any number of threads.
#[derive(Args)]
pub struct Candidates {
    #[command(flatten)]
    data: DataArgs,

    /// Number of scenes. All images are kept in memory: 43 kB per candidate.
    #[arg(long)]
    scenes: u64,

    /// Maximum number of randomly drawn candidates per scene.
    #[arg(long, default_value_t = 50)]
    candidates: usize,

    /// Output file, .npz.
    #[arg(long)]
    out: PathBuf,
}

impl Candidates {
    pub fn run(self) -> anyhow::Result<()> {
        let config = self.data.config(self.candidates, 1)?;
        if let Some(folder) = self.out.parent() {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let progress = progress::of_scenes(self.scenes)?;
        let mut tried = Tried::default();
        ordered::for_each(
            0..self.scenes,
            |number| config.candidates(number),
            |_, candidates| {
                tried.append(candidates);
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        eprintln!("{} candidates tried, {} of them successes", tried.len(), tried.successes());
        Ok(tried.write(&self.out)?)
    }
}
