//! Every kind of invalid request is refused with its own status, and the connection stays usable.

use grasp::Volume;
use grasp_proto::encode;
use grasp_proto::pb::{self, DataType};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tonic::Code;
use tonic_types::StatusExt;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]])
}

fn request() -> pb::DetectGraspsRequest {
    pb::DetectGraspsRequest { volume: Some(encode(&volume(), DataType::F32, "base")), ..Default::default() }
}

fn with_options(options: pb::Options) -> pb::DetectGraspsRequest {
    pb::DetectGraspsRequest { options: Some(options), ..request() }
}

fn with_data(values: &[f32]) -> impl Fn(&mut pb::Volume) + use<> {
    let data: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    move |volume| volume.data = data.clone().into()
}

fn with_value(index: usize, value: f32) -> impl Fn(&mut pb::Volume) {
    let mut values = volume().values().to_vec();
    values[index] = value;
    with_data(&values)
}

fn with_pose(position: [f64; 3], orientation: [f64; 4]) -> impl Fn(&mut pb::Volume) {
    move |volume| {
        let ([x, y, z], [qx, qy, qz, qw]) = (position, orientation);
        let (position, orientation) = (pb::Vector3 { x, y, z }, pb::Quaternion { x: qx, y: qy, z: qz, w: qw });
        volume.pose = Some(pb::Pose { position: Some(position), orientation: Some(orientation) });
    }
}

/// A server and one connection to it.
struct Case {
    server: Server,
    client: pb::grasp_service_client::GraspServiceClient<tonic::transport::Channel>,
}

impl Case {
    async fn new() -> Self {
        let server = Server::run(&[TestModel::new("mirror"), TestModel::new("second").resolution(24)], &[]);
        let client = server.raw().await;
        Self { server, client }
    }

    /// The request is refused with this code and message, and the next one on the same connection is answered.
    async fn assert_refused(&mut self, request: pb::DetectGraspsRequest, code: Code, message: &str) {
        let status = self.client.detect_grasps(request).await.expect_err(message);
        assert_eq!((status.code(), status.message()), (code, message));
        if code == Code::InvalidArgument {
            let details = status.get_details_bad_request().expect("a google.rpc.BadRequest");
            let violation = &details.field_violations[0];
            assert!(message.starts_with(&violation.field), "{violation:?}");
            assert_eq!(violation.description, message);
        }
        self.assert_still_answers().await;
    }

    async fn assert_volume_refused(&mut self, change: impl Fn(&mut pb::Volume), message: &str) {
        let mut request = request();
        request.volume.as_mut().map(change);
        self.assert_refused(request, Code::InvalidArgument, message).await;
    }

    async fn assert_still_answers(&mut self) {
        let response = self.client.detect_grasps(request()).await.unwrap().into_inner();
        assert_eq!(response.grasps.len(), 1);
    }
}

#[tokio::test]
async fn the_length_of_the_data_must_match_resolution_and_dtype() {
    let mut case = Case::new().await;
    let length = |bytes: usize| {
        format!("volume.data is {bytes} bytes, a resolution of 16 needs 16³ · 4 = 16384 (DATA_TYPE_F32)")
    };
    case.assert_volume_refused(|v| v.data = vec![0; 16_383].into(), &length(16_383)).await;
    case.assert_volume_refused(|v| v.data = vec![0; 16_388].into(), &length(16_388)).await;
    case.assert_volume_refused(|v| v.data = vec![].into(), &length(0)).await;
    for (dtype, value) in [(0, "0"), (4, "4"), (-1, "-1")] {
        let message =
            format!("volume.dtype is {value}, must be DATA_TYPE_F32 (1), DATA_TYPE_F16 (2) or DATA_TYPE_U8 (3)");
        case.assert_volume_refused(|v| v.dtype = dtype, &message).await;
    }
}

#[tokio::test]
async fn the_resolution_must_be_that_of_a_model() {
    let mut case = Case::new().await;
    let mut other = request();
    other.volume = Some(encode(&blobs(20, Isometry3::identity(), &[[5, 5, 5]]), DataType::F32, ""));
    let supported = "supported: 16 (mirror 1), 24 (second 1)";
    case.assert_refused(other.clone(), Code::InvalidArgument, &format!("volume.resolution is 20, {supported}")).await;
    other.options = Some(pb::Options { model: "mirror".to_owned(), ..Default::default() });
    let supported = "supported: 16 (mirror 1)";
    case.assert_refused(other, Code::InvalidArgument, &format!("volume.resolution is 20, {supported}")).await;
    for resolution in [0, 257, u32::MAX] {
        let message = format!("volume.resolution is {resolution}, must be from 1 to 256");
        case.assert_volume_refused(|v| v.resolution = resolution, &message).await;
    }
}

#[tokio::test]
async fn the_values_must_be_finite_and_between_0_and_1() {
    let mut case = Case::new().await;
    let finite = "every value must be finite";
    case.assert_volume_refused(with_value(77, f32::NAN), &format!("volume.data[77] is NaN, {finite}")).await;
    case.assert_volume_refused(with_value(0, f32::INFINITY), &format!("volume.data[0] is inf, {finite}")).await;
    case.assert_volume_refused(with_value(4095, f32::NEG_INFINITY), &format!("volume.data[4095] is -inf, {finite}"))
        .await;
    let range = "every value must lie in [0, 1] (0.5 = surface, 0 = unobserved)";
    case.assert_volume_refused(with_value(1, 1.5), &format!("volume.data[1] is 1.5, {range}")).await;
    case.assert_volume_refused(with_value(2, -0.25), &format!("volume.data[2] is -0.25, {range}")).await;
    let empty = "volume.data is all zero: nothing was observed; check the camera's extrinsics and the workspace pose";
    case.assert_volume_refused(with_data(&[0.0; 4096]), empty).await;
}

#[tokio::test]
async fn half_precision_values_are_checked() {
    let mut case = Case::new().await;
    // 0x7e00 is NaN, 0x4000 is 2.
    for (bits, message) in [(0x7e00_u16, "is NaN, every value must be finite"), (0x4000, "is 2, every value must lie")]
    {
        let mut request = request();
        let mut volume = encode(&volume(), DataType::F16, "");
        let mut data = volume.data.to_vec();
        data[1000..1002].copy_from_slice(&bits.to_le_bytes());
        volume.data = data.into();
        request.volume = Some(volume);
        let status = case.client.detect_grasps(request).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument);
        assert!(status.message().starts_with(&format!("volume.data[500] {message}")), "{}", status.message());
    }
    case.assert_still_answers().await;
}

#[tokio::test]
async fn the_voxel_size_must_match_the_model() {
    let mut case = Case::new().await;
    for size in [0.0, -0.0075, f64::NAN, f64::INFINITY] {
        let message = format!("volume.voxel_size is {size}, must be a positive number of metres");
        case.assert_volume_refused(|v| v.voxel_size = size, &message).await;
    }
    let message = "volume.voxel_size is 18.75, must be 0.01875 m (±0.1 %) for the model mirror 1";
    case.assert_volume_refused(|v| v.voxel_size = 18.75, message).await;
    for factor in [0.9985, 1.0015] {
        let size = 0.01875 * factor;
        let message = format!("volume.voxel_size is {size}, must be 0.01875 m (±0.1 %) for the model mirror 1");
        case.assert_volume_refused(|v| v.voxel_size = size, &message).await;
    }
    let mut request = request();
    request.volume.as_mut().unwrap().voxel_size = 0.01875 * 1.0005;
    assert!(case.client.detect_grasps(request).await.is_ok());
}

#[tokio::test]
async fn the_pose_must_be_finite_with_a_unit_quaternion() {
    let mut case = Case::new().await;
    let unit = "must be of unit length to within 0.001";
    case.assert_volume_refused(
        with_pose([0.0; 3], [0.0, 0.0, 0.0, 2.0]),
        &format!("volume.pose.orientation is (x 0, y 0, z 0, w 2), of length 2, {unit}"),
    )
    .await;
    case.assert_volume_refused(
        with_pose([0.0; 3], [0.0; 4]),
        &format!("volume.pose.orientation is (x 0, y 0, z 0, w 0), of length 0, {unit}"),
    )
    .await;
    case.assert_volume_refused(
        with_pose([0.0; 3], [f64::NAN, 0.0, 0.0, 1.0]),
        &format!("volume.pose.orientation is (x NaN, y 0, z 0, w 1), of length NaN, {unit}"),
    )
    .await;
    case.assert_volume_refused(
        with_pose([0.0, f64::INFINITY, 0.0], [0.0, 0.0, 0.0, 1.0]),
        "volume.pose.position is (0, inf, 0), must be finite",
    )
    .await;
    let half = |volume: &mut pb::Volume| {
        volume.pose = Some(pb::Pose { position: Some(pb::Vector3::default()), orientation: None })
    };
    case.assert_volume_refused(half, "volume.pose.orientation is absent, must be given").await;
    let half = |volume: &mut pb::Volume| volume.pose = Some(pb::Pose::default());
    case.assert_volume_refused(half, "volume.pose.position is absent, must be given").await;

    let mut request = request();
    with_pose([0.0; 3], [0.0, 0.0, 0.0, 1.0009])(request.volume.as_mut().unwrap());
    assert!(case.client.detect_grasps(request).await.is_ok(), "within the tolerance");
}

#[tokio::test]
async fn the_model_and_its_version_must_be_loaded() {
    let mut case = Case::new().await;
    let not_found = "not found; available: mirror 1, second 1, shaf 1";
    let named = |model: &str, version: &str| {
        with_options(pb::Options { model: model.to_owned(), version: version.to_owned(), ..Default::default() })
    };
    case.assert_refused(named("vgn", ""), Code::NotFound, &format!("options.model: `vgn` {not_found}")).await;
    // Names are not resolved as paths.
    let path = "../mirror-1.onnx";
    case.assert_refused(named(path, ""), Code::NotFound, &format!("options.model: `{path}` {not_found}")).await;
    case.assert_refused(named("mirror", "2"), Code::NotFound, &format!("options.version: `mirror 2` {not_found}"))
        .await;
    let message = "options.version is `1`, but options.model is empty: name the model of this version";
    case.assert_refused(named("", "1"), Code::InvalidArgument, message).await;
}

#[tokio::test]
async fn the_parameters_must_be_in_range() {
    let mut case = Case::new().await;
    case.assert_refused(Default::default(), Code::InvalidArgument, "volume is absent, must be given").await;
    for value in [0.0, -0.5, 1.5, f32::NAN] {
        let range = format!("is {value}, must be above 0 and at most 1");
        let bad = with_options(pb::Options { threshold: Some(value), ..Default::default() });
        case.assert_refused(bad, Code::InvalidArgument, &format!("options.threshold {range}")).await;
        let bad = with_options(pb::Options { force: Some(value), ..Default::default() });
        case.assert_refused(bad, Code::InvalidArgument, &format!("options.force {range}")).await;
    }
    let bad = pb::DetectGraspsRequest { request_id: "x".repeat(257), ..request() };
    case.assert_refused(bad, Code::InvalidArgument, "request_id is 257 bytes long, must be at most 256").await;
    case.assert_volume_refused(
        |v| v.frame_id = "x".repeat(300),
        "volume.frame_id is 300 bytes long, must be at most 256",
    )
    .await;
}

#[tokio::test]
async fn invalid_outputs_of_a_model_fail_only_their_request() {
    let server = Server::run(&[TestModel::new("broken").breaks_at(0.6)], &[]);
    let mut client = server.raw().await;
    for _ in 0..3 {
        let status = client.detect_grasps(request()).await.unwrap_err();
        assert_eq!(status.code(), Code::Internal);
        assert!(status.message().contains("`rotation`"), "{}", status.message());
        // No voxel reaches this threshold, so no quaternion is read.
        let empty = with_options(pb::Options { threshold: Some(1.0), ..Default::default() });
        assert!(client.detect_grasps(empty).await.unwrap().into_inner().grasps.is_empty());
    }
    assert_eq!(server.get("/readyz").0, 200);
}

#[tokio::test]
async fn refusals_are_counted_by_code() {
    let mut case = Case::new().await;
    case.assert_volume_refused(|v| v.voxel_size = 0.0, "volume.voxel_size is 0, must be a positive number of metres")
        .await;
    let unknown = with_options(pb::Options { model: "vgn".to_owned(), ..Default::default() });
    case.client.detect_grasps(unknown).await.unwrap_err();
    let count =
        |code, model| case.server.metric(&format!("graspd_requests_total{{code=\"{code}\",model=\"{model}\"}}"));
    assert_eq!(count("INVALID_ARGUMENT", "mirror 1"), 1.0);
    assert_eq!(count("NOT_FOUND", ""), 1.0);
    assert_eq!(count("OK", "mirror 1"), 1.0);
}
