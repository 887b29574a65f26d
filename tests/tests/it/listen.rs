//! The gRPC listener on a UNIX socket.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use grasp_client::{Client, Options};
use grasp_tests::{RESOLUTION, TestModel, blobs, grasp, graspd};
use nalgebra::Isometry3;

#[tokio::test(flavor = "multi_thread")]
async fn requests_are_answered_on_a_unix_socket_whose_file_is_removed_at_the_end() {
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let path = folder.path().join("graspd.sock");
    let address = format!("unix:{}", path.display());
    for _ in 0..2 {
        let mut server = Command::new(graspd())
            .args(["--models".as_ref(), folder.path().as_os_str()])
            .args(["--listen", &address, "--http", "127.0.0.1:0", "--provider", "cpu", "--log", "warn"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines: Vec<String> = BufReader::new(server.stdout.take().unwrap())
            .lines()
            .map(Result::unwrap)
            .take_while(|line| line != "ready")
            .collect();
        assert_eq!(lines[0], format!("grpc listening on {address}"));
        let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
        let client = Client::connect(&address).await.unwrap();
        assert_eq!(client.detect(&volume, Options::default()).await.unwrap().grasps.len(), 1);
        let models = Command::new(grasp()).args(["--server", &address, "models"]).output().unwrap();
        assert!(String::from_utf8_lossy(&models.stdout).contains("mirror"), "{models:?}");

        assert!(Command::new("kill").arg(server.id().to_string()).status().unwrap().success());
        // On another thread, because the client must answer the server's GOAWAY.
        assert!(tokio::task::spawn_blocking(move || server.wait()).await.unwrap().unwrap().success());
        assert!(!path.exists());
    }
}
