use std::sync::{Arc, PoisonError, RwLock};

use grasp::{Code, RequestError, on_a_line};
use grasp_planner::ModelSpec;

use crate::model::Model;

/// The models of the model folder.
#[derive(Default)]
pub struct ModelRegistry {
    served: RwLock<Models>,
    unavailable: RwLock<Vec<Unavailable>>,
}

/// A model of the folder that is not served.
#[derive(Clone, Debug)]
pub struct Unavailable {
    /// Name of the model, or of its file if the name of the model is not known.
    pub name: String,
    /// Why it is not served.
    pub reason: String,
}

/// The default model first, then the other networks by name, then those with an evaluator, then the planners without a
/// network; per name the newest version first.
pub type Models = Arc<[Arc<Model>]>;

impl ModelRegistry {
    /// The models served now. Models in the returned list remain usable after they are replaced.
    pub fn now(&self) -> Models {
        Arc::clone(&self.served.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Replaces the served models. `default` is the name of the default one.
    pub(crate) fn replace(&self, mut models: Vec<Arc<Model>>, default: Option<&str>) {
        // The sort by name is stable, so versions remain sorted. Only models with a network can be the default.
        models.sort_by(|a, b| b.spec.by_version(&a.spec));
        models.sort_by_key(|model| {
            let name = model.spec.name().to_owned();
            let is_evaluated = matches!(model.spec, ModelSpec::Evaluated { .. });
            (model.spec.network().is_none(), default != Some(&name), is_evaluated, name)
        });
        *self.served.write().unwrap_or_else(PoisonError::into_inner) = models.into();
    }

    /// The models that are not served.
    pub fn unavailable(&self) -> Vec<Unavailable> {
        self.unavailable.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn set_unavailable(&self, models: Vec<Unavailable>) {
        *self.unavailable.write().unwrap_or_else(PoisonError::into_inner) = models;
    }

    /// The error for a model that is not served; `field` of the request names it.
    #[must_use]
    pub fn unknown(&self, field: &'static str, requested: &str) -> RequestError {
        let served = self.now();
        unknown_of(field, requested, &describe(&served.iter().collect::<Vec<_>>(), |model| model.label.clone()))
    }

    /// The present name of the model whose name is `name`, or was before it was renamed.
    #[must_use]
    pub fn current_name<'a>(served: &'a [Arc<Model>], name: &'a str) -> &'a str {
        ModelSpec::current_name(served.iter().map(|model| &model.spec), name)
    }

    /// The network with this name and version; `field` of the request has the name. Planners without a network are not
    /// found.
    ///
    /// # Errors
    /// [`RequestError`] with the available ones.
    pub fn network(&self, field: &'static str, name: &str, version: &str) -> Result<Arc<Model>, RequestError> {
        let served = self.now();
        let name = Self::current_name(&served, name);
        let networks = || served.iter().filter(|model| model.spec.network().is_some());
        let is_named =
            |model: &&Arc<Model>| model.spec.name() == name && (version.is_empty() || model.spec.version() == version);
        networks().find(is_named).map(Arc::clone).ok_or_else(|| {
            let available = describe(&networks().collect::<Vec<_>>(), |model| model.label.clone());
            unknown_of(field, format!("{name} {version}").trim_end(), &available)
        })
    }

    /// Selects the model that a request names, or the default. `resolution` is that of the request's volume, if it has
    /// one; the model must accept it.
    ///
    /// # Errors
    /// [`RequestError`] if no such model is served, or it does not accept the resolution.
    pub fn select(&self, name: &str, version: &str, resolution: Option<usize>) -> Result<Arc<Model>, RequestError> {
        let served = self.now();
        let fits = |model: &Arc<Model>| match (model.spec.network(), resolution) {
            (Some(network), Some(resolution)) => network.metadata.resolution == resolution,
            (None, Some(resolution)) => resolution <= ModelSpec::MAX_RESOLUTION,
            (_, None) => true,
        };
        let accepted = |model: &Model| match model.spec.network() {
            Some(network) => format!("{} ({})", network.metadata.resolution, model.label),
            None => format!("at most {} ({})", ModelSpec::MAX_RESOLUTION, model.label),
        };
        let wrong = |accepted: &str| {
            let needed = format_args!("supported: {accepted}");
            RequestError::invalid("volume.resolution", resolution.unwrap_or_default(), needed)
        };
        if name.is_empty() {
            if !version.is_empty() {
                let needed = "but options.model is empty: name the model of this version";
                return Err(RequestError::invalid("options.version", format_args!("`{version}`"), needed));
            }
            let networks: Vec<_> = served.iter().filter(|model| model.spec.network().is_some()).collect();
            let model = networks.iter().find(|model| fits(model)).map(|&model| Arc::clone(model));
            return model.ok_or_else(|| wrong(&describe(&networks, accepted)));
        }
        let requested = format!("{name} {version}");
        let name = Self::current_name(&served, name);
        let is_named =
            |model: &&Arc<Model>| model.spec.name() == name && (version.is_empty() || model.spec.version() == version);
        let is_known = served.iter().any(|model| model.spec.name() == name);
        let model = served.iter().find(is_named).ok_or_else(|| {
            let field = if is_known { "options.version" } else { "options.model" };
            self.unknown(field, requested.trim_end())
        })?;
        if fits(model) { Ok(Arc::clone(model)) } else { Err(wrong(&accepted(model))) }
    }
}

/// The error for a model that is not served; `field` names it.
fn unknown_of(field: &'static str, requested: &str, available: &str) -> RequestError {
    let message = format!("{field}: `{}` not found; available: {available}", on_a_line(requested));
    RequestError { field: Some(field.into()), ..RequestError::new(Code::NotFound, message) }
}

fn describe(served: &[&Arc<Model>], model: impl Fn(&Model) -> String) -> String {
    served.iter().map(|served| model(served)).collect::<Vec<_>>().join(", ")
}
