use std::ffi::OsStr;
use std::io::{self, BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use thiserror::Error;

/// A graspd of one's own, on free ports of the loopback interface. Dropping it kills it; [`stop`](Self::stop) lets it
/// finish.
#[derive(Debug)]
pub struct LocalServer {
    process: Child,
    stdout: BufReader<ChildStdout>,
    grpc: SocketAddr,
    http: SocketAddr,
}

/// Why there is no server.
#[derive(Debug, Error)]
pub enum LocalServerError {
    /// The program cannot be run.
    #[error("cannot run {}: {source}", binary.display())]
    Spawn {
        /// The program.
        binary: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It ended before it was ready.
    #[error("graspd ended before it was ready ({0}); its log, on stderr, says why")]
    Ended(ExitStatus),
    /// It wrote something else than where it listens.
    #[error("graspd wrote `{0}` to stdout, which is not what this client expects: are both of one version?")]
    Unexpected(String),
    /// Its output cannot be read.
    #[error("cannot read what graspd writes: {0}")]
    Io(#[from] io::Error),
}

impl LocalServer {
    /// Runs `binary` with `args`, and returns once it is ready. Its log goes to this process's stderr.
    ///
    /// # Errors
    /// [`LocalServerError`] when it cannot be run or ends before it is ready.
    pub fn spawn<A: AsRef<OsStr>>(binary: &Path, args: impl IntoIterator<Item = A>) -> Result<Self, LocalServerError> {
        let mut server = Self::start(binary, args)?;
        server.wait_ready()?;
        Ok(server)
    }

    /// Like [`spawn`](Self::spawn), but returns as soon as it listens, while it still warms up.
    ///
    /// # Errors
    /// [`LocalServerError`] when it cannot be run or ends before it listens.
    pub fn start<A: AsRef<OsStr>>(binary: &Path, args: impl IntoIterator<Item = A>) -> Result<Self, LocalServerError> {
        let mut process = Command::new(binary)
            .args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"])
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|source| LocalServerError::Spawn { binary: binary.to_owned(), source })?;
        let stdout = process.stdout.take().expect("it was asked for two lines above");
        let nowhere = SocketAddr::from(([0, 0, 0, 0], 0));
        let mut server = Self { process, stdout: BufReader::new(stdout), grpc: nowhere, http: nowhere };
        server.grpc = server.read_address("grpc listening on ")?;
        server.http = server.read_address("http listening on ")?;
        Ok(server)
    }

    /// Waits until it has warmed up.
    ///
    /// # Errors
    /// [`LocalServerError`] when it ends before.
    pub fn wait_ready(&mut self) -> Result<(), LocalServerError> {
        match self.read_line()? {
            line if line == "ready" => Ok(()),
            line => Err(LocalServerError::Unexpected(line)),
        }
    }

    /// Where it speaks gRPC.
    #[must_use]
    pub fn grpc(&self) -> SocketAddr {
        self.grpc
    }

    /// Where it has its metrics.
    #[must_use]
    pub fn http(&self) -> SocketAddr {
        self.http
    }

    /// Its process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// Tells it to finish what it has taken and to end: SIGTERM.
    ///
    /// # Errors
    /// What the system says, which is nothing as long as the process has not been waited for.
    pub fn terminate(&self) -> io::Result<()> {
        Ok(kill_process(Pid::from_child(&self.process), Signal::TERM)?)
    }

    /// Tells it to read its models anew: SIGHUP.
    ///
    /// # Errors
    /// What the system says, which is nothing as long as the process has not been waited for.
    pub fn reload(&self) -> io::Result<()> {
        Ok(kill_process(Pid::from_child(&self.process), Signal::HUP)?)
    }

    /// Waits for it to end.
    ///
    /// # Errors
    /// What the system says.
    pub fn wait(&mut self) -> io::Result<ExitStatus> {
        self.process.wait()
    }

    /// Tells it to end, and waits until it has.
    ///
    /// # Errors
    /// What the system says.
    pub fn stop(mut self) -> io::Result<ExitStatus> {
        self.terminate()?;
        self.wait()
    }

    fn read_address(&mut self, prefix: &str) -> Result<SocketAddr, LocalServerError> {
        let line = self.read_line()?;
        let address = line.strip_prefix(prefix).and_then(|address| address.parse().ok());
        address.ok_or(LocalServerError::Unexpected(line))
    }

    fn read_line(&mut self) -> Result<String, LocalServerError> {
        let mut line = String::new();
        if self.stdout.read_line(&mut line)? == 0 {
            return Err(LocalServerError::Ended(self.process.wait()?));
        }
        Ok(line.trim_end().to_owned())
    }
}

impl Drop for LocalServer {
    fn drop(&mut self) {
        // It may have ended by itself, which is as good.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
