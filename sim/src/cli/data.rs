use clap::Args;
use grasp_data::Provenance;
use grasp_sim::label::SceneConfig;

use super::SceneArgs;

/// Default of `--objects`.
const OBJECTS: &str = "train";

/// Scenes of a data set.
#[derive(Args)]
pub struct DataArgs {
    #[command(flatten)]
    pub scene: SceneArgs,

    /// Stretch each object at random along its three axes, by factors between 1/STRETCH and STRETCH: more shapes from
    /// few objects.
    #[arg(long, value_parser = parse_stretch)]
    pub stretch: Option<f64>,

    /// Resize each object, so that the distance between it and each finger of the open hand is uniform from 0 to
    /// CLEARANCE metres: many objects that hardly fit.
    #[arg(long, value_parser = parse_clearance)]
    pub clearance: Option<f64>,
}

impl DataArgs {
    /// The configuration of the scenes.
    pub fn config(&self, points: usize, observations: usize) -> anyhow::Result<SceneConfig> {
        let kind = self.scene.kind();
        Ok(SceneConfig {
            kind,
            objects: self
                .scene
                .objects(OBJECTS)?
                .stretched(self.stretch)
                .with_clearance(self.clearance, kind.mean_scale()),
            points,
            views: self.scene.views()?,
            observations,
            noise: self.scene.noise(),
            seed: self.scene.seed,
        })
    }

    /// The provenance of data with this configuration.
    pub fn provenance(&self, config: &SceneConfig) -> Provenance {
        Provenance {
            scene: self.scene.scene.name().to_owned(),
            objects: self.scene.objects.clone().unwrap_or_else(|| OBJECTS.to_owned()),
            part: self.scene.part.name().to_owned(),
            stretch: self.stretch,
            clearance: self.clearance,
            points: config.points,
            views: self.scene.views.clone(),
            observations: config.observations,
            noise: config.noise.share,
            sensor: self.scene.sensor.name().to_owned(),
            correct_depth_scale: config.noise.is_scale_corrected,
            seed: config.seed,
            observation_seed: None,
            network: None,
            evaluator: None,
            details: false,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

fn parse_stretch(text: &str) -> Result<f64, String> {
    let stretch = text.parse().ok().filter(|stretch| (1.0..=2.0).contains(stretch));
    stretch.ok_or_else(|| "must be from 1 to 2".to_owned())
}

fn parse_clearance(text: &str) -> Result<f64, String> {
    let clearance = text.parse().ok().filter(|clearance| (0.001..=0.035).contains(clearance));
    clearance.ok_or_else(|| "must be from 0.001 to 0.035 metres".to_owned())
}
