use std::ffi::OsStr;
use std::io::{self, BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use thiserror::Error;

/// A graspd child process on free ports of the loopback interface. Dropping it kills the process;
/// [`stop`](Self::stop) shuts it down gracefully.
#[derive(Debug)]
pub struct LocalServer {
    process: Child,
    stdout: BufReader<ChildStdout>,
    grpc: SocketAddr,
    http: SocketAddr,
    rest: Option<SocketAddr>,
}

/// Why a local server could not be started.
#[derive(Debug, Error)]
pub enum LocalServerError {
    /// The program cannot be started.
    #[error("cannot run {}: {source}", binary.display())]
    Spawn {
        /// The program.
        binary: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The process exited before it was ready.
    #[error("graspd exited before it was ready ({0}); see its log on stderr")]
    Ended(ExitStatus),
    /// The process wrote an unexpected line to stdout.
    #[error("unexpected output `{0}` of graspd; check that client and server have the same version")]
    Unexpected(String),
    /// The output of the process cannot be read.
    #[error("cannot read the output of graspd: {0}")]
    Io(#[from] io::Error),
}

impl LocalServer {
    /// Runs `binary` with `args` and returns when the server is ready. The server logs to this process's stderr.
    ///
    /// # Errors
    /// [`LocalServerError`] when the program cannot be started or exits before it is ready.
    pub fn spawn<A: AsRef<OsStr>>(binary: &Path, args: impl IntoIterator<Item = A>) -> Result<Self, LocalServerError> {
        let mut server = Self::start(binary, args)?;
        server.wait_ready()?;
        Ok(server)
    }

    /// Like [`spawn`](Self::spawn), but returns as soon as the server listens, before its models are warm.
    ///
    /// # Errors
    /// [`LocalServerError`] when the program cannot be started or exits before it listens.
    pub fn start<A: AsRef<OsStr>>(binary: &Path, args: impl IntoIterator<Item = A>) -> Result<Self, LocalServerError> {
        let mut process = Command::new(binary)
            .args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"])
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|source| LocalServerError::Spawn { binary: binary.to_owned(), source })?;
        let stdout = process.stdout.take().expect("stdout is piped, see above");
        let unset = SocketAddr::from(([0, 0, 0, 0], 0));
        let mut server = Self { process, stdout: BufReader::new(stdout), grpc: unset, http: unset, rest: None };
        server.grpc = server.read_address("grpc listening on ")?;
        server.http = server.read_address("http listening on ")?;
        Ok(server)
    }

    /// Blocks until the server is ready.
    ///
    /// # Errors
    /// [`LocalServerError`] when the process exits before it is ready.
    pub fn wait_ready(&mut self) -> Result<(), LocalServerError> {
        loop {
            let line = self.read_line()?;
            if line == "ready" {
                return Ok(());
            }
            let address = line.strip_prefix("rest listening on ").and_then(|address| address.parse().ok());
            self.rest = Some(address.ok_or(LocalServerError::Unexpected(line))?);
        }
    }

    /// Address of the gRPC service.
    #[must_use]
    pub fn grpc(&self) -> SocketAddr {
        self.grpc
    }

    /// Address of the HTTP server with the metrics.
    #[must_use]
    pub fn http(&self) -> SocketAddr {
        self.http
    }

    /// Address of the REST listener, if the server is ready and has one (`--rest`).
    #[must_use]
    pub fn rest(&self) -> Option<SocketAddr> {
        self.rest
    }

    /// Process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// Requests a graceful shutdown (SIGTERM): the server completes accepted requests and exits.
    ///
    /// # Errors
    /// The system's error if the signal cannot be sent.
    pub fn terminate(&self) -> io::Result<()> {
        Ok(kill_process(Pid::from_child(&self.process), Signal::TERM)?)
    }

    /// Makes the server reload its models (SIGHUP).
    ///
    /// # Errors
    /// The system's error if the signal cannot be sent.
    pub fn reload(&self) -> io::Result<()> {
        Ok(kill_process(Pid::from_child(&self.process), Signal::HUP)?)
    }

    /// Blocks until the process exits.
    ///
    /// # Errors
    /// The system's error.
    pub fn wait(&mut self) -> io::Result<ExitStatus> {
        self.process.wait()
    }

    /// Shuts the server down gracefully and blocks until the process exits.
    ///
    /// # Errors
    /// The system's error.
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
        // Both fail harmlessly if the process has already exited.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
