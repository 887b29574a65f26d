//! TrackGrasps: a volume that the server keeps between views.

use std::time::{Duration, SystemTime};

use grasp_client::{DetectOptions, Detection, Error, Extrinsics, Options, Workspace};
use grasp_proto::pb;
use grasp_tests::scene::{camera, view};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tokio::task::JoinSet;
use tokio_stream::StreamExt;
use tonic::Code;

const TRACKED: &str = "graspd_tracked_volumes";

fn low() -> Options {
    let collision = grasp_tests::no_collision_check();
    Options {
        detect: DetectOptions { threshold: Some(0.6), collision, ..DetectOptions::default() },
        ..Options::default()
    }
}

fn code(outcome: Result<Detection, Error>) -> (Code, String) {
    match outcome {
        Err(Error::Refused { code, message, .. }) => (code, message),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn each_view_is_added_to_those_before_it() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let pose = Isometry3::translation(0.4, 0.0, 0.2);
    let workspace = Workspace { pose, ..Workspace::default() };
    let views = [-90.0, 0.0, 90.0].map(|azimuth| view(&camera(40.0, azimuth)));

    let mut tracking = client.track(workspace).await.unwrap();
    for seen in 1..=views.len() {
        let stamp = Some(SystemTime::UNIX_EPOCH + Duration::from_secs(seen as u64));
        let options = Options { frame_id: "base".to_owned(), stamp, ..low() };
        let kept = tracking.add(&views[seen - 1..seen], options).await.unwrap();
        let expected = client.detect_from_depth(&views[..seen], &workspace, low()).await.unwrap();
        let poses = |detection: &Detection| detection.grasps.iter().map(|grasp| grasp.pose).collect::<Vec<_>>();
        assert!(!kept.grasps.is_empty());
        assert_eq!(poses(&kept), poses(&expected), "after {seen} views");
        assert_eq!((kept.frame_id.as_str(), kept.stamp), ("base", stamp));
        assert_eq!(server.metric(TRACKED), 1.0);
    }
    // No new view, other options, the time of the latest views.
    let detect = DetectOptions { max_grasps: 1, ..low().detect };
    let one = tracking.add(&[], Options { detect, ..Options::default() }).await.unwrap();
    assert_eq!(one.grasps.len(), 1);
    assert_eq!(one.stamp, Some(SystemTime::UNIX_EPOCH + Duration::from_secs(3)));

    drop(tracking);
    server.wait_for(TRACKED, 0.0).await;
}

#[tokio::test]
async fn an_invalid_view_ends_neither_the_stream_nor_the_volume() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("other").resolution(24)], &[]);
    let client = server.client().await;
    let good = view(&camera(40.0, -90.0));
    let away = Extrinsics::CameraFromTask(Isometry3::translation(-0.15, -0.15, -1.0));
    let bad = grasp_client::DepthView { extrinsics: away, ..good.clone() };

    let mut tracking = client.track(Workspace::default()).await.unwrap();
    let first = tracking.add(std::slice::from_ref(&good), low()).await.unwrap();
    let (status, message) = code(tracking.add(std::slice::from_ref(&bad), low()).await);
    assert!(status == Code::InvalidArgument && message.starts_with("views[0]: camera at"), "{message}");
    let again = tracking.add(&[], low()).await.unwrap();
    assert_eq!(again.grasps, first.grasps);
    // All views of a request are added, or none: the good one is not in the volume, and may be sent again.
    let opposite = view(&camera(40.0, 90.0));
    let error = tracking.add(&[opposite.clone(), bad], low()).await.unwrap_err();
    assert!(!error.views_added() && error.to_string().contains("views[1]: camera at"), "{error}");
    assert_eq!(tracking.add(&[], low()).await.unwrap().grasps, first.grasps);
    let both = tracking.add(std::slice::from_ref(&opposite), low()).await.unwrap();
    let expected = client.detect_from_depth(&[good.clone(), opposite], &Workspace::default(), low()).await.unwrap();
    assert_eq!(both.grasps, expected.grasps);
    let other = DetectOptions { model: "other".to_owned(), ..low().detect };
    let (status, message) = code(tracking.add(&[], Options { detect: other, ..Options::default() }).await);
    assert_eq!(status, Code::InvalidArgument);
    assert!(message.starts_with("options.model is `other`, which requires a different grid"), "{message}");
    assert_eq!(tracking.add(&[], low()).await.unwrap().grasps, both.grasps);

    // With the generated client, because the client library always sends a workspace first.
    let request = pb::TrackGraspsRequest { views: vec![(&good).into()], ..Default::default() };
    let replies = server.raw().await.track_grasps(tokio_stream::iter([request])).await.unwrap();
    let reply = replies.into_inner().message().await.unwrap().unwrap();
    let Some(pb::detect_grasps_stream_response::Outcome::Error(error)) = reply.outcome else { panic!("{reply:?}") };
    assert_eq!(error.message, "workspace is absent, must be given in the first request of a stream");
    let request = pb::TrackGraspsRequest { half_life: Some(10.0), ..Default::default() };
    let replies = server.raw().await.track_grasps(tokio_stream::iter([request])).await.unwrap();
    let reply = replies.into_inner().message().await.unwrap().unwrap();
    let Some(pb::detect_grasps_stream_response::Outcome::Error(error)) = reply.outcome else { panic!("{reply:?}") };
    assert_eq!(error.message, "half_life is 10, must be absent without a workspace");

    let (status, message) = code(client.track(Workspace::default()).await.unwrap().add(&[], low()).await);
    assert_eq!((status, &*message), (Code::InvalidArgument, "views has 0 entries, must have from 1 to 64"));
}

#[tokio::test]
async fn views_are_fused_while_the_queue_is_full() {
    let server = Server::run(&[TestModel::new("slow").convolutions(60)], &["--queue", "1"]);
    let client = server.client().await;
    let views = [-90.0, 90.0].map(|azimuth| view(&camera(40.0, azimuth)));
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
    let mut tracking = client.track(Workspace::default()).await.unwrap();
    for seen in 1..=views.len() {
        let mut callers = JoinSet::new();
        for _ in 0..12 {
            let (client, volume) = (client.clone(), volume.clone());
            callers.spawn(async move { client.detect(&volume, Options::default()).await });
        }
        server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 1.0).await;
        let refused = tracking.add(&views[seen - 1..seen], low()).await.unwrap_err();
        assert!(refused.code() == Some(Code::ResourceExhausted) && refused.views_added(), "{refused:?}");
        callers.join_all().await;

        let kept = tracking.add(&[], low()).await.unwrap();
        let expected = client.detect_from_depth(&views[..seen], &Workspace::default(), low()).await.unwrap();
        assert_eq!(kept.grasps, expected.grasps, "after {seen} views");
    }
}

#[tokio::test]
async fn the_volume_of_a_client_that_does_not_read_expires() {
    let server = Server::run(&[TestModel::new("mirror")], &["--track-timeout", "0.3"]);
    let first = pb::TrackGraspsRequest {
        views: vec![(&view(&camera(40.0, -90.0))).into()],
        workspace: Some(pb::Workspace::default()),
        options: Some(pb::Options { threshold: Some(0.6), ..Default::default() }),
        ..Default::default()
    };
    // Each reply has several grasps. Replies that the client does not read fill its flow-control window.
    const MORE: usize = 500;
    let more = std::iter::repeat_n(pb::TrackGraspsRequest::default(), MORE);
    let requests = tokio_stream::iter(std::iter::once(first).chain(more)).chain(tokio_stream::pending());
    let endpoint = tonic::transport::Channel::from_shared(format!("http://{}", server.grpc())).unwrap();
    let channel = endpoint.initial_stream_window_size(1024).connect().await.unwrap();
    let mut client = pb::grasp_service_client::GraspServiceClient::new(channel);
    let replies = client.track_grasps(requests).await.unwrap();
    server.wait_for(TRACKED, 1.0).await;
    server.wait_for(TRACKED, 0.0).await;
    let answered = server.metric("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}");
    assert!(answered < MORE as f64, "all {answered} replies fit into the window, so the stream was never blocked");
    drop(replies);
}

#[tokio::test]
async fn cancelled_requests_are_counted() {
    let server = Server::run(&[TestModel::new("slow").convolutions(60)], &["--queue", "8"]);
    let client = server.client().await;
    let tracked = {
        let client = client.clone();
        tokio::spawn(async move {
            let mut tracking = client.track(Workspace::default()).await.unwrap();
            tracking.add(&[view(&camera(40.0, -90.0))], low()).await
        })
    };
    server.wait_for(TRACKED, 1.0).await;
    let mut ahead = JoinSet::new();
    for _ in 0..6 {
        let client = client.clone();
        let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
        ahead.spawn(async move { client.detect(&volume, Options::default()).await });
    }
    server.wait_for("graspd_queue_requests{model=\"slow 1\"}", 6.0).await;
    tracked.abort();
    server.wait_for("graspd_requests_total{code=\"CANCELLED\",model=\"slow 1\"}", 1.0).await;
    server.wait_for(TRACKED, 0.0).await;
    assert!(ahead.join_all().await.iter().all(Result::is_ok), "requests of other clients succeed");
}

#[tokio::test]
async fn tracked_volumes_are_limited_and_expire() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-tracked", "1", "--track-timeout", "0.3"]);
    let client = server.client().await;
    let views = [view(&camera(40.0, -90.0))];
    let mut tracking = client.track(Workspace::default()).await.unwrap();
    tracking.add(&views, low()).await.unwrap();
    let refused = client.track(Workspace::default()).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::ResourceExhausted), "{refused}");

    server.wait_for(TRACKED, 0.0).await;
    let (status, message) = code(tracking.add(&views, low()).await);
    assert!(status == Code::Aborted && message.contains("no request for 300ms"), "{message}");
    let mut tracking = client.track(Workspace::default()).await.unwrap();
    assert!(tracking.add(&views, low()).await.is_ok(), "the slot of the expired volume is free");
}

#[tokio::test]
async fn each_cube_of_a_tracked_workspace_counts() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-tracked", "9"]);
    let client = server.client().await;
    let views = [view(&camera(40.0, -90.0))];
    let of = |extent| Workspace { extent: Some(extent), ..Workspace::default() };
    let mut large = client.track(of([0.4, 0.4])).await.unwrap();
    large.add(&views, low()).await.unwrap();
    assert_eq!(server.metric(TRACKED), 4.0);

    let mut too_large = client.track(of([1.2, 1.2])).await.unwrap();
    let refused = too_large.add(&views, low()).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::InvalidArgument), "a retry does not help");
    assert!(refused.to_string().contains("must have at most 9 (--max-tracked)"), "{refused}");
    drop(too_large);
    server.wait_for(TRACKED, 4.0).await;

    let mut second = client.track(of([0.6, 0.4])).await.unwrap();
    let refused = second.add(&views, low()).await.unwrap_err();
    assert!(refused.code() == Some(Code::ResourceExhausted) && !refused.views_added(), "{refused:?}");
    assert!(refused.to_string().contains("--max-tracked"), "{refused}");
    assert_eq!(server.metric(TRACKED), 5.0, "a stream without a volume has one place");
    let mut third = client.track(of([0.4, 0.4])).await.unwrap();
    third.add(&views, low()).await.unwrap();
    assert_eq!(server.metric(TRACKED), 9.0);
    drop(large);
    server.wait_for(TRACKED, 5.0).await;
    drop(third);
    server.wait_for(TRACKED, 1.0).await;
    assert!(second.add(&views, low()).await.is_ok(), "the client sends its workspace again");
}

#[tokio::test]
async fn a_cancelled_addition_does_not_shift_the_replies() {
    let server = Server::run(&[TestModel::new("slow").convolutions(60)], &[]);
    let client = server.client().await;
    let views = [-90.0, 90.0].map(|azimuth| view(&camera(40.0, azimuth)));
    let mut tracking = client.track(Workspace::default()).await.unwrap();
    let first = tokio::time::timeout(Duration::from_millis(1), tracking.add(&views[..1], low())).await;
    assert!(first.is_err(), "an inference takes longer than a millisecond");
    let both = tracking.add(&views[1..], low()).await.unwrap();
    let again = tracking.add(&[], low()).await.unwrap();
    assert_eq!(both.grasps, again.grasps);
}
