use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::{Deref, DerefMut};

use grasp_client::{Client, LocalServer};
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use tempfile::TempDir;
use tonic::transport::Channel;

use crate::{TestModel, graspd};

/// A graspd with models of its own, for one test.
pub struct Server {
    process: LocalServer,
    models: TempDir,
}

impl Server {
    /// Runs graspd with these models and flags, and returns once it is ready.
    ///
    /// # Panics
    /// When it does not get ready.
    #[must_use]
    pub fn run(models: &[TestModel], args: &[&str]) -> Self {
        let mut server = Self::start(models, args);
        server.wait_ready().expect("graspd gets ready");
        server
    }

    /// Like [`run`](Self::run), but while it still warms up.
    ///
    /// # Panics
    /// When it does not start.
    #[must_use]
    pub fn start(models: &[TestModel], args: &[&str]) -> Self {
        assert!(
            std::env::var_os("ORT_DYLIB_PATH").is_some(),
            "ORT_DYLIB_PATH is not set: run the tests by `make test`"
        );
        let folder = tempfile::tempdir().expect("there is room for temporary files");
        for model in models {
            model.write(folder.path());
        }
        let path = folder.path().to_str().expect("temporary folders have plain names").to_owned();
        // The test models' answers are known to the last bit on the CPU.
        let provider: &[&str] = if args.contains(&"--provider") { &[] } else { &["--provider", "cpu"] };
        let fixed = ["--models", &path, "--threads", "1"].into_iter();
        let args = fixed.chain(provider.iter().copied()).chain(args.iter().copied());
        let process = LocalServer::start(graspd(), args).expect("graspd starts");
        Self { process, models: folder }
    }

    /// A client of the library under test.
    ///
    /// # Panics
    /// When the server is not there.
    pub async fn client(&self) -> Client {
        Client::connect(self.grpc().to_string()).await.expect("graspd listens")
    }

    /// A connection for what the client library cannot say.
    ///
    /// # Panics
    /// When the server is not there.
    pub async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(format!("http://{}", self.grpc())).expect("an address is a URI");
        endpoint.connect().await.expect("graspd listens")
    }

    /// The generated client.
    ///
    /// # Panics
    /// When the server is not there.
    pub async fn raw(&self) -> GraspServiceClient<Channel> {
        GraspServiceClient::new(self.channel().await)
    }

    /// The status and the body of an HTTP page.
    ///
    /// # Panics
    /// When there is no answer.
    #[must_use]
    pub fn get(&self, path: &str) -> (u16, String) {
        get(self.http(), path)
    }

    /// The value of one metric, as [`metric`] has it.
    ///
    /// # Panics
    /// When the metrics cannot be read.
    #[must_use]
    pub fn metric(&self, series: &str) -> f64 {
        metric(self.http(), series)
    }

    /// Waits until a metric has a value.
    ///
    /// # Panics
    /// When it has not got it within a minute.
    pub async fn wait_for(&self, series: &str, value: f64) {
        for _ in 0..6000 {
            if self.metric(series) == value {
                return;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
        panic!("{series} is {}, not {value}", self.metric(series));
    }

    /// The folder of its models.
    #[must_use]
    pub fn models(&self) -> &std::path::Path {
        self.models.path()
    }
}

/// The value of one metric of a graspd, 0 as long as it has none; `series` as Prometheus writes it, labels in their order.
///
/// # Panics
/// When the metrics cannot be read.
#[must_use]
pub fn metric(http: SocketAddr, series: &str) -> f64 {
    let (status, text) = get(http, "/metrics");
    assert_eq!(status, 200);
    let value = text.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
    value.map_or(0.0, |value| value.parse().expect("a metric is a number"))
}

fn get(http: SocketAddr, path: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(http).expect("graspd listens");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: graspd\r\nConnection: close\r\n\r\n").expect("it reads");
    let mut response = String::new();
    stream.read_to_string(&mut response).expect("it answers");
    let (head, body) = response.split_once("\r\n\r\n").expect("a head and a body");
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok());
    (status.expect("a status line"), body.to_owned())
}

/// The memory that a process has in use.
///
/// # Panics
/// When it does not run, or not on Linux.
#[must_use]
pub fn resident_bytes(process: u32) -> u64 {
    memory(process, "VmRSS:")
}

/// The most memory that a process ever had in use.
///
/// # Panics
/// When it does not run, or not on Linux.
#[must_use]
pub fn peak_bytes(process: u32) -> u64 {
    memory(process, "VmHWM:")
}

fn memory(process: u32, field: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("the process runs, on Linux");
    let value = status.lines().find_map(|line| line.strip_prefix(field));
    let kilobytes = value.and_then(|value| value.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kilobytes.expect("a number of kB") * 1024
}

impl Deref for Server {
    type Target = LocalServer;

    fn deref(&self) -> &LocalServer {
        &self.process
    }
}

impl DerefMut for Server {
    fn deref_mut(&mut self) -> &mut LocalServer {
        &mut self.process
    }
}
