//! Changes of the model folder while the server runs.

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use grasp::Volume;
use grasp_client::{Client, DetectOptions, Options};
use grasp_models::onnx::ModelProto;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd, peak_bytes};
use nalgebra::Isometry3;
use tokio::task::JoinSet;

const NO_WATCH: &[&str] = &["--watch", "0"];
const WATCH: &[&str] = &["--watch", "0.05"];

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

/// The version that requests without a version use.
async fn newest(client: &Client) -> String {
    client.detect(&volume(), Options::default()).await.unwrap().version
}

/// The served networks, as `name version`.
async fn served(client: &Client) -> Vec<String> {
    let models = client.list_models().await.unwrap();
    models
        .into_iter()
        .filter(|model| model.resolution > 0)
        .map(|model| format!("{} {}", model.name, model.version))
        .collect()
}

#[tokio::test]
async fn sighup_loads_a_new_version_and_the_old_one_stays_available() {
    let server = Server::run(&[TestModel::new("mirror")], NO_WATCH);
    let client = server.client().await;
    TestModel::new("mirror").version("2").write(server.models());
    assert_eq!(newest(&client).await, "1");
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(newest(&client).await, "2");
    assert_eq!(served(&client).await, ["mirror 2", "mirror 1"]);
    let detect = DetectOptions { model: "mirror".into(), version: "1".into(), ..DetectOptions::default() };
    let old = Options { detect, ..Options::default() };
    assert_eq!(client.detect(&volume(), old).await.unwrap().version, "1");
}

#[tokio::test]
async fn a_watched_folder_is_reloaded_without_a_signal() {
    let server = Server::run(&[TestModel::new("mirror")], WATCH);
    let client = server.client().await;
    TestModel::new("mirror").version("2").write(server.models());
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(newest(&client).await, "2");
    fs::remove_file(server.models().join("mirror-1.onnx")).unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 2.0).await;
    assert_eq!(served(&client).await, ["mirror 2"]);
    let (_, metrics) = server.get("/metrics");
    let infos = metrics.lines().filter(|line| line.starts_with("graspd_model_info{"));
    assert_eq!(infos.filter(|line| line.contains("mirror")).count(), 1, "{metrics}");
}

#[tokio::test]
async fn the_default_file_selects_the_default_model() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("second")], WATCH);
    let client = server.client().await;
    assert_eq!(served(&client).await, ["mirror 1", "second 1"], "sorted by name without a default file");
    fs::write(server.models().join("default"), "second\n").unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(served(&client).await, ["second 1", "mirror 1"]);
    fs::write(server.models().join("default"), "missing").unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 2.0).await;
    assert_eq!(served(&client).await, ["mirror 1", "second 1"], "sorted by name if the default model is missing");
}

#[tokio::test]
async fn invalid_files_change_nothing_and_are_counted() {
    let server = Server::run(&[TestModel::new("mirror")], NO_WATCH);
    let client = server.client().await;
    let path = server.models().join("mirror-1.onnx");
    let whole = fs::read(&path).unwrap();
    let before = client.list_models().await.unwrap();

    let mut other_signature = whole.clone();
    let outputs = (0..whole.len()).filter(|&at| whole[at..].starts_with(b"quality"));
    outputs.for_each(|at| other_signature[at + 6] = b'x');
    let bad = [whole[..whole.len() / 2].to_vec(), other_signature, Vec::new()];
    for (failed, bytes) in bad.into_iter().enumerate() {
        fs::write(&path, bytes).unwrap();
        server.reload().unwrap();
        server.wait_for("graspd_reloads_total{outcome=\"failed\"}", failed as f64 + 1.0).await;
        assert_eq!(server.metric("graspd_rejected_files"), 1.0);
        assert_eq!(newest(&client).await, "1");
        assert_eq!(client.list_models().await.unwrap(), before);
    }
    // A valid network whose outputs are invalid.
    TestModel::new("mirror").breaks_at(0.0).write(server.models());
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 4.0).await;
    assert_eq!(newest(&client).await, "1");
    // A valid file beside the invalid one is served.
    TestModel::new("mirror").version("2").write(server.models());
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 5.0).await;
    assert_eq!(served(&client).await, ["mirror 2", "mirror 1"]);

    // With the file restored, the reload succeeds.
    fs::write(&path, whole).unwrap();
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(server.metric("graspd_rejected_files"), 0.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn only_regular_files_of_limited_size_with_short_names_are_loaded() {
    let server = Server::run(&[TestModel::new("mirror")], &["--watch", "0", "--max-model-bytes", "1000000"]);
    let client = server.client().await;
    let path = server.models().join("bad.onnx");
    let with_name = |name: &str| {
        TestModel::new("long").write(server.models());
        let written = server.models().join("long-1.onnx");
        let mut model = ModelProto::read(&written).unwrap();
        let property = model.metadata_props.iter_mut().find(|property| property.key() == "graspd.name").unwrap();
        property.value = Some(name.to_owned());
        model.write(&path).unwrap();
        fs::remove_file(written).unwrap();
    };
    let make: [&dyn Fn(); 7] = [
        &|| assert!(Command::new("mkfifo").arg(&path).status().unwrap().success()),
        &|| symlink("/dev/zero", &path).unwrap(),
        &|| fs::create_dir(&path).unwrap(),
        // A file of 100 GB that takes no space.
        &|| File::create(&path).unwrap().set_len(100 << 30).unwrap(),
        &|| with_name(&"x".repeat(129)),
        &|| with_name("two\nlines"),
        &|| with_name(&"x".repeat(500_000)),
    ];
    for (count, make) in make.into_iter().enumerate() {
        make();
        server.reload().unwrap();
        server.wait_for("graspd_reloads_total{outcome=\"failed\"}", count as f64 + 1.0).await;
        assert_eq!(server.metric("graspd_rejected_files"), 1.0);
        assert_eq!(served(&client).await, ["mirror 1"]);
        if path.is_dir() { fs::remove_dir(&path).unwrap() } else { fs::remove_file(&path).unwrap() }
    }
    with_name(&"x".repeat(128));
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(served(&client).await, ["mirror 1".to_owned(), format!("{} 1", "x".repeat(128))]);
    assert!(server.get("/metrics").1.len() < 1 << 20);
    assert!(peak_bytes(server.id()) < 200 << 20);
}

#[test]
fn a_default_file_that_is_a_link_does_not_show_the_content_of_another_file() {
    let folder = tempfile::tempdir().unwrap();
    TestModel::new("mirror").write(folder.path());
    let (secret, log) = (folder.path().join("token"), folder.path().join("log"));
    fs::write(&secret, "secret-token").unwrap();
    symlink(&secret, folder.path().join("default")).unwrap();
    let mut server = Command::new(graspd())
        .args(["--models".as_ref(), folder.path().as_os_str()])
        .args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--provider", "cpu"])
        .stdout(Stdio::piped())
        .stderr(File::create(&log).unwrap())
        .spawn()
        .unwrap();
    let lines = BufReader::new(server.stdout.take().unwrap()).lines();
    assert!(lines.map_while(Result::ok).any(|line| line == "ready"));
    // Not killed, so that the log is complete.
    assert!(Command::new("kill").arg(server.id().to_string()).status().unwrap().success());
    server.wait().unwrap();
    let log = fs::read_to_string(log).unwrap();
    assert!(log.contains("the model named by the file `default` is not served"), "{log}");
    assert!(!log.contains("secret-token"), "{log}");
}

#[tokio::test]
async fn a_reload_that_takes_too_long_is_reported_and_does_not_delay_the_next() {
    let server = Server::run(&[TestModel::new("mirror")], &["--watch", "0", "--reload-timeout", "0.2"]);
    let client = server.client().await;
    // Its warm-up takes seconds.
    TestModel::new("slow").convolutions(40).write(server.models());
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 1.0).await;
    assert_eq!(served(&client).await, ["mirror 1"]);
    fs::remove_file(server.models().join("slow-1.onnx")).unwrap();
    TestModel::new("mirror").version("2").write(server.models());
    server.reload().unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"ok\"}", 1.0).await;
    assert_eq!(served(&client).await, ["mirror 2", "mirror 1"]);
    // The first reload ends, and changes nothing.
    server.wait_for("graspd_reloads_total{outcome=\"superseded\"}", 1.0).await;
    assert_eq!(served(&client).await, ["mirror 2", "mirror 1"]);
}

#[tokio::test]
async fn a_folder_without_networks_changes_nothing() {
    let server = Server::run(&[TestModel::new("mirror")], WATCH);
    let client = server.client().await;
    fs::remove_file(server.models().join("mirror-1.onnx")).unwrap();
    server.wait_for("graspd_reloads_total{outcome=\"failed\"}", 1.0).await;
    assert_eq!(newest(&client).await, "1");
}

#[tokio::test]
async fn requests_succeed_while_models_are_replaced() {
    let model = TestModel::new("mirror").convolutions(2);
    let server = Server::run(std::slice::from_ref(&model), &["--watch", "0", "--queue", "16", "--workers", "2"]);
    let (stop, answered) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let mut callers = JoinSet::new();
    for _ in 0..4 {
        let (client, stop, answered) = (server.client().await, Arc::clone(&stop), Arc::clone(&answered));
        callers.spawn(async move {
            while !stop.load(Ordering::Relaxed) {
                let detection = client.detect(&volume(), Options::default()).await.unwrap();
                assert_eq!(detection.grasps.len(), 1);
                answered.fetch_add(1, Ordering::Relaxed);
            }
        });
    }
    for version in 2..8 {
        model.clone().version(&version.to_string()).write(server.models());
        fs::remove_file(server.models().join(format!("mirror-{}.onnx", version - 1))).unwrap();
        server.reload().unwrap();
        server.wait_for("graspd_reloads_total{outcome=\"ok\"}", f64::from(version) - 1.0).await;
        assert_eq!(newest(&server.client().await).await, version.to_string());
        let before = answered.load(Ordering::Relaxed);
        while answered.load(Ordering::Relaxed) < before + 20 {
            tokio::task::yield_now().await;
        }
    }
    stop.store(true, Ordering::Relaxed);
    callers.join_all().await;
    let count = |version: u32, code: &str| {
        server.metric(&format!("graspd_requests_total{{code=\"{code}\",model=\"mirror {version}\"}}"))
    };
    assert!((1..8).all(|version| count(version, "OK") > 0.0), "every version has answered requests");
    let waiting = |version: u32| server.metric(&format!("graspd_queue_requests{{model=\"mirror {version}\"}}"));
    assert!((1..8).all(|version| waiting(version) == 0.0));
}
