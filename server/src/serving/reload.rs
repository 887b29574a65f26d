use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use grasp_models::{Entry, Options};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tracing::{error, info, warn};

use crate::config::Config;
use crate::readiness::State;
use crate::serving::engine::{Engine, Serving, SessionThreads};
use crate::serving::model_files::ModelFiles;
use crate::serving::registry::ModelRegistry;
use crate::serving::stamps::{DEFAULT, Stamps, stamps};
use crate::telemetry::metrics::Metrics;
use grasp_planner::Source;

/// Loads the models of a folder into the registry, and reloads them when files change.
pub(crate) struct ModelFolder {
    directory: PathBuf,
    /// Taken before the folder was first read.
    stamps: Stamps,
    default_model: Option<String>,
    serving: Serving,
    models: Arc<ModelRegistry>,
    sessions: Arc<SessionThreads>,
    metrics: Arc<Metrics>,
}

impl ModelFolder {
    pub fn new(
        config: &Config,
        models: Arc<ModelRegistry>,
        sessions: Arc<SessionThreads>,
        metrics: Arc<Metrics>,
    ) -> Self {
        let Config { workers, threads, provider, precision, queue, batching, .. } = *config;
        let options = Options { threads, provider, precision, max_batch: batching.max };
        let serving = Serving { workers, options, capacity: queue, batching };
        let (directory, default_model) = (config.store.directory().to_owned(), config.default_model.clone());
        let stamps = config.stamps.clone();
        Self { directory, stamps, default_model, serving, models, sessions, metrics }
    }

    /// Loads the networks `entries` and the planners of the subfolders, and serves them. Returns early
    /// when the server is draining.
    pub fn load(&self, entries: &[Entry], state: &watch::Receiver<State>) -> anyhow::Result<()> {
        let mut engines = Vec::new();
        let files = ModelFiles::with_networks(&self.directory, entries.to_vec())?;
        if let Some(error) = files.rejected.into_iter().next() {
            return Err(error.into());
        }
        for source in files.sources {
            if *state.borrow() == State::Draining {
                return Ok(());
            }
            engines.push(self.start(source)?);
        }
        self.replace(engines);
        Ok(())
    }

    /// Reloads the folder at SIGHUP, and when its files have changed and were then unchanged for one interval, so that
    /// files that are still being written are not loaded. Without an interval, only SIGHUP reloads.
    pub async fn watch(self, mut hangup: Signal, interval: Option<Duration>) {
        let folder = Arc::new(self);
        let mut loaded = folder.stamps.clone();
        let mut last = loaded.clone();
        loop {
            let is_requested = tokio::select! {
                _ = hangup.recv() => true,
                () = tokio::time::sleep(interval.unwrap_or_default()), if interval.is_some() => false,
            };
            // On a blocking thread, because network file systems may be slow.
            let polled = Arc::clone(&folder);
            let Ok(now) = tokio::task::spawn_blocking(move || stamps(&polled.directory)).await else { continue };
            if is_requested || (now != loaded && now == last) {
                let reloading = Arc::clone(&folder);
                if let Err(panic) = tokio::task::spawn_blocking(move || reloading.reload()).await {
                    error!(%panic, "reloading the models panicked; the served models are unchanged");
                    folder.metrics.reloaded(Err(()));
                }
                loaded.clone_from(&now);
            }
            last = now;
        }
    }

    /// Loads and warms up new models while the old ones are served, then replaces them. If a file cannot be loaded, the
    /// model that was loaded from it before remains served.
    fn reload(&self) {
        let files = match ModelFiles::read(&self.directory) {
            Ok(files) => files,
            Err(error) => {
                error!(%error, "cannot read the model folder; the served models are unchanged");
                return self.metrics.reloaded(Err(()));
            }
        };
        let served = self.models.now();
        let mut rejected: Vec<PathBuf> = Vec::new();
        for error in files.rejected {
            error!(%error, "cannot load a model file; a model that was loaded from it before remains served");
            rejected.push(error.path().to_owned());
        }
        let mut engines = Vec::new();
        for source in files.sources {
            if let Some(engine) = served.iter().find(|engine| engine.source == source) {
                engines.push(Arc::clone(engine));
                continue;
            }
            let path = source.path().map(Path::to_owned);
            match self.start(source) {
                Ok(engine) => engines.push(engine),
                Err(error) => {
                    error!(
                        error = format!("{error:#}"),
                        "cannot load a model file; a model that was loaded from it before remains served"
                    );
                    rejected.extend(path);
                }
            }
        }
        let is_rejected = |path: &Path| rejected.iter().any(|rejected| rejected == path);
        let kept = served.iter().filter(|engine| engine.source.path().is_some_and(is_rejected));
        for kept in kept.cloned().collect::<Vec<_>>() {
            if !engines.iter().any(|engine| engine.label == kept.label) {
                engines.push(kept);
            }
        }
        if engines.iter().all(|engine| engine.source.network().is_none()) {
            warn!("the model folder contains no network that can be served; the served models are unchanged");
        } else {
            self.replace(engines);
        }
        // Last, so that the new models are served before the metric changes.
        self.metrics.reloaded(Ok(rejected.len()));
    }

    fn start(&self, source: Source) -> anyhow::Result<Arc<Engine>> {
        Engine::start(source, &self.serving, &self.metrics, &self.sessions).map(Arc::new)
    }

    fn replace(&self, engines: Vec<Arc<Engine>>) {
        let before = self.models.now();
        let default = self.default_model.clone().or_else(|| default_of(&self.directory));
        if let Some(name) = default.as_deref().filter(|name| engines.iter().all(|engine| engine.source.name() != *name))
        {
            warn!(name, "the default model is not served; the first network by name is the default instead");
        }
        self.models.replace(engines, default.as_deref());
        let now = self.models.now();
        let labels = |engines: &[Arc<Engine>]| engines.iter().map(|engine| engine.labels()).collect::<Vec<_>>();
        self.metrics.replaced(&labels(&before), &labels(&now));
        for removed in before.iter().filter(|engine| !now.iter().any(|other| Arc::ptr_eq(engine, other))) {
            info!(model = removed.label, sha256 = removed.source.sha256(), "model no longer served");
        }
    }
}

/// The name in the file [`DEFAULT`], if there is one.
fn default_of(directory: &Path) -> Option<String> {
    let name = fs::read_to_string(directory.join(DEFAULT)).ok()?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}
