use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::{Deref, DerefMut};

use grasp_client::{Client, LocalServer};
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use tempfile::TempDir;
use tonic::transport::Channel;

use crate::{TestModel, graspd};

/// A graspd with its own folder of models, for one test.
pub struct Server {
    process: LocalServer,
    models: TempDir,
}

impl Server {
    /// Runs graspd with these models and flags, and returns once it is ready.
    ///
    /// # Panics
    /// If graspd does not become ready.
    #[must_use]
    pub fn run(models: &[TestModel], args: &[&str]) -> Self {
        let mut server = Self::start(models, args);
        server.wait_ready().expect("graspd becomes ready");
        server
    }

    /// Like [`run`](Self::run), but returns during the warm-up.
    ///
    /// # Panics
    /// If graspd does not start.
    #[must_use]
    pub fn start(models: &[TestModel], args: &[&str]) -> Self {
        assert!(
            std::env::var_os("ORT_DYLIB_PATH").is_some(),
            "ORT_DYLIB_PATH is not set: run the tests by `make test`"
        );
        let folder = tempfile::tempdir().expect("a temporary folder can be created");
        for model in models {
            model.write(folder.path());
        }
        let path = folder.path().to_str().expect("the path of a temporary folder is UTF-8").to_owned();
        // On ONNX Runtime's `cpu` the outputs of the test models are known to the last bit.
        let provider: &[&str] = if args.contains(&"--provider") { &[] } else { &["--provider", "cpu"] };
        let fixed = ["--models", &path, "--threads", "1"].into_iter();
        let args = fixed.chain(provider.iter().copied()).chain(args.iter().copied());
        let process = LocalServer::start(graspd(), args).expect("graspd starts");
        Self { process, models: folder }
    }

    /// A client of `grasp-client`, connected to this server.
    ///
    /// # Panics
    /// If the server does not accept the connection.
    pub async fn client(&self) -> Client {
        Client::connect(self.grpc().to_string()).await.expect("graspd listens")
    }

    /// A connection for requests that the client library cannot send.
    ///
    /// # Panics
    /// If the server does not accept the connection.
    pub async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(format!("http://{}", self.grpc())).expect("an address is a URI");
        endpoint.connect().await.expect("graspd listens")
    }

    /// The client that is generated from the .proto file.
    ///
    /// # Panics
    /// If the server does not accept the connection.
    pub async fn raw(&self) -> GraspServiceClient<Channel> {
        GraspServiceClient::new(self.channel().await)
    }

    /// The status and the body of an HTTP page.
    ///
    /// # Panics
    /// If there is no response.
    #[must_use]
    pub fn get(&self, path: &str) -> (u16, String) {
        get(self.http(), path)
    }

    /// The value of one metric, as in [`metric`].
    ///
    /// # Panics
    /// If the metrics cannot be read.
    #[must_use]
    pub fn metric(&self, series: &str) -> f64 {
        metric(self.http(), series)
    }

    /// Waits until a metric has a value.
    ///
    /// # Panics
    /// If the metric does not have the value within a minute.
    pub async fn wait_for(&self, series: &str, value: f64) {
        self.wait_until(series, |now| now == value).await;
    }

    /// Waits until a metric has a value that fits, and returns it.
    ///
    /// # Panics
    /// If that takes a minute.
    pub async fn wait_until(&self, series: &str, fits: impl Fn(f64) -> bool) -> f64 {
        for _ in 0..6000 {
            let value = self.metric(series);
            if fits(value) {
                return value;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
        panic!("{series} is {}", self.metric(series));
    }

    /// The folder of the models.
    #[must_use]
    pub fn models(&self) -> &std::path::Path {
        self.models.path()
    }
}

/// The value of one metric of a graspd, or 0 if it does not exist. `series` is in Prometheus' notation, with sorted
/// labels.
///
/// # Panics
/// If the metrics cannot be read.
#[must_use]
pub fn metric(http: SocketAddr, series: &str) -> f64 {
    let (status, text) = get(http, "/metrics");
    assert_eq!(status, 200);
    let value = text.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
    value.map_or(0.0, |value| value.parse().expect("a metric is a number"))
}

fn get(http: SocketAddr, path: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(http).expect("graspd listens");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: graspd\r\nConnection: close\r\n\r\n")
        .expect("the request can be written");
    let mut response = String::new();
    stream.read_to_string(&mut response).expect("the response can be read");
    let (head, body) = response.split_once("\r\n\r\n").expect("a response has a head and a body");
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok());
    (status.expect("a response has a status line"), body.to_owned())
}

/// The resident memory of a process, bytes.
///
/// # Panics
/// If the process has ended, or if the system is not Linux.
#[must_use]
pub fn resident_bytes(process: u32) -> u64 {
    memory(process, "VmRSS:")
}

/// The largest resident memory that a process has had, bytes.
///
/// # Panics
/// If the process has ended, or if the system is not Linux.
#[must_use]
pub fn peak_bytes(process: u32) -> u64 {
    memory(process, "VmHWM:")
}

fn memory(process: u32, field: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("the process runs on Linux");
    let value = status.lines().find_map(|line| line.strip_prefix(field));
    let kilobytes = value.and_then(|value| value.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kilobytes.expect("the field is a number of kB") * 1024
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
