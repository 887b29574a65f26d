//! Replies to valid requests.

use std::time::{Duration, SystemTime};

use grasp::{DecodeParams, Grasp, Volume};
use grasp_client::{DataType, DetectOptions, Dropped, Options, Proposal};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, expected};
use nalgebra::{Isometry3, Vector3};
use tokio_stream::StreamExt;

const CENTRES: [[usize; 3]; 2] = [[4, 5, 6], [11, 10, 9]];

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &CENTRES)
}

fn voxels(dropped: &Dropped) -> usize {
    let Dropped { below_threshold, mask, width, suppressed, over_limit, .. } = *dropped;
    (below_threshold + mask + width + suppressed + over_limit) as usize
}

fn assert_same(actual: &[Proposal], grasps: &[Grasp]) {
    assert_eq!(actual.len(), grasps.len());
    for (actual, grasp) in actual.iter().zip(grasps) {
        assert!(
            (actual.pose.translation.vector - grasp.pose.translation.vector).norm() < 1e-12,
            "{actual:?} {grasp:?}"
        );
        assert!(actual.pose.rotation.angle_to(&grasp.pose.rotation) < 1e-7, "{actual:?} {grasp:?}");
        assert_eq!((actual.width, actual.quality), (grasp.width, grasp.quality));
    }
}

#[tokio::test]
async fn the_reply_is_the_decoded_output_of_the_network() {
    let server = Server::run(&[TestModel::new("mirror").version("3")], &[]);
    let detection = server.client().await.detect(&volume(), Options::default()).await.unwrap();
    let decoded = expected(&volume(), &DecodeParams::default());
    assert_eq!(decoded.grasps.len(), CENTRES.len());
    assert_same(&detection.grasps, &decoded.grasps);
    assert_eq!((detection.model.as_str(), detection.version.as_str()), ("mirror", "3"));
    assert_eq!(detection.dropped, None, "`explain` is not set");
}

#[tokio::test]
async fn every_dtype_gives_the_same_grasps() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let detect = async |dtype| client.detect(&volume(), Options { dtype, ..Options::default() }).await;
    let f32 = detect(DataType::F32).await.unwrap().grasps;
    let f16 = detect(DataType::F16).await.unwrap().grasps;
    let u8 = detect(DataType::U8).await.unwrap().grasps;
    let plain: Vec<Grasp> = f32.iter().map(Into::into).collect();
    assert_same(&u8, &plain);
    assert_eq!(f32.len(), f16.len());
    for (wide, half) in f32.iter().zip(&f16) {
        assert_eq!((wide.pose, wide.width), (half.pose, half.width));
        assert!((wide.quality - half.quality).abs() < 1e-3);
    }
}

#[tokio::test]
async fn grasps_are_in_the_frame_of_the_volumes_pose() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let pose = Isometry3::new(Vector3::new(0.4, -0.2, 1.1), Vector3::new(0.3, -0.8, 2.0));
    let placed = blobs(RESOLUTION, pose, &CENTRES);
    let at_origin = client.detect(&volume(), Options::default()).await.unwrap().grasps;
    let options = Options { frame_id: "panda_link0".to_owned(), ..Options::default() };
    let detection = client.detect(&placed, options).await.unwrap();
    let moved: Vec<_> = at_origin.iter().map(|grasp| Grasp { pose: pose * grasp.pose, ..grasp.into() }).collect();
    assert_same(&detection.grasps, &moved);
    assert_eq!(detection.frame_id, "panda_link0");
}

#[tokio::test]
async fn explain_counts_every_voxel_once() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    for threshold in [0.3, 0.7, 0.9, 1.0] {
        for max_grasps in [0, 1] {
            let detect =
                DetectOptions { threshold: Some(threshold), max_grasps, explain: true, ..DetectOptions::default() };
            let options = Options { detect, ..Options::default() };
            let detection = client.detect(&volume(), options).await.unwrap();
            let dropped = detection.dropped.expect("`explain` is set");
            assert_eq!(voxels(&dropped) + detection.grasps.len(), RESOLUTION.pow(3), "{dropped:?}");
            let decoded = expected(&volume(), &DecodeParams { threshold, ..DecodeParams::default() });
            let sent = if max_grasps == 0 { decoded.grasps.len() } else { 1.min(decoded.grasps.len()) };
            assert_eq!(detection.grasps.len(), sent);
            assert_eq!(dropped.over_limit as usize, decoded.grasps.len() - sent);
            assert_eq!(dropped.suppressed as usize, decoded.dropped.suppressed);
        }
    }
}

#[tokio::test]
async fn an_empty_reply_always_has_the_reasons() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let detect = DetectOptions { threshold: Some(1.0), ..DetectOptions::default() };
    let options = Options { detect, ..Options::default() };
    let detection = server.client().await.detect(&volume(), options).await.unwrap();
    assert!(detection.grasps.is_empty());
    assert_eq!(voxels(&detection.dropped.expect("an empty reply has the reasons")), RESOLUTION.pow(3));
}

#[tokio::test]
async fn force_gives_the_single_best_grasp() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let detect = DetectOptions { threshold: Some(1.0), force: Some(0.5), ..DetectOptions::default() };
    let options = Options { detect, ..Options::default() };
    let detection = server.client().await.detect(&volume(), options).await.unwrap();
    let best = expected(&volume(), &DecodeParams::default()).grasps[0];
    assert_same(&detection.grasps, &[best]);
}

#[tokio::test]
async fn request_id_and_stamp_are_returned() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = server.client().await;
    let stamp = SystemTime::UNIX_EPOCH + Duration::new(1_700_000_000, 123_456_789);
    let options = Options { request_id: "pick 7".to_owned(), stamp: Some(stamp), ..Options::default() };
    let named = client.detect(&volume(), options).await.unwrap();
    assert_eq!((named.request_id.as_str(), named.stamp), ("pick 7", Some(stamp)));

    let first = client.detect(&volume(), Options::default()).await.unwrap();
    let second = client.detect(&volume(), Options::default()).await.unwrap();
    assert!(!first.request_id.is_empty());
    assert_ne!(first.request_id, second.request_id);
    assert_eq!(first.stamp, None);
}

#[tokio::test]
async fn the_stages_of_the_latency_are_within_the_total() {
    let server = Server::run(&[TestModel::new("mirror").convolutions(2)], &[]);
    let latency = server.client().await.detect(&volume(), Options::default()).await.unwrap().latency;
    let stages = [latency.queue, latency.preprocessing, latency.inference, latency.postprocessing];
    assert!(stages.iter().all(|&stage| stage > 0.0), "{latency:?}");
    assert!(stages.iter().sum::<f64>() <= latency.total, "{latency:?}");
}

#[tokio::test]
async fn stream_replies_are_in_order_and_errors_do_not_end_the_stream() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let requests: Vec<_> = (0..50)
        .map(|index| {
            let model = if index % 5 == 3 { "unknown" } else { "" }.to_owned();
            let detect = DetectOptions { model, ..DetectOptions::default() };
            (volume(), Options { request_id: format!("volume {index}"), detect, ..Options::default() })
        })
        .collect();
    let replies = server.client().await.detect_stream(tokio_stream::iter(requests)).await.unwrap();
    let replies: Vec<_> = replies.collect().await;
    assert_eq!(replies.len(), 50);
    for (index, reply) in replies.into_iter().enumerate() {
        match reply {
            Ok(detection) => {
                assert_eq!(detection.request_id, format!("volume {index}"));
                assert_eq!(detection.grasps.len(), CENTRES.len());
            }
            Err(error) => {
                assert_eq!(index % 5, 3, "{error}");
                assert_eq!(error.code(), Some(tonic::Code::NotFound));
            }
        }
    }
}

#[tokio::test]
async fn the_model_is_the_requested_one_or_the_first_of_the_resolution() {
    let models = [
        TestModel::new("large").resolution(24),
        TestModel::new("mirror").version("1.9"),
        TestModel::new("mirror").version("1.10"),
        TestModel::new("small"),
    ];
    let server = Server::run(&models, &["--default-model", "small"]);
    let client = server.client().await;
    let listed = client.list_models().await.unwrap();
    let listed: Vec<_> = listed.iter().map(|model| format!("{} {}", model.name, model.version)).collect();
    assert_eq!(listed, ["small 1", "large 1", "mirror 1.10", "mirror 1.9", "shaf 1"]);

    let large = blobs(24, Isometry3::identity(), &CENTRES);
    for (volume, model, version, selected) in [
        (&volume(), "", "", "small 1"),
        (&large, "", "", "large 1"),
        (&volume(), "mirror", "", "mirror 1.10"),
        (&volume(), "mirror", "1.9", "mirror 1.9"),
    ] {
        let detect = DetectOptions { model: model.to_owned(), version: version.to_owned(), ..DetectOptions::default() };
        let options = Options { detect, ..Options::default() };
        let detection = client.detect(volume, options).await.unwrap();
        assert_eq!(format!("{} {}", detection.model, detection.version), selected);
    }
}

#[tokio::test]
async fn a_reply_larger_than_the_http2_windows_is_complete() {
    // A block at every sixth voxel of each edge: 1,000 grasps, so that the reply exceeds a window of 64 KiB.
    let resolution = 64;
    let server = Server::run(&[TestModel::new("mirror").resolution(resolution)], &[]);
    let centres: Vec<_> = (3..61)
        .step_by(6)
        .flat_map(|x| (3..61).step_by(6).flat_map(move |y| (3..61).step_by(6).map(move |z| [x, y, z])))
        .collect();
    let volume = blobs(resolution, Isometry3::identity(), &centres);
    let decoded = expected(&volume, &DecodeParams::default());
    assert!(decoded.grasps.len() * 80 > 65_536, "{} grasps", decoded.grasps.len());
    let detection = server.client().await.detect(&volume, Options::default()).await.unwrap();
    assert_same(&detection.grasps, &decoded.grasps);
}
