use std::sync::{Arc, PoisonError, RwLock};

use grasp::Volume;
use grasp_proto::{FieldError, on_a_line, pb};

use crate::rpc::refusal::Refusal;
use crate::serving::engine::Engine;
use grasp_planner::Source;

/// The models that are served now.
#[derive(Default)]
pub(crate) struct ModelRegistry(RwLock<Engines>);

/// The default first, then by name, the newest version of a name before the older ones.
pub(crate) type Engines = Arc<[Arc<Engine>]>;

impl ModelRegistry {
    /// What is served at this moment. Whoever holds it can still ask it, even if others are served meanwhile.
    pub fn now(&self) -> Engines {
        Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// From now on serves these.
    pub fn replace(&self, mut engines: Vec<Arc<Engine>>, default: Option<&str>) {
        // From the newest version to the oldest, as the sort by name is stable; what is no network answers only by name.
        engines.sort_by(|a, b| b.source.by_version(&a.source));
        engines.sort_by_key(|engine| {
            let name = engine.source.name().to_owned();
            (engine.source.network().is_none(), default != Some(&name), name)
        });
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = engines.into();
    }

    /// The planner that a request asks for, if it takes volumes of that resolution, where the request has one already.
    pub fn select(&self, name: &str, version: &str, resolution: Option<usize>) -> Result<Arc<Engine>, Refusal> {
        let served = self.now();
        let fits = |engine: &Arc<Engine>| match (engine.source.network(), resolution) {
            (Some(network), Some(resolution)) => network.metadata.resolution == resolution,
            (None, Some(resolution)) => resolution <= Source::MAX_RESOLUTION,
            (_, None) => true,
        };
        let taken = |engine: &Engine| match engine.source.network() {
            Some(network) => format!("{} ({})", network.metadata.resolution, engine.label),
            None => format!("at most {} ({})", Source::MAX_RESOLUTION, engine.label),
        };
        let wrong = |taken: &str| {
            let needed = format_args!("the models that could answer take {taken}");
            Refusal::from(FieldError::new("volume.resolution", resolution.unwrap_or_default(), needed))
        };
        if name.is_empty() {
            if !version.is_empty() {
                let needed = "which needs a `model` that it is a version of";
                return Err(FieldError::new("options.version", format_args!("`{version}`"), needed).into());
            }
            let networks: Vec<_> = served.iter().filter(|engine| engine.source.network().is_some()).collect();
            let engine = networks.iter().find(|engine| fits(engine)).map(|&engine| Arc::clone(engine));
            return engine.ok_or_else(|| wrong(&describe(&networks, taken)));
        }
        let is_named = |engine: &&Arc<Engine>| {
            engine.source.name() == name && (version.is_empty() || engine.source.version() == version)
        };
        let is_known = served.iter().any(|engine| engine.source.name() == name);
        let engine = served.iter().find(is_named).ok_or_else(|| Refusal::UnknownModel {
            field: if is_known { "options.version" } else { "options.model" },
            wanted: on_a_line(format!("{name} {version}").trim_end()),
            available: describe(&served.iter().collect::<Vec<_>>(), |engine| engine.label.clone()),
        })?;
        if fits(engine) { Ok(Arc::clone(engine)) } else { Err(wrong(&taken(engine))) }
    }
}

fn describe(served: &[&Arc<Engine>], engine: impl Fn(&Engine) -> String) -> String {
    served.iter().map(|served| engine(served)).collect::<Vec<_>>().join(", ")
}

/// A network trained for voxels of one size sees the world scaled when they have another.
pub(crate) fn check_voxel_size(volume: &Volume, engine: &Engine) -> Result<(), FieldError> {
    let Some(network) = engine.source.network() else { return Ok(()) };
    let (got, trained) = (volume.voxel_size(), network.metadata.voxel_size);
    if (got - trained).abs() <= 1e-3 * trained {
        return Ok(());
    }
    let needed = format_args!("the model {} takes {trained} m, to one in a thousand", engine.label);
    Err(FieldError::new("volume.voxel_size", got, needed))
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
            // A network larger than `Volume::MAX_RESOLUTION` could not have been warmed up.
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
