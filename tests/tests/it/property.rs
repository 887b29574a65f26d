//! Random requests, messages and connections: the server replies to each request, and stays up and ready.

use std::cell::Cell;
use std::io::Write;
use std::net::TcpStream;

use grasp_proto::pb;
use grasp_proto::pb::grasp_service_client::GraspServiceClient;
use grasp_tests::scene::{CAMERA, camera, view};
use grasp_tests::{RESOLUTION, Raw, Server, TestModel, blobs};
use nalgebra::Isometry3;
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use prost::Message;
use tokio::runtime::Runtime;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

const VALUES: usize = RESOLUTION.pow(3);
const PIXELS: usize = CAMERA.width * CAMERA.height;
const VOXEL_SIZE: f64 = 0.3 / RESOLUTION as f64;

/// Mostly valid requests, so that they pass the first checks, with an invalid value in some fields.
fn request() -> impl Strategy<Value = pb::DetectGraspsRequest> {
    let model = prop_oneof![6 => Just(""), 3 => Just("mirror"), 1 => Just("vgn")];
    let version = prop_oneof![6 => Just(""), 2 => Just("1"), 1 => Just("9")];
    let percent = || (1..=100_u8).prop_map(|percent| f32::from(percent) / 100.0);
    let probability = || prop_oneof![6 => percent(), 1 => any::<f32>(), 1 => Just(0.0), 1 => Just(f32::NAN)];
    (
        prop_oneof![5 => "[a-z]{0,8}", 1 => ".{0,300}"],
        proptest::option::weighted(0.98, volume()),
        model,
        version,
        proptest::option::of(probability()),
        proptest::option::of(probability()),
        any::<u32>(),
        any::<bool>(),
    )
        .prop_map(|(request_id, volume, model, version, threshold, force, max_grasps, explain)| {
            let (model, version) = (model.to_owned(), version.to_owned());
            let options = pb::Options { model, version, threshold, force, max_grasps, explain, ..Default::default() };
            pb::DetectGraspsRequest { request_id, volume, options: Some(options) }
        })
}

fn volume() -> impl Strategy<Value = pb::Volume> {
    let dtype = prop_oneof![8 => 1..=3, 1 => any::<i32>()];
    let resolution = prop_oneof![12 => Just(RESOLUTION as u32), 1 => 0..300_u32, 1 => any::<u32>()];
    let voxel_size = prop_oneof![12 => Just(VOXEL_SIZE), 1 => any::<f64>()];
    (dtype, resolution, voxel_size, proptest::option::of(pose()), "[a-z]{0,8}").prop_flat_map(
        |(dtype, resolution, voxel_size, pose, frame_id)| {
            data(dtype).prop_map(move |data| pb::Volume {
                data: data.into(),
                dtype,
                resolution,
                voxel_size,
                pose,
                frame_id: frame_id.clone(),
                stamp: Some(prost_types::Timestamp { seconds: i64::MIN, nanos: -1 }),
            })
        },
    )
}

/// Random values of the type, or random bytes of the right or the wrong length.
fn data(dtype: i32) -> impl Strategy<Value = Vec<u8>> {
    let size = match dtype {
        1 => 4,
        2 => 2,
        _ => 1,
    };
    let valid = (any::<u64>(), 0.0..1.0_f32).prop_map(move |(seed, sparse)| {
        let value = move |index: u64| {
            let noise = (index ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
            let value = noise as f32 / (1 << 24) as f32;
            if value < sparse { 0.0 } else { value }
        };
        let values = (0..VALUES as u64).map(value);
        match size {
            4 => values.flat_map(f32::to_le_bytes).collect(),
            // 0x3c00 is 1.0; the patterns below it are the numbers from 0 to 1.
            2 => values.flat_map(|value| ((value * 15_360.0) as u16).to_le_bytes()).collect(),
            _ => values.map(|value| (value * 255.0) as u8).collect(),
        }
    });
    prop_oneof![
        10 => valid,
        1 => vec(any::<u8>(), VALUES * size),
        1 => vec(any::<u8>(), 0..100),
    ]
}

fn pose() -> impl Strategy<Value = pb::Pose> {
    let coordinate = || prop_oneof![20 => -1.0..1.0, 1 => any::<f64>()];
    let position = (coordinate(), coordinate(), coordinate()).prop_map(|(x, y, z)| pb::Vector3 { x, y, z });
    let unit = (0.0..1.0_f64).prop_map(|turn| {
        let (z, w) = (turn * 6.0).sin_cos();
        pb::Quaternion { z, w, ..Default::default() }
    });
    let any = (any::<f64>(), any::<f64>(), any::<f64>(), any::<f64>());
    let any = any.prop_map(|(x, y, z, w)| pb::Quaternion { x, y, z, w });
    let orientation = prop_oneof![8 => unit, 1 => any];
    (proptest::option::weighted(0.97, position), proptest::option::weighted(0.97, orientation))
        .prop_map(|(position, orientation)| pb::Pose { position, orientation })
}

/// Checks the properties that every reply must have.
fn check(request: &pb::DetectGraspsRequest, response: &pb::DetectGraspsResponse) {
    let volume = request.volume.as_ref().expect("a request without a volume is refused");
    assert_eq!((&response.frame_id, response.stamp), (&volume.frame_id, volume.stamp));
    assert!(request.request_id.is_empty() || response.request_id == request.request_id);
    assert!(response.grasps.is_sorted_by(|a, b| a.quality >= b.quality), "best first");
    for grasp in &response.grasps {
        assert!(grasp.quality > 0.0 && grasp.quality <= 1.0 && grasp.width > 0.0, "{grasp:?}");
        let pose = grasp.pose.expect("a grasp has a pose");
        let (position, orientation) = (pose.position.expect("position"), pose.orientation.expect("orientation"));
        assert!([position.x, position.y, position.z].iter().all(|c| c.is_finite()), "{pose:?}");
        let pb::Quaternion { x, y, z, w } = orientation;
        assert!((x * x + y * y + z * z + w * w - 1.0).abs() < 1e-6, "{pose:?}");
    }
    let options = request.options.as_ref().expect("every request has options");
    if options.max_grasps > 0 {
        assert!(response.grasps.len() <= options.max_grasps as usize);
    }
    assert_eq!(response.dropped.is_some(), options.explain || response.grasps.is_empty());
    if let Some(dropped) = &response.dropped {
        let pb::Dropped { below_threshold, mask, width, suppressed, over_limit, .. } = *dropped;
        let voxels = below_threshold + mask + width + suppressed + over_limit;
        assert_eq!(voxels as usize + response.grasps.len(), VALUES, "{dropped:?}");
    }
}

struct Target {
    server: Server,
    channel: Channel,
    runtime: Runtime,
}

impl Target {
    fn new() -> Self {
        let runtime = Runtime::new().unwrap();
        let server = Server::run(&[TestModel::new("mirror")], &["--log", "error"]);
        let channel = runtime.block_on(server.channel());
        Self { server, channel, runtime }
    }

    /// A valid request is still answered on the same connection.
    fn assert_usable(&self) {
        assert_eq!(self.server.get("/readyz"), (200, "ready\n".to_owned()));
        let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
        let volume = grasp_proto::encode(&volume, pb::DataType::F32, "");
        let request = pb::DetectGraspsRequest { volume: Some(volume), ..Default::default() };
        let mut client = GraspServiceClient::new(self.channel.clone());
        let response = self.runtime.block_on(client.detect_grasps(request)).unwrap().into_inner();
        assert_eq!(response.grasps.len(), 1);
        assert_eq!(self.server.metric("graspd_requests_total{code=\"INTERNAL\",model=\"mirror 1\"}"), 0.0);
    }
}

#[test]
fn random_requests_are_answered_or_refused() {
    let target = Target::new();
    let (answered, refused) = (Cell::new(0), Cell::new(0));
    let mut runner = TestRunner::new(Config { cases: 800, failure_persistence: None, ..Config::default() });
    let outcome = runner.run(&request().no_shrink(), |request| {
        let mut client = GraspServiceClient::new(target.channel.clone());
        match target.runtime.block_on(client.detect_grasps(request.clone())) {
            Ok(response) => {
                answered.set(answered.get() + 1);
                check(&request, response.get_ref());
            }
            Err(status) => {
                refused.set(refused.get() + 1);
                prop_assert!(matches!(status.code(), Code::InvalidArgument | Code::NotFound), "{status}");
                let message = status.message();
                let has_the_value = message.contains(" is ") || message.contains(" not found; available: ");
                prop_assert!(has_the_value, "the message must contain the field and the value: {status}");
            }
        }
        Ok(())
    });
    outcome.unwrap();
    let (answered, refused) = (answered.get(), refused.get());
    assert!(answered > 100 && refused > 100, "{answered} answered, {refused} refused: the requests are too uniform");
    target.assert_usable();
}

/// Mostly valid requests for scores, from two labelled views of a block.
fn score_request() -> impl Strategy<Value = pb::ScoreGraspsRequest> {
    let candidate =
        (proptest::option::weighted(0.97, pose()), proptest::option::of(prop_oneof![8 => 0.0..0.1, 1 => any::<f64>()]))
            .prop_map(|(pose, width)| pb::Candidate { pose, width });
    let margin = || prop_oneof![8 => proptest::option::of(0.0..0.1), 1 => any::<f64>().prop_map(Some)];
    let objects = prop_oneof![4 => Just(vec![]), 2 => vec(1..4_u32, 1..3), 1 => vec(any::<u32>(), 1..3)];
    let label_type = prop_oneof![8 => Just(1), 1 => any::<i32>()];
    let length = prop_oneof![8 => Just(PIXELS), 1 => 0..2 * PIXELS];
    let labels = (label_type, length).prop_map(|(r#type, length)| {
        let data: Vec<u8> = (0..length).map(|pixel| (pixel / 50 % 4) as u8).collect();
        pb::Labels { data: data.into(), r#type }
    });
    let extent = proptest::option::weighted(0.05, (any::<f64>(), 0.1..1.0).prop_map(|(x, y)| pb::Extent { x, y }));
    let mode = proptest::option::weighted(0.8, prop_oneof![12 => 0..3, 1 => any::<i32>()]);
    let options = (objects, margin(), margin(), any::<bool>(), mode, proptest::option::weighted(0.05, pose()));
    let candidates = prop_oneof![12 => vec(candidate, 1..4), 1 => Just(vec![])];
    (candidates, proptest::option::weighted(0.95, labels), extent, options).prop_map(
        |(candidates, labels, extent, (objects, margin, clearance, hidden, mode, region_pose))| {
            let views = [-90.0, 90.0].map(|azimuth| {
                let view = pb::DepthView::from(&view(&camera(35.0, azimuth)));
                pb::DepthView { labels: labels.clone(), ..view }
            });
            let workspace = Some(pb::Workspace { extent, ..Default::default() });
            let collision = Some(pb::CollisionCheck { mode, clearance, hidden, ..Default::default() });
            let options = pb::Options { objects, margin, collision, region_pose, ..Default::default() };
            pb::ScoreGraspsRequest {
                candidates,
                scene: Some(pb::score_grasps_request::Scene::Depth(pb::DepthViews { views: views.into(), workspace })),
                options: Some(options),
                ..Default::default()
            }
        },
    )
}

#[test]
fn random_candidates_are_scored_or_refused() {
    let target = Target::new();
    let (answered, refused) = (Cell::new(0), Cell::new(0));
    let mut runner = TestRunner::new(Config { cases: 200, failure_persistence: None, ..Config::default() });
    let outcome = runner.run(&score_request().no_shrink(), |request| {
        let mut client = GraspServiceClient::new(target.channel.clone());
        let count = request.candidates.len();
        match target.runtime.block_on(client.score_grasps(request)) {
            Ok(response) => {
                answered.set(answered.get() + 1);
                let scores = &response.get_ref().scores;
                prop_assert_eq!(scores.len(), count);
                for score in scores {
                    prop_assert!((0.0..=1.0).contains(&score.quality), "{score:?}");
                    prop_assert!(score.open_width.is_none_or(|width| (0.0..=0.081).contains(&width)), "{score:?}");
                }
            }
            Err(status) => {
                refused.set(refused.get() + 1);
                prop_assert_eq!(status.code(), Code::InvalidArgument, "{}", status);
            }
        }
        Ok(())
    });
    outcome.unwrap();
    let (answered, refused) = (answered.get(), refused.get());
    assert!(answered > 20 && refused > 20, "{answered} answered, {refused} refused: the requests are too uniform");
    target.assert_usable();
}

#[test]
fn malformed_messages_are_refused() {
    let target = Target::new();
    let message = (request(), vec((any::<prop::sample::Index>(), any::<u8>()), 1..4), any::<prop::sample::Index>());
    let damaged = message.prop_map(|(request, changes, end)| {
        let mut bytes = request.encode_to_vec();
        bytes.truncate(end.index(bytes.len() + 1));
        for (index, byte) in changes {
            if !bytes.is_empty() {
                let index = index.index(bytes.len().min(64));
                bytes[index] = byte;
            }
        }
        bytes
    });
    let bytes = prop_oneof![damaged, vec(any::<u8>(), 0..200)];
    let mut runner = TestRunner::new(Config { cases: 400, failure_persistence: None, ..Config::default() });
    let outcome = runner.run(&bytes.no_shrink(), |bytes| {
        if let Err(status) = target.runtime.block_on(send(target.channel.clone(), bytes)) {
            let codes = [Code::InvalidArgument, Code::NotFound];
            prop_assert!(codes.contains(&status.code()), "{status}");
        }
        Ok(())
    });
    outcome.unwrap();
    target.assert_usable();
}

#[test]
fn connections_with_another_protocol_do_no_harm() {
    let target = Target::new();
    let mut runner = TestRunner::new(Config { cases: 300, failure_persistence: None, ..Config::default() });
    let preface = Just(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec());
    let bytes = (prop_oneof![preface, Just(Vec::new())], vec(any::<u8>(), 0..500));
    let outcome = runner.run(&bytes.no_shrink(), |(preface, noise)| {
        for address in [target.server.grpc(), target.server.http()] {
            let mut stream = TcpStream::connect(address).unwrap();
            // The server may close the connection before all bytes are written.
            let _ = stream.write_all(&preface).and_then(|()| stream.write_all(&noise));
        }
        Ok(())
    });
    outcome.unwrap();
    target.assert_usable();
}

/// Calls DetectGrasps with bytes that may not be a valid message.
async fn send(channel: Channel, bytes: Vec<u8>) -> Result<(), Status> {
    let mut grpc = tonic::client::Grpc::new(channel);
    grpc.ready().await.map_err(|error| Status::unavailable(error.to_string()))?;
    let path = PathAndQuery::from_static("/grasp.v1.GraspService/DetectGrasps");
    grpc.unary(Request::new(bytes.into()), path, Raw).await.map(drop)
}
