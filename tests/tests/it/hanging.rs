//! Inferences that do not end, or that always fail.

use std::time::Duration;

use grasp::Volume;
use grasp_client::{Client, DetectOptions, Health, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tonic::Code;

/// A model whose inference of [`hanging`] never ends, and one that has no such volume.
fn models() -> [TestModel; 2] {
    [TestModel::new("loop").hangs_at(0.9), TestModel::new("mirror")]
}

fn hanging() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

fn empty() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[])
}

async fn detect(client: &Client, volume: &Volume, model: &str) -> Result<(), (Code, String)> {
    let detect = DetectOptions { model: model.to_owned(), ..DetectOptions::default() };
    let options = Options { detect, ..Options::default() };
    let detected = client.detect(volume, options).await;
    detected.map(|_| ()).map_err(|error| (error.code().unwrap_or(Code::Ok), error.to_string()))
}

#[tokio::test(flavor = "multi_thread")]
async fn an_inference_that_does_not_end_loses_its_session_and_the_others_serve_on() {
    let mut server = Server::run(&models(), &["--workers", "2", "--inference-timeout", "0.5", "--queue", "8"]);
    let client = server.client().await;
    let sessions = "graspd_hanging_sessions{model=\"loop 1\"}";
    assert_eq!(server.metric(sessions), 0.0);

    let (code, message) = detect(&client, &hanging(), "loop").await.unwrap_err();
    assert_eq!(code, Code::Internal, "{message}");
    assert!(message.contains("the inference takes longer than 500ms (--inference-timeout)"), "{message}");
    server.wait_for(sessions, 1.0).await;
    for _ in 0..4 {
        detect(&client, &empty(), "loop").await.unwrap();
    }
    assert_eq!(client.health().await.unwrap(), Health::Serving);
    assert_eq!((server.get("/healthz").0, server.get("/readyz").0), (200, 200));

    // The last session hangs, while other requests wait for it.
    let last = tokio::spawn({
        let client = client.clone();
        async move { detect(&client, &hanging(), "loop").await }
    });
    server.wait_for("graspd_queue_requests{model=\"loop 1\"}", 0.0).await;
    let mut waiting = Vec::new();
    for _ in 0..3 {
        let client = client.clone();
        waiting.push(tokio::spawn(async move { detect(&client, &empty(), "loop").await }));
    }
    assert_eq!(last.await.unwrap().unwrap_err().0, Code::Internal);
    for call in waiting {
        // One may have been answered before the session hung.
        if let Err((code, message)) = call.await.unwrap() {
            assert_eq!(code, Code::Unavailable, "{message}");
            assert!(message.contains("all sessions of the model hang"), "{message}");
        }
    }
    server.wait_for(sessions, 2.0).await;
    assert_eq!(detect(&client, &empty(), "loop").await.unwrap_err().0, Code::Unavailable);
    server.wait_for("graspd_ready", 0.0).await;
    assert_eq!(client.health().await.unwrap(), Health::NotServing);
    for probe in ["/healthz", "/readyz"] {
        let (status, body) = server.get(probe);
        assert!(status == 503 && body.contains("all sessions of a model hang"), "{status} {body}");
    }
    detect(&client, &hanging(), "mirror").await.expect("the other model is served");

    server.terminate().unwrap();
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_slow_inference_that_ends_returns_its_session() {
    // Far longer than the timeout, on any machine.
    let slow = TestModel::new("slow").convolutions(300);
    let server = Server::run(&[slow], &["--inference-timeout", "0.001"]);
    let client = server.client().await;
    let (code, message) = detect(&client, &empty(), "slow").await.unwrap_err();
    assert_eq!(code, Code::Internal, "{message}");
    server.wait_for("graspd_hanging_sessions{model=\"slow 1\"}", 0.0).await;
    tokio::time::timeout(Duration::from_secs(60), async {
        while client.health().await.unwrap() != Health::Serving {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await
    .expect("the server is healthy again");
}

#[tokio::test]
async fn a_session_that_always_fails_makes_the_server_unhealthy_until_it_succeeds() {
    let server = Server::run(&[TestModel::new("fragile").fails_at_zero()], &["--inference-timeout", "0"]);
    let client = server.client().await;
    let volume = |first: f32| {
        let mut values = vec![0.5; RESOLUTION.pow(3)];
        values[0] = first;
        Volume::new(RESOLUTION, empty().voxel_size(), Isometry3::identity(), values).unwrap()
    };
    let (failing, sound) = (volume(0.0), volume(0.5));
    let fail = async |times: usize| {
        for _ in 0..times {
            let (code, message) = detect(&client, &failing, "fragile").await.unwrap_err();
            assert_eq!(code, Code::Internal, "{message}");
        }
    };
    // Failures that do not follow one another.
    for _ in 0..3 {
        fail(9).await;
        detect(&client, &sound, "fragile").await.unwrap();
    }
    // Longer than the pause between two checks.
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert_eq!(client.health().await.unwrap(), Health::Serving);

    fail(10).await;
    server.wait_for("graspd_ready", 0.0).await;
    assert_eq!(client.health().await.unwrap(), Health::NotServing);
    for probe in ["/healthz", "/readyz"] {
        let (status, body) = server.get(probe);
        assert!(status == 503 && body.contains("fail each one"), "{status} {body}");
    }
    detect(&client, &sound, "fragile").await.unwrap();
    server.wait_for("graspd_ready", 1.0).await;
    assert_eq!(server.get("/healthz").0, 200);
}
