use std::path::PathBuf;

use clap::Args;
use grasp_sim::dataset::{DatasetWriter, Setup};
use grasp_sim::label::Recipe;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;

use super::{Scene, SceneArgs};

/// What scenes are made of unless the command says otherwise.
const OBJECTS: &str = "train";

/// The same seed gives the same data on any number of threads; a run that was cut off goes on where it stopped.
#[derive(Args)]
pub struct Label {
    #[command(flatten)]
    scene: SceneArgs,

    /// How many scenes.
    #[arg(long)]
    scenes: u64,

    /// Grasp points a scene, each tried at six yaws.
    #[arg(long, default_value_t = 120)]
    points: usize,

    /// Folder to write into.
    #[arg(long)]
    out: PathBuf,
}

impl Label {
    pub fn run(self) -> anyhow::Result<()> {
        let recipe = Recipe {
            kind: self.scene.kind(),
            objects: self.scene.objects(OBJECTS)?,
            points: self.points,
            views: self.scene.views()?,
            noise: !self.scene.no_noise,
            seed: self.scene.seed,
        };
        let setup = Setup {
            scene: match self.scene.scene {
                Scene::Pile => "pile",
                Scene::Packed => "packed",
            }
            .to_owned(),
            objects: self.scene.objects.unwrap_or_else(|| OBJECTS.to_owned()),
            points: recipe.points,
            views: self.scene.views,
            noise: recipe.noise,
            seed: recipe.seed,
        };
        let mut writer = DatasetWriter::open(&self.out, &setup)?;

        let style = "{wide_bar} {pos}/{len} scenes, {per_sec}, {eta} left";
        let progress = ProgressBar::new(self.scenes).with_style(ProgressStyle::with_template(style)?);
        progress.set_position(writer.next());
        progress.reset_eta();
        // Scenes are made in parallel and written in order; a batch is long enough to keep every thread busy.
        let batch = 16 * rayon::current_num_threads() as u64;
        while writer.next() < self.scenes {
            let numbers = writer.next()..self.scenes.min(writer.next() + batch);
            let labelled: Vec<_> = numbers
                .clone()
                .into_par_iter()
                .map(|number| {
                    let scene = recipe.label(number);
                    progress.inc(1);
                    scene
                })
                .collect();
            for (number, scene) in numbers.zip(labelled) {
                match scene {
                    Some(scene) => writer.append(number, &scene)?,
                    None => writer.skip(number),
                }
            }
        }
        progress.finish();
        Ok(())
    }
}
