//! Authentication and encryption: TLS, client certificates and tokens.

use std::fs;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use grasp::Volume;
use grasp_client::{Access, Certificate, Client, Error, Health, Identity, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp, graspd};
use nalgebra::Isometry3;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use tempfile::TempDir;
use time::OffsetDateTime;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{self, ClientConfig, RootCertStore};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

/// A CA, and a folder with its certificates and keys.
struct Authority {
    issuer: CertifiedIssuer<'static, KeyPair>,
    folder: TempDir,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new([]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        let authority = Self { issuer, folder: tempfile::tempdir().unwrap() };
        fs::write(authority.file("ca.pem"), authority.issuer.pem()).unwrap();
        authority
    }

    /// Writes `NAME.pem` and `NAME.key`.
    fn sign(&self, name: &str) -> Identity {
        self.sign_until(name, 365)
    }

    /// The same, for a certificate that expires in this many days.
    fn sign_until(&self, name: &str, days: i64) -> Identity {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
        params.not_after = OffsetDateTime::now_utc() + time::Duration::days(days);
        let certificate = params.signed_by(&key, &self.issuer).unwrap().pem();
        fs::write(self.file(&format!("{name}.pem")), &certificate).unwrap();
        fs::write(self.file(&format!("{name}.key")), key.serialize_pem()).unwrap();
        Identity::from_pem(certificate, key.serialize_pem())
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn path(&self, name: &str) -> String {
        self.file(name).to_str().unwrap().to_owned()
    }

    /// A connection over TLS.
    async fn connect(&self, address: SocketAddr) -> std::io::Result<TlsStream<TcpStream>> {
        let mut roots = RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(self.issuer.pem().as_bytes()).unwrap()).unwrap();
        let config = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()));
        let config = config.with_safe_default_protocol_versions().unwrap();
        let config = config.with_root_certificates(roots).with_no_client_auth();
        let stream = TcpStream::connect(address).await?;
        let name = ServerName::try_from("localhost").unwrap();
        TlsConnector::from(Arc::new(config)).connect(name, stream).await
    }

    fn access(&self) -> Access {
        Access { ca: Some(Certificate::from_pem(self.issuer.pem())), ..Access::default() }
    }
}

async fn detects(server: &Server, access: Access) -> Result<usize, Error> {
    let client = Client::connect_with(server.grpc().to_string(), access).await?;
    Ok(client.detect(&volume(), Options::default()).await?.grasps.len())
}

/// The status of an HTTP request over TLS, with these lines in its header.
async fn https(authority: &Authority, address: SocketAddr, path: &str, header: &str) -> std::io::Result<u16> {
    let mut stream = authority.connect(address).await?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{header}\r\n");
    stream.write_all(request.as_bytes()).await?;
    let mut response = String::new();
    stream.read_to_string(&mut response).await?;
    let status = response.split(' ').nth(1).and_then(|status| status.parse().ok());
    Ok(status.expect("a response has a status line"))
}

#[tokio::test]
async fn rest_has_the_tls_and_the_tokens_of_grpc() {
    let authority = Authority::new();
    authority.sign("server");
    authority.sign("client");
    fs::write(authority.file("tokens"), "secret\n").unwrap();
    let (cert, key, tokens) = (authority.path("server.pem"), authority.path("server.key"), authority.path("tokens"));
    let flags = ["--rest", "127.0.0.1:0", "--tls-cert", &cert, "--tls-key", &key, "--token-file", &tokens];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    let rest = server.rest().unwrap();
    for (path, header, status) in [
        ("/v2/health/ready", "", 200),
        ("/v2/models/mirror", "", 401),
        ("/v2/models/mirror", "Authorization: Bearer wrong\r\n", 401),
        ("/v2/models/mirror", "Authorization: Bearer secret\r\n", 200),
    ] {
        assert_eq!(https(&authority, rest, path, header).await.unwrap(), status, "{path} {header}");
    }
    assert!(https(&Authority::new(), rest, "/v2/health/live", "").await.is_err(), "another CA");
    assert_eq!(server.metric("graspd_requests_total{code=\"UNAUTHENTICATED\",model=\"\"}"), 2.0);
    drop(server);

    let ca = authority.path("ca.pem");
    let flags = ["--rest", "127.0.0.1:0", "--tls-cert", &cert, "--tls-key", &key, "--tls-client-ca", &ca];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    let rest = server.rest().unwrap();
    assert!(https(&authority, rest, "/v2/health/live", "").await.is_err(), "without a client certificate");
}

#[tokio::test]
async fn tls_needs_the_ca_of_the_server() {
    let authority = Authority::new();
    authority.sign("server");
    let flags = ["--tls-cert", &authority.path("server.pem"), "--tls-key", &authority.path("server.key")];
    let server = Server::run(&[TestModel::new("mirror")], &flags);
    assert_eq!(detects(&server, authority.access()).await.unwrap(), 1);
    assert!(detects(&server, Authority::new().access()).await.is_err());
    assert!(detects(&server, Access::default()).await.is_err(), "without TLS");

    let output = Command::new(grasp())
        .args(["--server", &server.grpc().to_string(), "--tls-ca", &authority.path("ca.pem"), "health"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let output = Command::new(grasp())
        .args(["--server", &server.grpc().to_string(), "--tls-ca", &authority.path("server.key"), "health"])
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(error.contains("server.key has no certificate in PEM"), "{error}");
}

#[tokio::test]
async fn a_client_that_is_silent_after_the_tls_handshake_is_disconnected() {
    let authority = Authority::new();
    authority.sign("server");
    let (cert, key) = (authority.path("server.pem"), authority.path("server.key"));
    let server =
        Server::run(&[TestModel::new("mirror")], &["--tls-cert", &cert, "--tls-key", &key, "--stall-timeout", "0.5"]);
    let mut silent = [authority.connect(server.grpc()).await.unwrap(), authority.connect(server.grpc()).await.unwrap()];
    silent[1].write_all(b"PRI * HTTP/2.0").await.unwrap();
    server.wait_for("graspd_connections{listener=\"grpc\"}", 2.0).await;
    server.wait_for("graspd_connections{listener=\"grpc\"}", 0.0).await;
    // After the preface a connection may stay idle.
    let client = Client::connect_with(server.grpc().to_string(), authority.access()).await.unwrap();
    client.health().await.unwrap();
    tokio::time::sleep(Duration::from_millis(900)).await;
    assert_eq!(server.metric("graspd_connections{listener=\"grpc\"}"), 1.0);
    client.health().await.unwrap();
}

#[tokio::test]
async fn mutual_tls_needs_a_client_certificate_of_the_ca() {
    let (authority, other) = (Authority::new(), Authority::new());
    authority.sign("server");
    let flags = [
        ["--tls-cert", &authority.path("server.pem")],
        ["--tls-key", &authority.path("server.key")],
        ["--tls-client-ca", &authority.path("ca.pem")],
    ];
    let server = Server::run(&[TestModel::new("mirror")], flags.as_flattened());
    let with = |identity| Access { identity, ..authority.access() };
    assert_eq!(detects(&server, with(Some(authority.sign("robot")))).await.unwrap(), 1);
    assert!(detects(&server, with(None)).await.is_err());
    assert!(detects(&server, with(Some(other.sign("robot")))).await.is_err());
}

#[tokio::test]
async fn requests_need_a_valid_token_and_sighup_reloads_the_tokens() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tokens");
    fs::write(&file, "first-secret\n").unwrap();
    let server = Server::run(&[TestModel::new("mirror")], &["--token-file", file.to_str().unwrap(), "--watch", "0"]);
    let with = |token: &str| Access { token: Some(token.parse().unwrap()), ..Access::default() };
    let refused = |error: Error| {
        assert_eq!(error.code(), Some(Code::Unauthenticated), "{error}");
        assert!(!error.to_string().contains("secret"), "{error}");
    };
    assert_eq!(detects(&server, with("first-secret")).await.unwrap(), 1);
    refused(detects(&server, with("other-secret")).await.unwrap_err());
    refused(detects(&server, Access::default()).await.unwrap_err());
    assert_eq!(server.metric("graspd_requests_total{code=\"UNAUTHENTICATED\",model=\"\"}"), 2.0);

    // Health checks need no token; the list of models does.
    let client = server.client().await;
    assert_eq!(client.health().await.unwrap(), Health::Serving);
    refused(client.list_models().await.unwrap_err());

    // A stream that is opened with the first token.
    let client = Client::connect_with(server.grpc().to_string(), with("first-secret")).await.unwrap();
    let (send, requests) = mpsc::channel(1);
    send.send((volume(), Options::default())).await.unwrap();
    let mut replies = client.detect_stream(ReceiverStream::new(requests)).await.unwrap();
    assert_eq!(replies.next().await.unwrap().unwrap().grasps.len(), 1);

    // First both tokens are valid, then only the new one. A missing file keeps the tokens.
    for (text, good) in [("first-secret\nnew-secret\n", true), ("new-secret\n", false)] {
        fs::write(&file, text).unwrap();
        let reloads = server.metric("graspd_reloads_total{outcome=\"ok\"}");
        server.reload().unwrap();
        server.wait_for("graspd_reloads_total{outcome=\"ok\"}", reloads + 1.0).await;
        let applied = async {
            while detects(&server, with("new-secret")).await.is_err()
                || detects(&server, with("first-secret")).await.is_ok() != good
            {
                tokio::task::yield_now().await;
            }
        };
        timeout(Duration::from_secs(60), applied).await.expect("the file is reloaded");
    }
    send.send((volume(), Options::default())).await.unwrap();
    refused(replies.next().await.unwrap().unwrap_err());

    fs::remove_file(&file).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 3.0).await;
    assert_eq!(detects(&server, with("new-secret")).await.unwrap(), 1);

    let output = Command::new(grasp())
        .args(["--server", &server.grpc().to_string(), "models"])
        .env("GRASP_TOKEN_FILE", &file)
        .output()
        .unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot read"), "the error names the missing file");
}

#[test]
fn incomplete_or_invalid_settings_are_errors() {
    let authority = Authority::new();
    authority.sign("server");
    let (cert, key) = (authority.path("server.pem"), authority.path("server.key"));
    for (flags, error) in [
        (vec!["--tls-cert", &cert], "--tls-key (GRASPD_TLS_KEY) is missing"),
        (vec!["--tls-client-ca", &cert], "--tls-cert (GRASPD_TLS_CERT) is missing"),
        (
            vec!["--tls-cert", "/no/such.pem", "--tls-key", &key],
            "--tls-cert (GRASPD_TLS_CERT) is `/no/such.pem`: No such file",
        ),
        (
            vec!["--token-file", "/dev/null"],
            "--token-file (GRASPD_TOKEN_FILE) is `/dev/null`: /dev/null contains no token",
        ),
        (vec!["--stall-timeout", "soon"], "--stall-timeout (GRASPD_STALL_TIMEOUT) is `soon`"),
        (vec!["--stall-timeout", "0"], "--stall-timeout (GRASPD_STALL_TIMEOUT) is `0`: must be greater than 0"),
        (vec!["--drain-timeout", "1e19"], "--drain-timeout (GRASPD_DRAIN_TIMEOUT) is `1e19`"),
    ] {
        let output = Command::new(graspd()).args(&flags).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(text.contains(error), "`{error}` is missing from:\n{text}");
    }
    // These are found before the models are loaded.
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let other = Authority::new();
    other.sign("server");
    let other_key = other.path("server.key");
    for (cert, key, ca, error) in [
        (&key, &key, None, "cannot read --tls-cert: it contains no certificate"),
        (&cert, &other_key, None, "KeyMismatch"),
        (&cert, &cert, None, "cannot use the files"),
        (&cert, &key, Some(&key), "cannot read --tls-client-ca: it contains no certificate"),
    ] {
        let mut command = Command::new(graspd());
        command.args(["--models".as_ref(), folder.path().as_os_str()]).env("ORT_DYLIB_PATH", "/no/such.so");
        command.args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--tls-cert", cert, "--tls-key", key]);
        if let Some(ca) = ca {
            command.args(["--tls-client-ca", ca]);
        }
        let output = command.output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{text}");
        let files = "--tls-cert (GRASPD_TLS_CERT) and the other TLS files cannot be used";
        assert!(text.contains(files) && text.contains(error), "{text}");
    }
    let mut command = Command::new(graspd());
    command.args(["--models".as_ref(), folder.path().as_os_str()]).args(["--max-batch", "64"]);
    let text = String::from_utf8(command.output().unwrap().stderr).unwrap();
    assert!(text.contains("--max-batch (GRASPD_MAX_BATCH) is `64`: must be at most --queue, 32"), "{text}");
}

/// The log of a server with these flags and variables, which cannot load ONNX Runtime and so ends at once.
fn log_of_start(flags: &[&str], variables: &[(&str, &str)]) -> String {
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let mut command = Command::new(graspd());
    command.args(["--models".as_ref(), folder.path().as_os_str()]).args(flags);
    command.envs(variables.iter().copied()).env("ORT_DYLIB_PATH", graspd());
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn unknown_variables_are_named_and_the_reason_why_a_library_cannot_be_loaded() {
    let variables =
        [("GRASPD_THREAD", "2"), ("GRASPD_SERVICE_HOST", "10.0.0.1"), ("GRASPD_PORT_50051_TCP", "tcp://10.0.0.1")];
    let log = log_of_start(&[], &variables);
    assert!(log.contains("unknown environment variable") && log.contains("GRASPD_THREAD"), "{log}");
    assert!(!log.contains("GRASPD_SERVICE_HOST") && !log.contains("GRASPD_PORT"), "{log}");
    // The dynamic linker's words.
    assert!(log.contains("cannot dynamically load position-independent executable"), "{log}");
}

#[tokio::test]
async fn the_end_of_a_certificate_is_a_metric_and_a_warning() {
    let authority = Authority::new();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    for (name, days, warning) in [("old", -1, "has expired"), ("soon", 10, "expires soon"), ("new", 100, "")] {
        authority.sign_until(name, days);
        let (cert, key) = (authority.path(&format!("{name}.pem")), authority.path(&format!("{name}.key")));
        let flags = ["--tls-cert", &cert, "--tls-key", &key];
        let server = Server::run(&[TestModel::new("mirror")], &flags);
        let left = server.metric("graspd_certificate_expiry_seconds") - now;
        assert!((left - days as f64 * 86_400.0).abs() < 3600.0, "{name}: {left}");
        let log = log_of_start(&flags, &[]);
        assert_eq!(log.contains("the certificate of --tls-cert"), !warning.is_empty(), "{log}");
        assert!(log.contains(warning), "{log}");
    }
}
