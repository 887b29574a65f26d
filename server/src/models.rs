use grasp::Volume;
use grasp_models::Options;
use grasp_proto::{FieldError, pb};

use crate::config::Config;
use crate::engine::{Engine, Serving, Sessions};
use crate::metrics::Metrics;
use crate::refusal::Refusal;

/// Every model that is served: the default first, then by name, the newest version of a name before the older ones.
pub(crate) struct Models(Vec<Engine>);

impl Models {
    /// Loads what the store holds and starts `sessions`, which run until the models are dropped.
    pub fn load(config: &Config, metrics: &Metrics, sessions: &mut Sessions) -> anyhow::Result<Self> {
        let mut entries = config.store.entries().to_vec();
        // The store has the oldest version of a name first; the sort is stable.
        entries.reverse();
        entries.sort_by_key(|entry| {
            let name = entry.metadata.name.clone();
            (config.default_model.as_ref() != Some(&name), name)
        });
        let Config { workers, threads, provider, precision, queue, batching, .. } = *config;
        let options = Options { threads, provider, precision };
        let serving = Serving { workers, options, capacity: queue, batching };
        let engines =
            entries.into_iter().map(|entry| Engine::start(entry, &serving, |label| metrics.gauges(label), sessions));
        let models = Self(engines.collect::<Result<_, _>>()?);
        models.0.iter().for_each(|engine| metrics.loaded(&engine.label, engine.backend, &engine.entry.sha256));
        Ok(models)
    }

    /// The model that a request asks for, if it takes volumes of that resolution.
    pub fn select(&self, name: &str, version: &str, resolution: usize) -> Result<&Engine, Refusal> {
        let fits = |engine: &&Engine| engine.entry.metadata.resolution == resolution;
        if name.is_empty() {
            if !version.is_empty() {
                let needed = "which needs a `model` that it is a version of";
                return Err(FieldError::new("version", format_args!("`{version}`"), needed).into());
            }
            let taken = || self.describe(|engine| format!("{} ({})", engine.entry.metadata.resolution, engine.label));
            return self.0.iter().find(fits).ok_or_else(|| wrong_resolution(resolution, &taken()));
        }
        let is_named = |engine: &&Engine| {
            let metadata = &engine.entry.metadata;
            metadata.name == name && (version.is_empty() || metadata.version == version)
        };
        let engine = self.0.iter().find(is_named).ok_or_else(|| Refusal::UnknownModel {
            wanted: format!("{name} {version}").trim_end().to_owned(),
            available: self.describe(|engine| engine.label.clone()),
        })?;
        let taken = format!("{} ({})", engine.entry.metadata.resolution, engine.label);
        Some(engine).filter(fits).ok_or_else(|| wrong_resolution(resolution, &taken))
    }

    fn describe(&self, engine: impl Fn(&Engine) -> String) -> String {
        self.0.iter().map(engine).collect::<Vec<_>>().join(", ")
    }
}

/// A network trained for voxels of one size sees the world scaled when they have another.
pub(crate) fn check_voxel_size(volume: &Volume, engine: &Engine) -> Result<(), FieldError> {
    let (got, trained) = (volume.voxel_size(), engine.entry.metadata.voxel_size);
    if (got - trained).abs() <= 1e-3 * trained {
        return Ok(());
    }
    let needed = format_args!("the model {} takes {trained} m, to one in a thousand", engine.label);
    Err(FieldError::new("volume.voxel_size", got, needed))
}

fn wrong_resolution(resolution: usize, taken: &str) -> Refusal {
    FieldError::new("volume.resolution", resolution, format_args!("the models that could answer take {taken}")).into()
}

impl From<&Models> for pb::ListModelsResponse {
    fn from(models: &Models) -> Self {
        Self { models: models.0.iter().map(pb::Model::from).collect() }
    }
}

impl From<&Engine> for pb::Model {
    fn from(engine: &Engine) -> Self {
        let metadata = &engine.entry.metadata;
        Self {
            name: metadata.name.clone(),
            version: metadata.version.clone(),
            // A network larger than `Volume::MAX_RESOLUTION` could not have been warmed up.
            resolution: metadata.resolution as u32,
            voxel_size: metadata.voxel_size,
            threshold: metadata.decode_params().threshold,
            sha256: engine.entry.sha256.clone(),
            provider: engine.backend.provider.to_string(),
            precision: engine.backend.precision.to_string(),
            provenance: metadata.provenance.clone().into_iter().collect(),
        }
    }
}
