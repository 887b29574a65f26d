use std::sync::{Arc, PoisonError, RwLock};

use grasp::Volume;
use grasp_proto::{FieldError, pb};

use crate::engine::Engine;
use crate::refusal::Refusal;

/// The models that are served now.
#[derive(Default)]
pub(crate) struct Models(RwLock<Engines>);

/// The default first, then by name, the newest version of a name before the older ones.
pub(crate) type Engines = Arc<[Arc<Engine>]>;

impl Models {
    /// What is served at this moment. Whoever holds it can still ask it, even if others are served meanwhile.
    pub fn now(&self) -> Engines {
        Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// From now on serves these.
    pub fn replace(&self, mut engines: Vec<Arc<Engine>>, default: Option<&str>) {
        // From the newest version to the oldest, as the sort by name is stable.
        engines.sort_by(|a, b| b.entry.by_version(&a.entry));
        engines.sort_by_key(|engine| {
            let name = engine.entry.metadata.name.clone();
            (default != Some(&name), name)
        });
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = engines.into();
    }

    /// The model that a request asks for, if it takes volumes of that resolution.
    pub fn select(&self, name: &str, version: &str, resolution: usize) -> Result<Arc<Engine>, Refusal> {
        let served = self.now();
        let fits = |engine: &&Arc<Engine>| engine.entry.metadata.resolution == resolution;
        if name.is_empty() {
            if !version.is_empty() {
                let needed = "which needs a `model` that it is a version of";
                return Err(FieldError::new("version", format_args!("`{version}`"), needed).into());
            }
            let taken =
                || describe(&served, |engine| format!("{} ({})", engine.entry.metadata.resolution, engine.label));
            let engine = served.iter().find(fits).cloned();
            return engine.ok_or_else(|| wrong_resolution(resolution, &taken()));
        }
        let is_named = |engine: &&Arc<Engine>| {
            let metadata = &engine.entry.metadata;
            metadata.name == name && (version.is_empty() || metadata.version == version)
        };
        let engine = served.iter().find(is_named).ok_or_else(|| Refusal::UnknownModel {
            wanted: format!("{name} {version}").trim_end().to_owned(),
            available: describe(&served, |engine| engine.label.clone()),
        })?;
        let taken = format!("{} ({})", engine.entry.metadata.resolution, engine.label);
        Some(engine).filter(fits).cloned().ok_or_else(|| wrong_resolution(resolution, &taken))
    }
}

fn describe(served: &[Arc<Engine>], engine: impl Fn(&Engine) -> String) -> String {
    served.iter().map(|served| engine(served)).collect::<Vec<_>>().join(", ")
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
        Self { models: models.now().iter().map(|engine| (&**engine).into()).collect() }
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
