use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use grasp_data::packed::{Reader, Writer};
use grasp_data::{Occupancy, Provenance, Setup, quantise};
use grasp_sim::camera::DepthNoise;
use grasp_sim::label::SceneConfig;
use grasp_sim::ordered;

use super::{Part, Scene, Sensor, VIEWS, parse_share, parse_views, progress};

/// Much faster than labelling, because no grasp is tried. An interrupted run continues where it stopped.
#[derive(Args)]
pub struct Observe {
    /// Packed data set written by `label`.
    data: PathBuf,

    /// Cameras, as for `label`.
    #[arg(long)]
    views: String,

    /// Observations of each scene.
    #[arg(long, default_value_t = 1)]
    observations: usize,

    /// Share of the observations with depth noise.
    #[arg(long, default_value_t = 1.0, value_parser = parse_share)]
    noise: f64,

    /// Sensor whose depth noise is simulated.
    #[arg(long, value_enum, default_value = "dex")]
    sensor: Sensor,

    /// Correct the scale of the depths by the table, as for `label`.
    #[arg(long)]
    correct_depth_scale: bool,

    /// Seed of the views and the noise. The scenes stay the same.
    #[arg(long, default_value_t = 1)]
    seed: u64,

    /// Output folder.
    #[arg(long)]
    out: PathBuf,
}

impl Observe {
    pub fn run(self) -> anyhow::Result<()> {
        ensure!(self.observations > 0, "--observations is 0, must be greater than 0");
        let parse = |views: &str| parse_views(views).with_context(|| format!("--views is `{views}`: use {VIEWS}"));
        let views = parse(&self.views)?;
        let data = Reader::open(&self.data)?;
        ensure!(!data.is_empty(), "{} has no packed scenes; observe a data set of `label`", self.data.display());
        let mut scenes: Vec<usize> = (0..data.len()).collect();
        scenes.sort_by_key(|&index| data.number(index));

        let missing = || format!("{}: setup.json has no provenance; label the scenes again", self.data.display());
        let made = Setup::read(&self.data)?.provenance.with_context(missing)?;
        ensure!(
            made.network.is_none(),
            "{} holds the grasps of a network, which depend on the observation; observe a data set of `label`",
            self.data.display()
        );
        let scene = Scene::from_str(&made.scene, false).map_err(anyhow::Error::msg)?;
        let part = Part::from_str(&made.part, false).map_err(anyhow::Error::msg)?;
        let kind = scene.kind();
        let before = SceneConfig {
            kind,
            objects: part
                .of(scene.objects(&made.objects)?, &made.objects)?
                .stretched(made.stretch)
                .with_clearance(made.clearance, kind.mean_scale()),
            points: made.points,
            views: parse(&made.views)?,
            observations: made.observations,
            noise: DepthNoise {
                share: made.noise,
                sensor: Sensor::from_name(&made.sensor)?,
                is_scale_corrected: made.correct_depth_scale,
            },
            seed: made.seed,
        };
        if let Some(&first) = scenes.first() {
            let seen = before.observe_again(data.number(first), made.observation_seed.unwrap_or(made.seed));
            let same = seen.observations.first().is_some_and(|found| quantise(&found.volume) == data.volume(first, 0));
            ensure!(
                same,
                "{} was labelled with another simulator or version: its first scene differs; label the scenes again",
                self.data.display()
            );
        }

        let setup = Setup::benchmark(Provenance {
            views: self.views.clone(),
            observations: self.observations,
            noise: self.noise,
            sensor: self.sensor.name().to_owned(),
            correct_depth_scale: self.correct_depth_scale,
            observation_seed: Some(self.seed),
            ..made
        });
        let mut writer = Writer::open(&self.out, &setup)?;
        let next = writer.next().unwrap_or(0);
        let done = scenes.partition_point(|&index| data.number(index) < next);
        let progress = progress::of_scenes(scenes.len() as u64)?;
        progress.set_position(done as u64);
        progress.reset_eta();
        let noise =
            DepthNoise { share: self.noise, sensor: self.sensor.into(), is_scale_corrected: self.correct_depth_scale };
        let config = SceneConfig { views, observations: self.observations, noise, ..before };
        ordered::for_each(
            done as u64..scenes.len() as u64,
            // Drops the depth images, which are larger than the volumes.
            |place| -> (Vec<Vec<f32>>, Occupancy) {
                let seen = config.observe_again(data.number(scenes[place as usize]), self.seed);
                (seen.observations.into_iter().map(|observation| observation.volume).collect(), seen.occupancy)
            },
            |place, (volumes, occupancy)| {
                let index = scenes[place as usize];
                if !volumes.is_empty() {
                    writer.append(data.number(index), &volumes, &data.trials(index), Some(&occupancy))?;
                }
                progress.inc(1);
                anyhow::Ok(())
            },
        )?;
        progress.finish();
        Ok(())
    }
}
