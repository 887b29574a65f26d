use std::sync::{Arc, PoisonError, RwLock};

use grasp::Volume;
use grasp_proto::{FieldError, on_a_line, pb};

use crate::serving::engine::Engine;
use crate::serving::refusal::Refusal;
use grasp_planner::Source;

/// The models of the model folder.
#[derive(Default)]
pub(crate) struct ModelRegistry {
    served: RwLock<Engines>,
    unavailable: RwLock<Vec<Unavailable>>,
}

/// A model of the folder that is not served.
#[derive(Clone)]
pub(crate) struct Unavailable {
    /// The file's name, if the file cannot be read.
    pub name: String,
    pub reason: String,
}

/// The default model first, then the other networks by name, then those with an evaluator, then the planners without a
/// network; per name the newest version first.
pub(crate) type Engines = Arc<[Arc<Engine>]>;

impl ModelRegistry {
    /// The models served now. Engines in the returned list remain usable after they are replaced.
    pub fn now(&self) -> Engines {
        Arc::clone(&self.served.read().unwrap_or_else(PoisonError::into_inner))
    }

    pub fn replace(&self, mut engines: Vec<Arc<Engine>>, default: Option<&str>) {
        // The sort by name is stable, so versions remain sorted. Only models with a network can be the default.
        engines.sort_by(|a, b| b.source.by_version(&a.source));
        engines.sort_by_key(|engine| {
            let name = engine.source.name().to_owned();
            let is_evaluated = matches!(engine.source, Source::Evaluated { .. });
            (engine.source.network().is_none(), default != Some(&name), is_evaluated, name)
        });
        *self.served.write().unwrap_or_else(PoisonError::into_inner) = engines.into();
    }

    /// The models that are not served.
    pub fn unavailable(&self) -> Vec<Unavailable> {
        self.unavailable.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub fn set_unavailable(&self, models: Vec<Unavailable>) {
        *self.unavailable.write().unwrap_or_else(PoisonError::into_inner) = models;
    }

    /// Selects the model that a request names, or the default. `resolution` is that of the request's volume, if it has
    /// one; the model must accept it.
    pub fn select(&self, name: &str, version: &str, resolution: Option<usize>) -> Result<Arc<Engine>, Refusal> {
        let served = self.now();
        let fits = |engine: &Arc<Engine>| match (engine.source.network(), resolution) {
            (Some(network), Some(resolution)) => network.metadata.resolution == resolution,
            (None, Some(resolution)) => resolution <= Source::MAX_RESOLUTION,
            (_, None) => true,
        };
        let accepted = |engine: &Engine| match engine.source.network() {
            Some(network) => format!("{} ({})", network.metadata.resolution, engine.label),
            None => format!("at most {} ({})", Source::MAX_RESOLUTION, engine.label),
        };
        let wrong = |accepted: &str| {
            let needed = format_args!("supported: {accepted}");
            Refusal::from(FieldError::new("volume.resolution", resolution.unwrap_or_default(), needed))
        };
        if name.is_empty() {
            if !version.is_empty() {
                let needed = "which requires options.model";
                return Err(FieldError::new("options.version", format_args!("`{version}`"), needed).into());
            }
            let networks: Vec<_> = served.iter().filter(|engine| engine.source.network().is_some()).collect();
            let engine = networks.iter().find(|engine| fits(engine)).map(|&engine| Arc::clone(engine));
            return engine.ok_or_else(|| wrong(&describe(&networks, accepted)));
        }
        let is_named = |engine: &&Arc<Engine>| {
            engine.source.name() == name && (version.is_empty() || engine.source.version() == version)
        };
        let is_known = served.iter().any(|engine| engine.source.name() == name);
        let engine = served.iter().find(is_named).ok_or_else(|| Refusal::UnknownModel {
            field: if is_known { "options.version" } else { "options.model" },
            requested: on_a_line(format!("{name} {version}").trim_end()),
            available: describe(&served.iter().collect::<Vec<_>>(), |engine| engine.label.clone()),
        })?;
        if fits(engine) { Ok(Arc::clone(engine)) } else { Err(wrong(&accepted(engine))) }
    }
}

fn describe(served: &[&Arc<Engine>], engine: impl Fn(&Engine) -> String) -> String {
    served.iter().map(|served| engine(served)).collect::<Vec<_>>().join(", ")
}

/// Checks that a volume has the voxel size that the network was trained with; another size would scale the scene.
pub(crate) fn check_voxel_size(volume: &Volume, engine: &Engine) -> Result<(), FieldError> {
    let Some(network) = engine.source.network() else { return Ok(()) };
    let (actual, trained) = (volume.voxel_size(), network.metadata.voxel_size);
    if (actual - trained).abs() <= 1e-3 * trained {
        return Ok(());
    }
    let needed = format_args!("must be {trained} m (±0.1 %) for the model {}", engine.label);
    Err(FieldError::new("volume.voxel_size", actual, needed))
}

impl From<&ModelRegistry> for pb::ListModelsResponse {
    fn from(models: &ModelRegistry) -> Self {
        Self { models: models.now().iter().map(|engine| (&**engine).into()).collect() }
    }
}

impl From<&Engine> for pb::Model {
    fn from(engine: &Engine) -> Self {
        let source = &engine.source;
        let network = source.network().map(|entry| &entry.metadata);
        Self {
            name: source.name().to_owned(),
            version: source.version().to_owned(),
            // Fits: the warm-up fails for networks larger than `Volume::MAX_RESOLUTION`.
            resolution: network.map_or(0, |metadata| metadata.resolution as u32),
            voxel_size: network.map_or(0.0, |metadata| metadata.voxel_size),
            threshold: source.decode_params().threshold,
            sha256: source.sha256().to_owned(),
            provider: engine.backend.provider.to_string(),
            precision: engine.backend.precision.to_string(),
            provenance: source.provenance().into_iter().collect(),
            voxel_origin: network.map_or("", |metadata| metadata.voxel_origin.name()).to_owned(),
            camera_azimuth: network.and_then(|metadata| metadata.camera_azimuth),
        }
    }
}
