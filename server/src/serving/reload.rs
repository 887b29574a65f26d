use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use grasp_models::{Entry, Options, Scan, StoreError};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tracing::{error, info, warn};

use crate::config::Config;
use crate::readiness::State;
use crate::serving::engine::{Engine, Serving, SessionThreads};
use crate::serving::registry::ModelRegistry;
use crate::telemetry::metrics::Metrics;
use grasp_planner::Source;

/// In the folder of models.
const CLASSIFIERS: &str = "classifiers";

/// In it, too: the name of the model that answers requests which name none.
const DEFAULT: &str = "default";

/// Brings the models of a folder into service, and keeps them as the folder has them.
pub(crate) struct ModelFolder {
    directory: PathBuf,
    /// From before it was read first.
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

    /// Serves all of these and what needs no network, or says which cannot be served; or gives up where the process is to stop meanwhile.
    pub fn load(&self, entries: &[Entry], state: &watch::Receiver<State>) -> anyhow::Result<()> {
        let mut engines = Vec::new();
        let classifiers = classifiers(&self.directory)?;
        if let Some(error) = classifiers.rejected.into_iter().next() {
            return Err(error.into());
        }
        for source in sources(entries.to_vec(), classifiers.entries) {
            if *state.borrow() == State::Draining {
                return Ok(());
            }
            engines.push(self.start(source)?);
        }
        self.replace(engines);
        Ok(())
    }

    /// Reads the folder anew at SIGHUP, and whenever its files have changed and then stayed the same from one look to
    /// the next: who is still writing one is not disturbed. Without `every` nobody looks.
    pub async fn watch(self, mut hangup: Signal, every: Option<Duration>) {
        let folder = Arc::new(self);
        let mut loaded = folder.stamps.clone();
        let mut last = loaded.clone();
        loop {
            let told = tokio::select! {
                _ = hangup.recv() => true,
                () = tokio::time::sleep(every.unwrap_or_default()), if every.is_some() => false,
            };
            // A file system across a network may take its time.
            let looking = Arc::clone(&folder);
            let Ok(now) = tokio::task::spawn_blocking(move || stamps(&looking.directory)).await else { continue };
            if told || (now != loaded && now == last) {
                let reloading = Arc::clone(&folder);
                if let Err(panic) = tokio::task::spawn_blocking(move || reloading.reload()).await {
                    error!(%panic, "the models could not be loaded anew");
                    folder.metrics.reloaded(Err(()));
                }
                loaded.clone_from(&now);
            }
            last = now;
        }
    }

    /// Loads what is new and warms it up beside what is served, then serves it instead. A file that cannot be served
    /// changes nothing: what it held before goes on being served.
    fn reload(&self) {
        let scans = Scan::read(&self.directory).and_then(|networks| Ok((networks, classifiers(&self.directory)?)));
        let (networks, classifiers) = match scans {
            Ok(scans) => scans,
            Err(error) => {
                error!(%error, "the models stay as they are");
                return self.metrics.reloaded(Err(()));
            }
        };
        let served = self.models.now();
        let mut refused: Vec<PathBuf> = Vec::new();
        for error in networks.rejected.into_iter().chain(classifiers.rejected) {
            error!(%error, "cannot be served, what it held before is kept");
            refused.push(error.path().to_owned());
        }
        let mut engines = Vec::new();
        for source in sources(networks.entries, classifiers.entries) {
            if let Some(engine) = served.iter().find(|engine| engine.source == source) {
                engines.push(Arc::clone(engine));
                continue;
            }
            let path = source.path().map(Path::to_owned);
            match self.start(source) {
                Ok(engine) => engines.push(engine),
                Err(error) => {
                    error!(error = format!("{error:#}"), "cannot be served, what it held before is kept");
                    refused.extend(path);
                }
            }
        }
        let is_refused = |path: &Path| refused.iter().any(|refused| refused == path);
        let kept = served.iter().filter(|engine| engine.source.path().is_some_and(is_refused));
        for kept in kept.cloned().collect::<Vec<_>>() {
            if !engines.iter().any(|engine| engine.label == kept.label) {
                engines.push(kept);
            }
        }
        if engines.iter().all(|engine| engine.source.network().is_none()) {
            warn!("nothing in the folder can be served, the models stay as they are");
        } else {
            self.replace(engines);
        }
        // Last, so that whoever sees it in the metrics is answered by what was loaded.
        self.metrics.reloaded(Ok(refused.len()));
    }

    fn start(&self, source: Source) -> anyhow::Result<Arc<Engine>> {
        Engine::start(source, &self.serving, &self.metrics, &self.sessions).map(Arc::new)
    }

    fn replace(&self, engines: Vec<Arc<Engine>>) {
        let before = self.models.now();
        let default = self.default_model.clone().or_else(|| default_of(&self.directory));
        if let Some(name) = default.as_deref().filter(|name| engines.iter().all(|engine| engine.source.name() != *name))
        {
            warn!(name, "the default model is not served, the first by name is it instead");
        }
        self.models.replace(engines, default.as_deref());
        let now = self.models.now();
        self.metrics.replaced(&before, &now);
        for gone in before.iter().filter(|engine| !now.iter().any(|other| Arc::ptr_eq(engine, other))) {
            info!(model = gone.label, sha256 = gone.source.sha256(), "no longer served");
        }
    }
}

/// What the folder says of it, if it does.
fn default_of(directory: &Path) -> Option<String> {
    let name = fs::read_to_string(directory.join(DEFAULT)).ok()?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}

/// The folder's own folder of GPD's classifiers, which need not be there.
fn classifiers(directory: &Path) -> Result<Scan, StoreError> {
    let none = || Scan { entries: Vec::new(), rejected: Vec::new() };
    let directory = directory.join(CLASSIFIERS);
    if !directory.is_dir() {
        return Ok(none());
    }
    match Scan::read(&directory) {
        Err(StoreError::Empty(_)) => Ok(none()),
        scan => scan,
    }
}

/// What is served of a folder: its networks, its classifiers, and what needs neither.
fn sources(networks: Vec<Entry>, classifiers: Vec<Entry>) -> Vec<Source> {
    let networks = networks.into_iter().map(Source::Network);
    networks.chain(classifiers.into_iter().map(Source::Gpd)).chain([Source::Shaf]).collect()
}

/// What tells a folder's files from other ones without reading them: name, time of the last change, size.
pub(crate) type Stamps = Vec<(PathBuf, Option<SystemTime>, u64)>;

pub(crate) fn stamps(directory: &Path) -> Stamps {
    let stamp = |path: PathBuf| {
        // Of what a link leads to: Kubernetes swaps links.
        let metadata = fs::metadata(&path).ok()?;
        Some((path, metadata.modified().ok(), metadata.len()))
    };
    let folders = [directory.to_owned(), directory.join(CLASSIFIERS)];
    let files = folders.iter().flat_map(fs::read_dir).flatten().flatten().map(|file| file.path());
    let counts =
        |path: &PathBuf| path.extension().is_some_and(|extension| extension == "onnx") || path.ends_with(DEFAULT);
    let mut stamps: Vec<_> = files.filter(counts).filter_map(stamp).collect();
    stamps.sort();
    stamps
}
