//! Recording of requests and their answers (`--record`), with which `grasp replay` finds regressions.

use std::collections::VecDeque;
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use grasp::{Code, RequestError};
use grasp_proto::pb;
use grasp_proto::pb::recording::{Answer, Request};
use prometheus::IntCounterVec;
use prost::Message;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::warn;

use crate::api::status::message;

/// Maximum number of recordings that wait to be written, and of their bytes. Further ones are dropped and counted, so
/// that a slow disk neither delays replies nor fills the memory.
const WAITING: usize = 64;
const WAITING_BYTES: usize = 64 << 20;

/// Extension of the files.
const EXTENSION: &str = "recording";

/// Extension of a file that is being written.
const PARTIAL: &str = "part";

/// Records requests and their answers. Without a folder it does nothing.
#[derive(Clone)]
pub(crate) struct Recorder(Option<Arc<Writer>>);

struct Writer {
    recordings: SyncSender<Waiting>,
    /// One permit per byte of the recordings that wait.
    bytes: Arc<Semaphore>,
    outcomes: IntCounterVec,
}

/// A recording that waits to be written, with the permits of its bytes.
type Waiting = (pb::Recording, OwnedSemaphorePermit);

/// A request that will be recorded with its answer.
pub(crate) struct Recording<T>(Option<Pending<T>>);

struct Pending<T> {
    writer: Arc<Writer>,
    recording: pb::Recording,
    answer: fn(&T) -> Answer,
}

impl Recorder {
    /// Records nothing.
    pub fn none() -> Self {
        Self(None)
    }

    /// Records into a folder, and deletes the oldest recordings so that all together have at most `capacity` bytes.
    /// `outcomes` counts them by outcome.
    ///
    /// The thread ends when the recorder is dropped and all waiting recordings are written.
    pub fn start(folder: &Path, capacity: u64, outcomes: IntCounterVec) -> anyhow::Result<(Self, JoinHandle<()>)> {
        for outcome in ["written", "dropped", "failed"] {
            outcomes.with_label_values(&[outcome]);
        }
        let files =
            Files::open(folder, capacity).with_context(|| format!("cannot record into {}", folder.display()))?;
        let (recordings, receiver) = sync_channel(WAITING);
        let counted = outcomes.clone();
        let thread = thread::Builder::new().name("record".to_owned());
        let thread = thread.spawn(move || write(files, &receiver, &counted))?;
        let bytes = Arc::new(Semaphore::new(WAITING_BYTES));
        Ok((Self(Some(Arc::new(Writer { recordings, bytes, outcomes }))), thread))
    }

    /// A request, which is copied only if it will be recorded. The copy shares the data of images and volumes. `answer`
    /// makes the recorded answer from a response.
    pub fn request<T>(&self, request: impl FnOnce() -> Request, answer: fn(&T) -> Answer) -> Recording<T> {
        Recording(self.0.as_ref().map(|writer| {
            let received = Some(SystemTime::now().into());
            let recording = pb::Recording { received, request: Some(request()), answer: None };
            Pending { writer: Arc::clone(writer), recording, answer }
        }))
    }
}

impl<T> Recording<T> {
    /// A request that is not recorded.
    pub fn none() -> Self {
        Self(None)
    }

    /// Records the request with its answer.
    pub fn answered(self, outcome: &Result<T, RequestError>) {
        let Self(Some(Pending { writer, mut recording, answer })) = self else { return };
        // Refusals of an overloaded server do not depend on the request, and would displace recordings that do.
        let is_overload = |error: &RequestError| {
            matches!(error.code, Code::ResourceExhausted | Code::Unavailable | Code::DeadlineExceeded)
        };
        if outcome.as_ref().is_err_and(is_overload) {
            return;
        }
        recording.answer = Some(match outcome {
            Ok(response) => answer(response),
            Err(error) => Answer::Error(message(error)),
        });
        let bytes = recording.encoded_len().min(WAITING_BYTES);
        let permit = u32::try_from(bytes).ok();
        let permit = permit.and_then(|bytes| Arc::clone(&writer.bytes).try_acquire_many_owned(bytes).ok());
        let sent = permit.and_then(|permit| writer.recordings.try_send((recording, permit)).ok());
        if sent.is_none() {
            writer.outcomes.with_label_values(&["dropped"]).inc();
        }
    }
}

/// Writes recordings until the sender is dropped.
fn write(mut files: Files, recordings: &Receiver<Waiting>, outcomes: &IntCounterVec) {
    while let Ok((recording, _permit)) = recordings.recv() {
        let written = files.write(&recording);
        if let Err(error) = &written {
            warn!(%error, folder = %files.folder.display(), "cannot write a recording");
        }
        outcomes.with_label_values(&[if written.is_ok() { "written" } else { "failed" }]).inc();
    }
}

/// The files of the folder.
struct Files {
    folder: PathBuf,
    capacity: u64,
    /// Name and size of each file, the oldest first.
    known: VecDeque<(PathBuf, u64)>,
    bytes: u64,
    next: u64,
}

impl Files {
    /// Creates the folder if it is missing.
    fn open(folder: &Path, capacity: u64) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let mut known = Vec::new();
        for entry in fs::read_dir(folder)? {
            let path = entry?.path();
            match path.extension().and_then(|extension| extension.to_str()) {
                Some(EXTENSION) => known.push((path.clone(), fs::metadata(&path)?.len())),
                // Left over from a process that was killed.
                Some(PARTIAL) => fs::remove_file(&path)?,
                _ => {}
            }
        }
        // The names begin with the time.
        known.sort();
        let bytes = known.iter().map(|(_, bytes)| bytes).sum();
        let mut files = Self { folder: folder.to_owned(), capacity, known: known.into(), bytes, next: 0 };
        files.remove_oldest()?;
        Ok(files)
    }

    fn write(&mut self, recording: &pb::Recording) -> io::Result<()> {
        let bytes = recording.encode_to_vec();
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        let path = self.folder.join(format!("{now:019}-{:06}.{EXTENSION}", self.next));
        self.next += 1;
        let partial = path.with_extension(PARTIAL);
        // Other users of the machine must not read the scenes of a robot.
        let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&partial)?;
        if let Err(error) = file.write_all(&bytes).and_then(|()| fs::rename(&partial, &path)) {
            let _ = fs::remove_file(&partial);
            return Err(error);
        }
        let size = bytes.len() as u64;
        self.known.push_back((path, size));
        self.bytes += size;
        self.remove_oldest()
    }

    fn remove_oldest(&mut self) -> io::Result<()> {
        while self.bytes > self.capacity
            && let Some((oldest, bytes)) = self.known.pop_front()
        {
            // Subtracted although the removal may fail: then the next one is removed instead.
            self.bytes -= bytes;
            match fs::remove_file(oldest) {
                // It was already removed.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                removed => removed?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_is_bounded_and_the_newest_recordings_stay() {
        let folder = std::env::temp_dir().join(format!("graspd-recordings-{}", std::process::id()));
        let recording = |id: &str| pb::Recording {
            request: Some(Request::Volume(pb::DetectGraspsRequest {
                request_id: id.repeat(100),
                ..Default::default()
            })),
            ..Default::default()
        };
        let ids = || {
            let mut paths: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
            paths.sort();
            let read = |path: &PathBuf| pb::Recording::decode(&*fs::read(path).unwrap()).unwrap();
            let id = |recording: pb::Recording| match recording.request {
                Some(Request::Volume(request)) => request.request_id[..1].to_owned(),
                other => panic!("{other:?}"),
            };
            paths.iter().map(read).map(id).collect::<String>()
        };
        let mut files = Files::open(&folder, 350).unwrap();
        for id in ["a", "b", "c", "d", "e"] {
            files.write(&recording(id)).unwrap();
        }
        assert_eq!(ids(), "cde");
        fs::write(folder.join("0.part"), "").unwrap();
        // A later process continues with a smaller folder.
        let mut files = Files::open(&folder, 250).unwrap();
        assert_eq!(ids(), "de");
        files.write(&recording("f")).unwrap();
        assert_eq!(ids(), "ef");
        fs::remove_dir_all(&folder).unwrap();
    }
}
