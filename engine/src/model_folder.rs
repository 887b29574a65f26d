use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::ensure;
use grasp::{Code, RequestError};
use grasp_models::{Entry, read_regular_file};
use grasp_planner::{ModelFiles, ModelSpec};
use tokio::signal::unix::Signal;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};

use crate::control::{Change, Command, ModelControl};
use crate::fingerprints::{DEFAULT, Fingerprints, fingerprints};
use crate::model::{Model, ModelSettings};
use crate::observer::{Observer, Reload};
use crate::registry::{ModelRegistry, Unavailable};
use crate::session_threads::SessionThreads;

/// Reloads that may hang, for example on a network file system, before the folder is no longer read. Each blocks a
/// thread.
const MAX_HANGING: usize = 4;

/// Maximum size of the file [`DEFAULT`], bytes: a name and a line end.
const MAX_DEFAULT: u64 = 130;

/// Loads the models of a folder into the registry, and reloads them when files change.
pub struct ModelFolder {
    settings: FolderSettings,
    /// Number of the latest reload. Earlier ones that are still running change nothing.
    latest: AtomicU64,
    /// Number of the latest reload that has read the whole folder.
    completed: AtomicU64,
    /// Names of the models that clients have unloaded.
    unloaded: Mutex<BTreeSet<String>>,
    commands: Option<mpsc::Receiver<Command>>,
    stopping: CancellationToken,
    loads: Loads,
    /// Held while the registry is changed, so that an earlier reload cannot overwrite a later one.
    replacing: Mutex<()>,
    models: Arc<ModelRegistry>,
    threads: Arc<SessionThreads>,
    observer: Arc<dyn Observer>,
}

/// Settings of a model folder.
#[derive(Clone, Debug)]
pub struct FolderSettings {
    /// The folder.
    pub directory: PathBuf,
    /// Its fingerprints, taken before it was first read.
    pub fingerprints: Fingerprints,
    /// Name of the default model, if it is set.
    pub default_model: Option<String>,
    /// Maximum size of a model file, bytes.
    pub max_bytes: u64,
    /// Time after which a reload no longer delays the next one.
    pub timeout: Duration,
    /// Whether clients may load and unload models.
    pub is_controlled: bool,
    /// Settings of the models.
    pub models: ModelSettings,
}

/// Held while a model is loaded.
#[derive(Clone, Debug, Default)]
pub struct Loads(Arc<Mutex<()>>);

impl Loads {
    /// Waits until no model is being loaded.
    pub fn wait(&self) {
        drop(self.begin());
    }

    fn begin(&self) -> MutexGuard<'_, ()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ModelFolder {
    /// The folder, and the control with which clients change its models. No model is loaded once `stopping` is
    /// cancelled.
    pub fn new(
        settings: FolderSettings,
        models: Arc<ModelRegistry>,
        threads: Arc<SessionThreads>,
        observer: Arc<dyn Observer>,
        stopping: CancellationToken,
    ) -> (Self, ModelControl) {
        let (control, commands) = ModelControl::new(settings.is_controlled);
        let folder = Self {
            settings,
            latest: AtomicU64::new(0),
            completed: AtomicU64::new(0),
            unloaded: Mutex::default(),
            commands: Some(commands),
            stopping,
            loads: Loads::default(),
            replacing: Mutex::default(),
            models,
            threads,
            observer,
        };
        (folder, control)
    }

    /// A handle that waits for models that are being loaded.
    pub fn loads(&self) -> Loads {
        self.loads.clone()
    }

    /// Loads the networks `entries` and the planners of the subfolders, and serves them. Returns early
    /// when the server is draining.
    pub fn load(&self, entries: &[Entry]) -> anyhow::Result<()> {
        let mut models = Vec::new();
        let files = ModelFiles::with_networks(&self.settings.directory, entries.to_vec(), self.settings.max_bytes)?;
        if let Some(error) = files.rejected.into_iter().next() {
            return Err(error.into());
        }
        if let Some(default) = &self.settings.default_model {
            let networks = files.specs.iter().filter(|spec| spec.network().is_some());
            let names: BTreeSet<&str> = networks.map(ModelSpec::name).collect();
            let available = || names.iter().copied().collect::<Vec<_>>().join(", ");
            ensure!(
                names.contains(ModelSpec::current_name(files.specs.iter(), default)),
                "--default-model is `{default}`, which is not in the model folder; available: {}",
                available()
            );
        }
        for spec in files.specs {
            if self.stopping.is_cancelled() {
                return Ok(());
            }
            models.push(self.start(spec)?);
        }
        self.replace(models, &self.defaults());
        Ok(())
    }

    /// Reloads the folder at SIGHUP, when a client loads or unloads a model, and when its files have changed and were
    /// then unchanged for one interval, so that files that are still being written are not loaded. Without an interval
    /// it is not polled.
    pub async fn watch(mut self, mut hangup: Signal, interval: Option<Duration>) {
        let mut commands = self.commands.take();
        let folder = Arc::new(self);
        let mut loaded = folder.settings.fingerprints.clone();
        let mut last = loaded.clone();
        let mut hanging: Vec<JoinHandle<()>> = Vec::new();
        let mut next_command = async || match &mut commands {
            Some(commands) => commands.recv().await,
            None => None,
        };
        loop {
            let (is_requested, command) = tokio::select! {
                _ = hangup.recv() => (true, None),
                Some(command) = next_command() => (true, Some(command)),
                () = tokio::time::sleep(interval.unwrap_or_default()), if interval.is_some() => (false, None),
            };
            hanging.retain(|task| !task.is_finished());
            if hanging.len() >= MAX_HANGING {
                let reason = format!("{MAX_HANGING} reloads are still running; restart the server to load the models");
                if is_requested {
                    error!("{reason}");
                    folder.observer.reloaded(Reload::Failed);
                }
                if let Some(Command { done, .. }) = command {
                    let _ = done.send(Err(not_changed(reason)));
                }
                continue;
            }
            let begun = command.map(|command| folder.begin(command));
            if let Some(None) = begun {
                continue;
            }
            // On blocking threads, because network file systems may be slow, or hang.
            let (sender, receiver) = tokio::sync::oneshot::channel();
            let polled = Arc::clone(&folder);
            let poll = tokio::task::spawn_blocking(move || {
                let _ = sender.send(fingerprints(&polled.settings.directory));
            });
            let is_hanging = folder.finish("polling the model folder", poll).await;
            let now = if is_hanging.is_none() { receiver.await.ok() } else { None };
            hanging.extend(is_hanging);
            let Some(now) = now else {
                if let Some(Some(command)) = begun {
                    folder.end(command, None);
                }
                continue;
            };
            let mut number = 0;
            if is_requested || (now != loaded && now == last) {
                number = folder.latest.fetch_add(1, Ordering::Relaxed) + 1;
                let reloading = Arc::clone(&folder);
                let reload = tokio::task::spawn_blocking(move || reloading.reload(number));
                hanging.extend(folder.finish("reloading the models", reload).await);
                loaded.clone_from(&now);
            }
            last = now;
            if let Some(Some(command)) = begun {
                folder.end(command, Some(number));
            }
        }
    }

    /// Records which model a client has unloaded or loaded. Answers the command and returns None if it is refused.
    fn begin(&self, mut command: Command) -> Option<Command> {
        let Command { name, change, was_unloaded, .. } = &mut command;
        let name = &*name;
        let served = self.models.now();
        let error = match change {
            Change::Load => {
                *was_unloaded = self.unloaded().remove(name);
                return Some(command);
            }
            Change::Unload if served.iter().all(|model| model.spec.name() != name) => self.not_served(name),
            Change::Unload => {
                let is_other_network = |model: &Arc<Model>| model.spec.network().is_some() && model.spec.name() != name;
                if served.iter().any(is_other_network) {
                    self.unloaded().insert(name.clone());
                    return Some(command);
                }
                not_changed(format!("`{name}` is the only network, and cannot be unloaded"))
            }
        };
        let _ = command.done.send(Err(error));
        None
    }

    /// Answers a command after the reload with this number; None if there was none.
    fn end(&self, Command { name, change, was_unloaded, done }: Command, number: Option<u64>) {
        if number != Some(self.completed.load(Ordering::Relaxed)) {
            match change {
                Change::Unload => _ = self.unloaded().remove(&name),
                Change::Load if was_unloaded => _ = self.unloaded().insert(name),
                Change::Load => {}
            }
            let reason = "the reload of the model folder failed, or takes longer than --reload-timeout; see the log";
            let _ = done.send(Err(not_changed(reason)));
            return;
        }
        let is_served = self.models.now().iter().any(|model| model.spec.name() == name);
        let outcome = match change {
            // An older version may be served, because the new file was rejected.
            Change::Load if is_served && self.models.unavailable().iter().all(|model| model.name != name) => Ok(()),
            Change::Load => {
                let error = self.not_served(&name);
                if was_unloaded && !is_served {
                    self.unloaded().insert(name);
                }
                Err(error)
            }
            Change::Unload if is_served => {
                self.unloaded().remove(&name);
                Err(not_changed(format!("`{name}` is still served; see the log")))
            }
            Change::Unload => Ok(()),
        };
        let _ = done.send(outcome);
    }

    /// Why a model is not served.
    fn not_served(&self, name: &str) -> RequestError {
        let unavailable = self.models.unavailable();
        match unavailable.iter().find(|model| model.name == name) {
            Some(Unavailable { reason, .. }) => not_changed(format!("`{name}` cannot be served: {reason}")),
            None => self.models.unknown("model_name", name),
        }
    }

    fn unloaded(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.unloaded.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a task, at most until the timeout. Returns it if it is still running.
    async fn finish(&self, what: &str, mut task: JoinHandle<()>) -> Option<JoinHandle<()>> {
        match timeout(self.settings.timeout, &mut task).await {
            Ok(Ok(())) => None,
            Ok(Err(panic)) => {
                error!(%panic, "{what} panicked; the served models are unchanged");
                self.observer.reloaded(Reload::Failed);
                None
            }
            Err(_) => {
                error!(
                    timeout = ?self.settings.timeout,
                    "{what} takes longer than --reload-timeout; it continues in the background, the served models are \
                     unchanged until then"
                );
                self.observer.reloaded(Reload::Failed);
                Some(task)
            }
        }
    }

    /// Loads and warms up new models while the old ones are served, then replaces them. If a file cannot be loaded, the
    /// model that was loaded from it before remains served. Changes nothing if a later reload than `number` has begun.
    fn reload(&self, number: u64) {
        let files = match ModelFiles::read(&self.settings.directory, self.settings.max_bytes) {
            Ok(files) => files,
            Err(error) => {
                error!(%error, "cannot read the model folder; the served models are unchanged");
                return self.observer.reloaded(Reload::Failed);
            }
        };
        let defaults = self.defaults();
        let served = self.models.now();
        let unloaded = self.unloaded().clone();
        let reason = "a client has unloaded it";
        let mut unavailable: Vec<_> =
            unloaded.iter().map(|name| Unavailable { name: name.clone(), reason: reason.to_owned() }).collect();
        let mut rejected: Vec<PathBuf> = Vec::new();
        let mut reject = |path: &Path, name: Option<&str>, error: String| {
            let before = served.iter().find(|model| model.spec.path() == Some(path));
            match before {
                Some(model) => error!(error, "cannot load a model file; {} stays in service", model.label),
                None => error!(error, "cannot load a model file"),
            }
            let name = name.or_else(|| before.map(|model| model.spec.name())).map(str::to_owned);
            let file = || path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            unavailable.push(Unavailable { name: name.unwrap_or_else(file), reason: error });
            rejected.push(path.to_owned());
        };
        for error in files.rejected {
            reject(error.path(), None, error.to_string());
        }
        let mut models = Vec::new();
        for spec in files.specs {
            if unloaded.contains(spec.name()) {
                continue;
            }
            if let Some(model) = served.iter().find(|model| model.spec == spec) {
                models.push(Arc::clone(model));
                continue;
            }
            if self.stopping.is_cancelled() {
                return warn!("the server is shutting down; the models after it are not loaded");
            }
            let (path, name) = (spec.path().map(Path::to_owned), spec.name().to_owned());
            match self.start(spec) {
                Ok(model) => models.push(model),
                Err(error) => {
                    reject(path.as_deref().unwrap_or(&self.settings.directory), Some(&name), format!("{error:#}"))
                }
            }
        }
        let _replacing = self.replacing.lock().unwrap_or_else(PoisonError::into_inner);
        if number != self.latest.load(Ordering::Relaxed) {
            warn!("a reload ended after a later one had begun; it changes nothing");
            return self.observer.reloaded(Reload::Superseded);
        }
        // If the request to unload a model has been answered with an error meanwhile, the model remains served.
        let still_unloaded = self.unloaded().clone();
        let is_kept = |model: &&Arc<Model>| {
            let is_rejected = model.spec.path().is_some_and(|path| rejected.iter().any(|rejected| rejected == path));
            let name = model.spec.name();
            !still_unloaded.contains(name) && (is_rejected || unloaded.contains(name))
        };
        for kept in served.iter().filter(is_kept) {
            if !models.iter().any(|model| model.label == kept.label) {
                models.push(Arc::clone(kept));
            }
        }
        unavailable.retain(|model| !unloaded.contains(&model.name) || still_unloaded.contains(&model.name));
        if models.iter().all(|model| model.spec.network().is_none()) {
            warn!("the model folder contains no network that can be served; the served models are unchanged");
        } else {
            self.replace(models, &defaults);
        }
        self.models.set_unavailable(unavailable);
        self.completed.store(number, Ordering::Relaxed);
        // Last, so that the new models are served before the metric changes.
        self.observer.reloaded(Reload::Read { rejected: rejected.len() });
    }

    fn start(&self, spec: ModelSpec) -> anyhow::Result<Arc<Model>> {
        let _loading = self.loads.begin();
        Model::start(spec, &self.settings.models, &*self.observer, &self.threads).map(Arc::new)
    }

    /// The names of the default model that are set: the first that is served is the default.
    fn defaults(&self) -> Vec<DefaultName> {
        let flag = self.settings.default_model.clone().map(|name| DefaultName { name, setting: "--default-model" });
        let file = default_of(&self.settings.directory).map(|name| DefaultName { name, setting: "the file `default`" });
        flag.into_iter().chain(file).collect()
    }

    fn replace(&self, models: Vec<Arc<Model>>, defaults: &[DefaultName]) {
        let before = self.models.now();
        let is_served = |name: &str| {
            let name = ModelRegistry::current_name(&models, name);
            models.iter().any(|model| model.spec.network().is_some() && model.spec.name() == name)
        };
        let default = defaults.iter().find(|default| is_served(&default.name));
        // The name is not logged: if the file `default` is a link to another file, it is that file's content.
        for DefaultName { setting, .. } in defaults.iter().take_while(|default| !is_served(&default.name)) {
            warn!("the model named by {setting} is not served; another model is the default instead");
        }
        let default = default.map(|default| ModelRegistry::current_name(&models, &default.name).to_owned());
        self.models.replace(models, default.as_deref());
        let now = self.models.now();
        let labels = |models: &[Arc<Model>]| models.iter().map(|model| model.labels()).collect::<Vec<_>>();
        self.observer.replaced(&labels(&before), &labels(&now));
        for removed in before.iter().filter(|model| !now.iter().any(|other| Arc::ptr_eq(model, other))) {
            info!(model = removed.label, sha256 = removed.spec.sha256(), "model no longer served");
        }
    }
}

fn not_changed(reason: impl Into<String>) -> RequestError {
    RequestError::new(Code::FailedPrecondition, reason)
}

/// The name of a default model, and the setting that it comes from.
struct DefaultName {
    name: String,
    setting: &'static str,
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
