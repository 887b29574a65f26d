//! The metrics for Prometheus.

use grasp_client::Options;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;

const STAGES: [&str; 5] = ["queue", "preprocessing", "inference", "postprocessing", "total"];

#[tokio::test]
async fn every_reply_is_counted_in_the_histogram_of_every_stage() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("other")], &[]);
    let client = server.client().await;
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5], [11, 11, 11]]);
    let mut seconds = 0.0;
    for _ in 0..7 {
        seconds += client.detect(&volume, Options::default()).await.unwrap().latency.total;
    }
    for stage in STAGES {
        let series =
            |suffix, le| format!("graspd_stage_duration_seconds_{suffix}{{model=\"mirror 1\",stage=\"{stage}\"{le}}}");
        assert_eq!(server.metric(&series("count", "")), 7.0, "{stage}");
        assert_eq!(server.metric(&series("bucket", ",le=\"+Inf\"")), 7.0, "{stage}");
    }
    let sum = server.metric("graspd_stage_duration_seconds_sum{model=\"mirror 1\",stage=\"total\"}");
    assert!((sum - seconds).abs() < 1e-9, "{sum} s in the histogram, {seconds} s in the replies");
    assert_eq!(server.metric("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}"), 7.0);
    assert_eq!(server.metric("graspd_grasps_total{model=\"mirror 1\"}"), 14.0);
    let other = server.metric("graspd_stage_duration_seconds_count{model=\"other 1\",stage=\"total\"}");
    assert_eq!(other, 0.0, "the other model has no requests");
}

#[tokio::test]
async fn the_buckets_are_dense_from_50_microseconds_to_10_seconds() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
    server.client().await.detect(&volume, Options::default()).await.unwrap();
    let (_, text) = server.get("/metrics");
    let prefix = "graspd_stage_duration_seconds_bucket{model=\"mirror 1\",stage=\"total\",le=\"";
    let bounds = text.lines().filter_map(|line| line.strip_prefix(prefix)?.split('"').next()?.parse().ok());
    let bounds: Vec<f64> = bounds.filter(|bound: &f64| bound.is_finite()).collect();
    assert_eq!((bounds.first(), bounds.last()), (Some(&50e-6), Some(&10.0)));
    assert!(bounds.windows(2).all(|pair| pair[1] > pair[0] && pair[1] <= 1.7 * pair[0]), "{bounds:?}");
}

#[tokio::test]
async fn metrics_are_in_the_format_of_prometheus() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (status, text) = server.get("/metrics");
    assert_eq!(status, 200);
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let (series, value) = line.rsplit_once(' ').unwrap();
        assert!(series.starts_with("graspd_") || series.starts_with("process_"), "{line}");
        assert!(value.parse::<f64>().is_ok(), "{line}");
    }
    assert!(text.contains("# TYPE graspd_queue_requests gauge"));
    assert_eq!(server.get("/nothing").0, 404);
}
