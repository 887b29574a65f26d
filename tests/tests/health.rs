//! What the server says of itself, at each point of its life.

use std::time::Duration;

use grasp_client::{Client, Error, Health, Options};
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

fn ask(service: &str) -> HealthCheckRequest {
    HealthCheckRequest { service: service.to_owned() }
}

async fn check(client: &mut HealthClient<Channel>, service: &str) -> ServingStatus {
    client.check(ask(service)).await.unwrap().into_inner().status()
}

#[tokio::test]
async fn it_serves_after_the_warm_up_and_not_before() {
    // The warm-up is an inference of the slow model; the questions before it ends take a hundredth of that.
    let mut server = Server::start(&[TestModel::new("slow").convolutions(600)], &[]);
    let mut health = HealthClient::new(server.channel().await);
    let client = server.client().await;
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);

    assert_eq!(check(&mut health, "").await, ServingStatus::NotServing);
    assert_eq!(check(&mut health, SERVICE).await, ServingStatus::NotServing);
    assert_eq!(client.health().await.unwrap(), Health::NotServing);
    assert_eq!(server.get("/readyz"), (503, "warming up\n".to_owned()));
    assert_eq!(server.get("/healthz"), (200, "ok\n".to_owned()), "alive, if not ready");
    let error = client.detect(&volume, Options::default()).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::Unavailable), "{error}");
    assert!(error.to_string().contains("warming up"), "{error}");

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

#[tokio::test]
async fn watchers_are_told_of_the_drain_and_do_not_hold_it_up() {
    let mut server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut health = HealthClient::new(server.channel().await);
    let mut all = health.watch(ask("")).await.unwrap().into_inner();
    let mut one = health.watch(ask(SERVICE)).await.unwrap().into_inner();
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
async fn a_service_that_there_is_not_is_unknown() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut health = HealthClient::new(server.channel().await);
    assert_eq!(health.check(ask("grasp.v2")).await.unwrap_err().code(), Code::NotFound);
    let mut watch = health.watch(ask("grasp.v2")).await.unwrap().into_inner();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::ServiceUnknown);
}

#[tokio::test]
async fn while_it_drains_it_says_so() {
    let mut server = Server::run(&[TestModel::new("slow").convolutions(200)], &[]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..2 {
        let client = client.clone();
        let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
        calls.spawn(async move { client.detect(&volume, Options::default()).await });
    }
    let mut watch = HealthClient::new(server.channel().await).watch(ask("")).await.unwrap().into_inner();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::Serving);
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 1.0).await;
    server.terminate().unwrap();
    assert_eq!(watch.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(server.get("/readyz"), (503, "draining\n".to_owned()));
    assert!(calls.join_all().await.iter().all(Result::is_ok));
    assert_eq!(server.wait().unwrap().code(), Some(0));
}
