//! More requests than the server can answer.

use std::sync::Arc;
use std::time::Duration;

use grasp::Volume;
use grasp_client::{Access, Client, DetectOptions, Error, Options, Retry, Workspace};
use grasp_proto::pb::Priority;
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use grasp_proto::pb::{CollisionCheck, DetectGraspsFromDepthRequest, DetectGraspsRequest, collision_check};
use grasp_tests::scene::{camera, view};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tonic::transport::Endpoint;
use tonic::{Code, Request, Status};
use tonic_types::StatusExt;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

fn slow() -> TestModel {
    TestModel::new("slow").convolutions(60)
}

#[tokio::test]
async fn requests_beyond_the_queue_are_refused_at_once_and_the_others_answered() {
    let server = Server::run(&[slow()], &["--queue", "2"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..40 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    let mut outcomes = Vec::new();
    while let Some(outcome) = calls.join_next().await {
        outcomes.push(outcome.unwrap());
    }
    assert_eq!(outcomes.len(), 40);
    for outcome in &outcomes {
        match outcome {
            Ok(detection) => assert_eq!(detection.grasps.len(), 1),
            Err(Error::Refused { code, message, retry_after, .. }) => {
                assert_eq!(*code, Code::ResourceExhausted, "{message}");
                assert!(message.starts_with("the queue of the model `slow` is full (2 requests)"), "{message}");
                assert!(!retry_after.expect("a retry delay").is_zero());
            }
            Err(error) => panic!("{error}"),
        }
    }
    let refused = outcomes.iter().filter(|outcome| outcome.is_err()).count();
    assert!(refused > 0 && refused < 40, "{refused} of 40 refused");
    assert!(outcomes[0].is_err(), "the first refusal is sent before the first result");
    assert_eq!(server.metric("graspd_requests_total{code=\"RESOURCE_EXHAUSTED\",model=\"slow 1\"}"), refused as f64);
    assert_eq!(server.metric("graspd_requests_total{code=\"OK\",model=\"slow 1\"}"), (40 - refused) as f64);
    assert_eq!(server.metric("graspd_queue_requests{model=\"slow 1\"}"), 0.0);
}

#[tokio::test]
async fn images_beyond_the_capacity_of_the_fusion_are_refused_at_once() {
    let server = Server::run(&[TestModel::new("mirror")], &["--queue", "1"]);
    let client = server.client().await;
    // Fusion takes milliseconds and the network microseconds, so that the queue of the network is never full.
    let views: Vec<_> = (0..24).map(|index| view(&camera(40.0, 15.0 * f64::from(index)))).collect();
    let mut calls = JoinSet::new();
    for _ in 0..40 {
        let (client, views) = (client.clone(), views.clone());
        calls.spawn(async move { client.detect_from_depth(&views, &Workspace::default(), Options::default()).await });
    }
    let outcomes = calls.join_all().await;
    let refused = outcomes.iter().filter(|outcome| match outcome {
        Ok(_) => false,
        Err(error) => {
            assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
            true
        }
    });
    assert!((1..40).contains(&refused.count()));
}

#[tokio::test]
async fn the_retry_delay_includes_postprocessing() {
    let server = Server::run(&[TestModel::new("mirror").resolution(96)], &["--queue", "1"]);
    let client = server.client().await;
    // Decoding takes far longer than the network.
    let centres: Vec<[usize; 3]> = (0..343).map(|i| [i / 49, i / 7 % 7, i % 7].map(|c| 12 + 12 * c)).collect();
    let volume = blobs(96, Isometry3::identity(), &centres);
    let flag = CollisionCheck { mode: Some(collision_check::Mode::Flag.into()), ..Default::default() };
    let detect = DetectOptions { collision: Some(flag), max_grasps: 1000, ..DetectOptions::default() };
    let options = || Options { detect: detect.clone(), ..Options::default() };
    let first = client.detect(&volume, options()).await.unwrap();
    let mut calls = JoinSet::new();
    for _ in 0..8 {
        let (client, volume, options) = (client.clone(), volume.clone(), options());
        calls.spawn(async move { client.detect(&volume, options).await });
    }
    let hints = calls.join_all().await.into_iter().filter_map(|outcome| match outcome {
        Err(Error::Refused { retry_after, .. }) => retry_after,
        _ => None,
    });
    let hint = hints.min().expect("at least one of eight requests is refused: one runs and two wait").as_secs_f64();
    let latency = first.latency;
    assert!(latency.postprocessing > latency.inference, "{latency:?}");
    assert!(hint > latency.inference + 0.3 * latency.postprocessing, "{hint} s after {latency:?}");
}

#[tokio::test]
async fn a_single_stream_is_never_refused() {
    let server = Server::run(&[TestModel::new("mirror").convolutions(2)], &["--queue", "1"]);
    let volumes = tokio_stream::iter((0..100).map(|_| (volume(), Options::default())));
    let mut replies = server.client().await.detect_stream(volumes).await.unwrap();
    let mut answered = 0;
    while let Some(reply) = replies.next().await {
        assert_eq!(reply.unwrap().grasps.len(), 1);
        answered += 1;
    }
    assert_eq!(answered, 100);
}

#[tokio::test]
async fn cancelled_requests_are_skipped_and_counted() {
    let server = Server::run(&[slow()], &["--queue", "17"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..17 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 16.0).await;
    calls.shutdown().await;
    server.wait_for("graspd_requests_total{code=\"CANCELLED\",model=\"slow 1\"}", 17.0).await;
    // The next request waits for the running one, and not for the sixteen that were queued.
    let detection = client.detect(&volume(), Options::default()).await.unwrap();
    assert!(detection.latency.queue < 8.0 * detection.latency.inference, "{:?}", detection.latency);
}

#[tokio::test]
async fn every_worker_runs_its_own_session() {
    let server = Server::run(&[slow()], &["--queue", "8", "--workers", "2"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for _ in 0..4 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    // Two of the four wait, so the other two run.
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 2.0).await;
    for outcome in calls.join_all().await {
        assert_eq!(outcome.unwrap().grasps.len(), 1);
    }
}

/// Sends a volume with a deadline.
async fn detect_within(server: &Server, timeout: Duration) -> Result<(), Status> {
    let volume = grasp_proto::encode(&volume(), grasp_client::DataType::F32, "");
    let mut request = Request::new(DetectGraspsRequest { volume: Some(volume), ..Default::default() });
    request.set_timeout(timeout);
    server.raw().await.detect_grasps(request).await.map(|_| ())
}

#[tokio::test]
async fn a_request_that_cannot_be_answered_in_its_time_is_refused_at_once() {
    let server = Server::run(&[slow()], &["--queue", "8"]);
    let client = server.client().await;
    let mut ahead = JoinSet::new();
    for _ in 0..8 {
        let client = client.clone();
        ahead.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 7.0).await;
    let status = detect_within(&server, Duration::from_millis(100)).await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    assert!(status.message().starts_with("deadline too short: expected wait "), "{status}");
    assert!(status.get_details_retry_info().is_some());
    assert_eq!(server.metric("graspd_refusals_total{model=\"slow 1\",reason=\"deadline\"}"), 1.0);
    // With enough time it is accepted.
    detect_within(&server, Duration::from_secs(600)).await.unwrap();
    ahead.join_all().await.into_iter().for_each(|answered| assert!(answered.is_ok(), "{answered:?}"));
    assert_eq!(server.metric("graspd_stage_duration_seconds_count{model=\"slow 1\",stage=\"total\"}"), 9.0);
}

#[tokio::test]
async fn a_request_whose_deadline_passes_during_its_inference_ends_then() {
    let server = Server::run(&[slow()], &[]);
    let expired = "graspd_requests_total{code=\"DEADLINE_EXCEEDED\",model=\"slow 1\"}";
    // On a busy machine the client's own deadline may pass first, which the server counts as cancelled.
    for _ in 0..20 {
        // An idle server tries it, whatever it expects.
        let status = detect_within(&server, Duration::from_millis(200)).await.unwrap_err();
        assert!(matches!(status.code(), Code::Cancelled | Code::DeadlineExceeded), "{status}");
        // Answered when the session is idle again.
        server.client().await.detect(&volume(), Options::default()).await.unwrap();
        if server.metric(expired) > 0.0 {
            return;
        }
    }
    panic!("no request ended at its deadline");
}

#[tokio::test]
async fn under_overload_with_deadlines_the_inferences_are_not_in_vain() {
    let server = Server::run(&[slow()], &["--queue", "32"]);
    let client = server.client().await;
    let time = client.detect(&volume(), Options::default()).await.unwrap().latency.total;
    // Each of twelve callers waits for at most five inferences.
    let timeout = Duration::from_secs_f64(5.0 * time);
    let server = Arc::new(server);
    let mut callers = JoinSet::new();
    for _ in 0..12 {
        let server = Arc::clone(&server);
        callers.spawn(async move {
            let mut codes = Vec::new();
            while codes.iter().filter(|code| **code == Code::Ok).count() < 3 {
                let code = detect_within(&server, timeout).await.err().map_or(Code::Ok, |status| status.code());
                codes.push(code);
                if code != Code::Ok {
                    tokio::time::sleep(timeout / 20).await;
                }
            }
            codes
        });
    }
    let codes: Vec<Code> = callers.join_all().await.into_iter().flatten().collect();
    let count = |wanted: Code| codes.iter().filter(|code| **code == wanted).count();
    let late = codes.len() - count(Code::Ok) - count(Code::ResourceExhausted);
    println!("{} answered, {} refused, {late} late", count(Code::Ok), count(Code::ResourceExhausted));
    assert_eq!(count(Code::Ok), 36);
    assert!(count(Code::ResourceExhausted) > 0, "it was not overloaded");
    // Without a check of the deadlines most of the accepted requests would be late.
    assert!(late < 36, "{late} of {} requests were accepted and answered too late", codes.len());
}

#[tokio::test]
async fn refused_callers_that_follow_the_hint_are_answered() {
    let server = Server::run(&[TestModel::new("mirror").convolutions(2)], &["--queue", "32"]);
    let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
    let client = Client::connect_with(server.grpc().to_string(), access).await.unwrap();
    let mut calls = JoinSet::new();
    for _ in 0..100 {
        let client = client.clone();
        calls.spawn(async move { client.detect(&volume(), Options::default()).await });
    }
    let answered = calls.join_all().await.iter().filter(|outcome| outcome.is_ok()).count();
    assert!(answered >= 95, "{answered} of 100");
    assert!(server.metric("graspd_refusals_total{model=\"mirror 1\",reason=\"full\"}") > 0.0);
}

#[tokio::test]
async fn one_caller_with_many_calls_leaves_room_for_another() {
    let server = Server::run(&[slow()], &["--queue", "8"]);
    let other = Endpoint::from_shared(format!("http://{}", server.grpc())).unwrap();
    let other = other.local_address(Some([127, 0, 0, 2].into())).connect().await.unwrap();
    let request = || DetectGraspsRequest {
        volume: Some(grasp_proto::encode(&volume(), grasp_client::DataType::F32, "")),
        ..Default::default()
    };
    let mut many = JoinSet::new();
    for _ in 0..64 {
        let (mut client, request) = (GraspServiceClient::new(other.clone()), request());
        // Calls again whenever it is refused.
        many.spawn(async move {
            loop {
                match client.detect_grasps(request.clone()).await {
                    Err(status) if status.code() == Code::ResourceExhausted => {
                        tokio::time::sleep(Duration::from_millis(30)).await;
                    }
                    outcome => outcome.map(|_| ()).unwrap(),
                }
            }
        });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 8.0).await;
    let client = server.client().await;
    for _ in 0..6 {
        let latency = client.detect(&volume(), Options::default()).await.unwrap().latency;
        // One inference is running, and at most one of the other caller's is taken first.
        assert!(latency.queue < 6.0 * latency.inference, "{latency:?}");
    }
    assert!(server.metric("graspd_refusals_total{model=\"slow 1\",reason=\"displaced\"}") > 0.0);
    many.shutdown().await;
}

#[tokio::test]
async fn one_caller_with_many_images_leaves_room_for_another() {
    let server = Server::run(&[TestModel::new("mirror")], &["--queue", "8"]);
    let other = Endpoint::from_shared(format!("http://{}", server.grpc())).unwrap();
    let other = other.local_address(Some([127, 0, 0, 2].into())).connect().await.unwrap();
    let views: Vec<_> = (0..24).map(|index| view(&camera(40.0, 15.0 * f64::from(index)))).collect();
    let request = DetectGraspsFromDepthRequest { views: views.iter().map(Into::into).collect(), ..Default::default() };
    let mut many = JoinSet::new();
    for _ in 0..32 {
        let (mut client, request) = (GraspServiceClient::new(other.clone()), request.clone());
        // Calls again when it is answered or refused.
        many.spawn(async move {
            loop {
                match client.detect_grasps_from_depth(request.clone()).await {
                    Err(status) if status.code() != Code::ResourceExhausted => panic!("{status}"),
                    _ => {}
                }
            }
        });
    }
    server.wait_until("graspd_refusals_total{model=\"mirror 1\",reason=\"full\"}", |refused| refused > 0.0).await;
    let client = server.client().await;
    let displaced = || server.metric("graspd_refusals_total{model=\"mirror 1\",reason=\"displaced\"}");
    let answered = async {
        // On a busy machine the other caller may leave places free for a while.
        for answered in 1.. {
            client.detect_from_depth(&views[..1], &Workspace::default(), Options::default()).await.unwrap();
            if answered >= 10 && displaced() > 0.0 {
                break;
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(60), answered)
        .await
        .expect("a request takes the place of one of the other caller");
    many.shutdown().await;
}

#[tokio::test]
async fn batch_requests_wait_for_normal_ones() {
    let server = Server::run(&[slow()], &["--queue", "8"]);
    let client = server.client().await;
    let options = |priority: Priority| {
        let detect = DetectOptions { priority: priority.into(), ..DetectOptions::default() };
        Options { detect, ..Options::default() }
    };
    let mut batch = JoinSet::new();
    for _ in 0..9 {
        let client = client.clone();
        batch.spawn(async move { client.detect(&volume(), options(Priority::Batch)).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 8.0).await;
    let latency = client.detect(&volume(), options(Priority::Normal)).await.unwrap().latency;
    assert!(latency.queue < 4.0 * latency.inference, "{latency:?}");
    let outcomes = batch.join_all().await;
    let refused: Vec<_> = outcomes.iter().filter_map(|outcome| outcome.as_ref().err()).collect();
    assert_eq!(refused.len(), 1, "the normal request took the place of one: {refused:?}");
    assert!(refused[0].to_string().contains("was displaced by one with a higher priority"), "{refused:?}");
    for (priority, count) in [("NORMAL", 1.0), ("BATCH", 9.0)] {
        let queued = format!("graspd_queued_total{{model=\"slow 1\",priority=\"{priority}\"}}");
        assert_eq!(server.metric(&queued), count, "{priority}");
    }
}

#[tokio::test]
async fn queued_requests_form_a_batch_and_each_gets_its_own_grasps() {
    let server = Server::run(&[slow()], &["--queue", "8", "--max-batch", "3"]);
    let client = server.client().await;
    let mut calls = JoinSet::new();
    for number in 0..7 {
        let (client, centre) = (client.clone(), [4 + number, 8, 8]);
        calls.spawn(async move {
            let volume = blobs(RESOLUTION, Isometry3::identity(), &[centre]);
            let detection = client.detect(&volume, Options::default()).await.unwrap();
            assert_eq!(detection.grasps.len(), 1);
            let x = detection.grasps[0].pose.translation.x / volume.voxel_size();
            assert!((x - centre[0] as f64).abs() < 1.5, "{x} of {centre:?}");
        });
    }
    calls.join_all().await;
    let sum = server.metric("graspd_batch_size_sum{model=\"slow 1\"}");
    let batches = server.metric("graspd_batch_size_count{model=\"slow 1\"}");
    assert_eq!(sum, 7.0);
    // The first request usually runs alone; then three at a time.
    assert!((3.0..7.0).contains(&batches), "{batches} batches");
}
