//! Health and readiness during warm-up, service and drain.

use std::time::Duration;

use grasp_client::{Client, DetectOptions, Error, Health, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tonic::Code;
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

const SERVICE: &str = "grasp.v1.GraspService";

fn request(service: &str) -> HealthCheckRequest {
    HealthCheckRequest { service: service.to_owned() }
}

async fn check(client: &mut HealthClient<Channel>, service: &str) -> ServingStatus {
    client.check(request(service)).await.unwrap().into_inner().status()
}

#[tokio::test]
async fn the_server_is_ready_after_the_warm_up_and_not_before() {
    // The warm-up is an inference of the slow model; the checks before its end take a hundredth of that time.
    let mut server = Server::start(&[TestModel::new("slow").convolutions(600)], &[]);
    let mut health = HealthClient::new(server.channel().await);
    let client = server.client().await;
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);

    assert_eq!(check(&mut health, "").await, ServingStatus::NotServing);
    assert_eq!(check(&mut health, SERVICE).await, ServingStatus::NotServing);
    assert_eq!(client.health().await.unwrap(), Health::NotServing);
    assert_eq!(server.get("/readyz"), (503, "warming up\n".to_owned()));
    assert_eq!(server.get("/healthz"), (200, "ok\n".to_owned()), "live, but not ready");
    let error = client.detect(&volume, Options::default()).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::Unavailable), "{error}");
    assert!(error.to_string().contains("warming up"), "{error}");

    assert_eq!(client.list_models().await.unwrap_err().code(), Some(Code::Unavailable), "the list is not known yet");

    let address = server.grpc().to_string();
    let error = Client::wait_ready(address.clone(), Duration::ZERO).await.unwrap_err();
    assert!(matches!(error, Error::NotReady { .. }), "{error}");
    Client::wait_ready(address, Duration::from_mins(5)).await.unwrap();
    server.wait_ready().unwrap();
    assert_eq!(check(&mut health, "").await, ServingStatus::Serving);
    assert_eq!(check(&mut health, SERVICE).await, ServingStatus::Serving);
    assert_eq!(client.health().await.unwrap(), Health::Serving);
    assert_eq!(server.get("/readyz"), (200, "ready\n".to_owned()));
    assert_eq!(client.detect(&volume, Options::default()).await.unwrap().grasps.len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn health_watches_report_the_drain_and_do_not_delay_it() {
    let mut server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut health = HealthClient::new(server.channel().await);
    let mut all = health.watch(request("")).await.unwrap().into_inner();
    let mut one = health.watch(request(SERVICE)).await.unwrap().into_inner();
    for watch in [&mut all, &mut one] {
        assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::Serving);
    }
    server.terminate().unwrap();
    for watch in [&mut all, &mut one] {
        assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
        assert!(watch.next().await.is_none());
    }
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn the_health_of_an_unknown_service_is_not_found() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut health = HealthClient::new(server.channel().await);
    assert_eq!(health.check(request("grasp.v2")).await.unwrap_err().code(), Code::NotFound);
    let mut watch = health.watch(request("grasp.v2")).await.unwrap().into_inner();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::ServiceUnknown);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_server_is_not_ready_during_the_drain() {
    let mut server = Server::run(&[TestModel::new("slow").convolutions(200)], &[]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..2 {
        let client = client.clone();
        let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
        calls.spawn(async move { client.detect(&volume, Options::default()).await });
    }
    let mut watch = HealthClient::new(server.channel().await).watch(request("")).await.unwrap().into_inner();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::Serving);
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 1.0).await;
    server.terminate().unwrap();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(server.get("/readyz"), (503, "draining\n".to_owned()));
    assert!(calls.join_all().await.iter().all(Result::is_ok));
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_model_whose_outputs_are_invalid_makes_the_server_unhealthy() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("invalid").breaks_at(0.9)], &[]);
    let client = server.client().await;
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
    let options = |model: &str| {
        let detect = DetectOptions { model: model.to_owned(), threshold: Some(0.1), ..DetectOptions::default() };
        Options { detect, ..Options::default() }
    };
    for _ in 0..10 {
        let error = client.detect(&volume, options("invalid")).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::Internal), "{error}");
    }
    server.wait_for("graspd_ready", 0.0).await;
    // The other model is still served.
    client.detect(&volume, options("mirror")).await.unwrap();
}
