//! Authentication and encryption: TLS, client certificates and tokens.

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use grasp::Volume;
use grasp_client::{Access, Certificate, Client, Error, Health, Identity, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp, graspd};
use nalgebra::Isometry3;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use tempfile::TempDir;
use tokio::time::timeout;
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
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
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

    fn access(&self) -> Access {
        Access { ca: Some(Certificate::from_pem(self.issuer.pem())), ..Access::default() }
    }
}

async fn detects(server: &Server, access: Access) -> Result<usize, Error> {
    let client = Client::connect_with(server.grpc().to_string(), access).await?;
    Ok(client.detect(&volume(), Options::default()).await?.grasps.len())
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
    fs::remove_file(&file).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 3.0).await;
    assert_eq!(detects(&server, with("new-secret")).await.unwrap(), 1);

    let output = Command::new(grasp())
        .args(["--server", &server.grpc().to_string(), "models"])
        .env("GRASPD_TOKEN_FILE", &file)
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
    // A key in place of a certificate is found only when TLS is set up.
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let output = Command::new(graspd())
        .args(["--models".as_ref(), folder.path().as_os_str()])
        .args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--tls-cert", &key, "--tls-key", &key])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("cannot use the files of --tls-cert, --tls-key and --tls-client-ca"), "{text}");
}
