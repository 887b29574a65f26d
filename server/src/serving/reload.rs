use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use grasp_models::{Entry, Options, read_regular_file};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tracing::{error, info, warn};

use crate::config::Config;
use crate::readiness::State;
use crate::serving::engine::{Engine, Serving, SessionThreads};
use crate::serving::model_files::ModelFiles;
use crate::serving::registry::ModelRegistry;
use crate::serving::stamps::{DEFAULT, Stamps, stamps};
use crate::telemetry::metrics::Metrics;
use grasp_planner::Source;

/// Reloads that may hang, for example on a network file system, before the folder is no longer read. Each blocks a
/// thread.
const MAX_HANGING: usize = 4;

/// Maximum size of the file [`DEFAULT`], bytes: a name and a line end.
const MAX_DEFAULT: u64 = 130;

/// Loads the models of a folder into the registry, and reloads them when files change.
pub(crate) struct ModelFolder {
    directory: PathBuf,
    /// Taken before the folder was first read.
    stamps: Stamps,
    default_model: Option<String>,
    /// Maximum size of a model file.
    max_bytes: u64,
    /// Time after which a reload no longer delays the next one.
    timeout: Duration,
    /// Number of the latest reload. Earlier ones that are still running change nothing.
    latest: AtomicU64,
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
        Self {
            directory,
            stamps,
            default_model,
            max_bytes: config.max_model_bytes,
            timeout: config.reload_timeout,
            latest: AtomicU64::new(0),
            serving,
            models,
            sessions,
            metrics,
        }
    }

    /// Loads the networks `entries` and the planners of the subfolders, and serves them. Returns early
    /// when the server is draining.
    pub fn load(&self, entries: &[Entry], state: &watch::Receiver<State>) -> anyhow::Result<()> {
        let mut engines = Vec::new();
        let files = ModelFiles::with_networks(&self.directory, entries.to_vec(), self.max_bytes)?;
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
        let mut hanging: Vec<JoinHandle<()>> = Vec::new();
        loop {
            let is_requested = tokio::select! {
                _ = hangup.recv() => true,
                () = tokio::time::sleep(interval.unwrap_or_default()), if interval.is_some() => false,
            };
            hanging.retain(|task| !task.is_finished());
            if hanging.len() >= MAX_HANGING {
                if is_requested {
                    error!("{MAX_HANGING} reloads are still running; restart the server to load the models");
                    folder.metrics.reloaded(Err(()));
                }
                continue;
            }
            // On blocking threads, because network file systems may be slow, or hang.
            let (sender, receiver) = tokio::sync::oneshot::channel();
            let polled = Arc::clone(&folder);
            let poll = tokio::task::spawn_blocking(move || {
                let _ = sender.send(stamps(&polled.directory));
            });
            hanging.extend(folder.finish("polling the model folder", poll).await);
            let Ok(now) = receiver.await else { continue };
            if is_requested || (now != loaded && now == last) {
                let number = folder.latest.fetch_add(1, Ordering::Relaxed) + 1;
                let reloading = Arc::clone(&folder);
                let reload = tokio::task::spawn_blocking(move || reloading.reload(number));
                hanging.extend(folder.finish("reloading the models", reload).await);
                loaded.clone_from(&now);
            }
            last = now;
        }
    }

    /// Waits for a task, at most until the timeout. Returns it if it is still running.
    async fn finish(&self, what: &str, mut task: JoinHandle<()>) -> Option<JoinHandle<()>> {
        match timeout(self.timeout, &mut task).await {
            Ok(Ok(())) => None,
            Ok(Err(panic)) => {
                error!(%panic, "{what} panicked; the served models are unchanged");
                self.metrics.reloaded(Err(()));
                None
            }
            Err(_) => {
                error!(
                    timeout = ?self.timeout,
                    "{what} takes longer than --reload-timeout; it continues in the background, the served models are \
                     unchanged until then"
                );
                self.metrics.reloaded(Err(()));
                Some(task)
            }
        }
    }

    /// Loads and warms up new models while the old ones are served, then replaces them. If a file cannot be loaded, the
    /// model that was loaded from it before remains served. Changes nothing if a later reload than `number` has begun.
    fn reload(&self, number: u64) {
        let files = match ModelFiles::read(&self.directory, self.max_bytes) {
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
        if number != self.latest.load(Ordering::Relaxed) {
            warn!("a reload ended after a later one had begun; it changes nothing");
            return self.metrics.superseded();
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
        if default.as_deref().is_some_and(|name| engines.iter().all(|engine| engine.source.name() != name)) {
            // The name is not logged: if the file `default` is a link to another file, it is that file's content.
            let setting = if self.default_model.is_some() { "--default-model" } else { "the file `default`" };
            warn!("the model named by {setting} is not served; the first network by name is the default instead");
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
    let path = directory.join(DEFAULT);
    if !path.exists() {
        return None;
    }
    let name = read_regular_file(&path, MAX_DEFAULT);
    let name = name.inspect_err(|error| warn!(%error, "cannot read the file `default` in the model folder")).ok()?;
    let name = String::from_utf8(name).ok()?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}
