//! Recorded requests, and their repetition with `grasp replay`.

use std::path::Path;
use std::process::Command;

use grasp::Volume;
use grasp_client::{DetectOptions, Observation, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp};
use nalgebra::{Isometry3, Translation3};
use serde_json::Value;
use tokio_stream::StreamExt;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[4, 5, 6], [11, 10, 9]])
}

fn options(model: &str) -> Options {
    Options { detect: DetectOptions { model: model.to_owned(), ..DetectOptions::default() }, ..Options::default() }
}

/// Exit status and output of `grasp replay`.
fn replay(server: &Server, arguments: &[&str]) -> (Option<i32>, String) {
    let server = ["--server", &server.grpc().to_string()].map(str::to_owned);
    let output = Command::new(grasp()).arg("replay").args(arguments).args(server).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
    (output.status.code(), text)
}

fn count(folder: &Path) -> usize {
    std::fs::read_dir(folder).unwrap().count()
}

#[tokio::test]
async fn replayed_requests_show_what_a_new_model_changes() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = folder.path().join("recordings");
    let path = recordings.to_str().unwrap();
    let server = Server::run(&[TestModel::new("mirror")], &["--record", path]);
    let client = server.client().await;
    client.detect(&volume(), Options::default()).await.unwrap();
    let candidates = [Translation3::new(0.1, 0.1, 0.1).into()];
    client.score(Observation::Volume(&volume()), &candidates, Options::default()).await.unwrap();
    client.detect(&volume(), options("missing")).await.unwrap_err();
    let stream = tokio_stream::iter([(volume(), Options::default()), (volume(), Options::default())]);
    let mut replies = client.detect_stream(stream).await.unwrap();
    while let Some(reply) = replies.next().await {
        reply.unwrap();
    }
    server.wait_for("graspd_recordings_total{outcome=\"written\"}", 5.0).await;
    assert_eq!(count(&recordings), 5);

    let (status, text) = replay(&server, &[path]);
    assert!(text.contains("5 recordings: 5 same, 0 changed, 0 skipped; median inference"), "{text}");
    assert_eq!(status, Some(0));
    // The replayed requests were recorded, too.
    server.wait_for("graspd_recordings_total{outcome=\"written\"}", 10.0).await;
    drop(server);

    // Another rotation, and a model that was missing.
    let turned = TestModel::new("mirror").version("2").rotation([0.0, 0.0, 1.0, 0.0]);
    let other = Server::run(&[turned, TestModel::new("missing")], &[]);
    let (status, text) = replay(&other, &[path, "--json"]);
    assert_eq!(status, Some(1), "{text}");
    let summary: Value = serde_json::from_str(&text).unwrap();
    assert_eq!((&summary["recordings"], &summary["changed"], &summary["same"]), (&10.into(), &8.into(), &2.into()));
    let changes = summary["changes"].to_string();
    for part in ["0 of 2 grasps are the same, 2 now", "180° away", "mirror 1, now mirror 2", "was refused"] {
        assert!(changes.contains(part), "{part} is missing from {changes}");
    }
    // With tolerances above the change, and with another model.
    let (_, text) = replay(&other, &[path, "--angle", "181"]);
    assert!(text.contains("10 recordings: 8 same, 2 changed"), "{text}");
    let (status, text) = replay(&other, &[path, "--model", "nowhere"]);
    assert!(text.contains("is refused now: NotFound") && status == Some(1), "{text}");
    let (status, text) = replay(&other, &[folder.path().to_str().unwrap()]);
    assert!(text.contains("has no .recording files; run graspd with --record") && status == Some(1), "{text}");
}

#[tokio::test]
async fn recordings_are_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    // A request has 16 KiB.
    let server = Server::run(&[TestModel::new("mirror")], &["--record", path, "--record-bytes", "60000"]);
    let client = server.client().await;
    for _ in 0..10 {
        client.detect(&volume(), Options::default()).await.unwrap();
    }
    server.wait_for("graspd_recordings_total{outcome=\"written\"}", 10.0).await;
    assert_eq!(count(folder.path()), 3);
}
