//! Arbitrary bytes as options, depth images and point clouds: decoded, checked and fused.

#![no_main]

use grasp::{DetectParams, Fusion};
use grasp_perception::{Frames, Tabletop, View, Warning, Workspace, seen_from};
use grasp_proto::pb;
use libfuzzer_sys::fuzz_target;
use nalgebra::Isometry3;
use prost::Message;

fuzz_target!(|bytes: &[u8]| {
    let Some((&kind, bytes)) = bytes.split_first() else { return };
    match kind % 5 {
        0 => options(bytes),
        1 => depth(bytes),
        2 => cloud(bytes),
        3 => candidates(bytes),
        _ => fitting(bytes),
    }
});

/// Poses with valid options are finite.
fn options(bytes: &[u8]) {
    let Ok(options) = pb::Options::decode(bytes) else { return };
    let Ok(params) = DetectParams::try_from(&options) else { return };
    let grasp = Isometry3::translation(0.1, 0.2, 0.3);
    for pose in params.poses(&grasp) {
        assert!(pose.translation.vector.iter().all(|c| c.is_finite()), "{pose}");
    }
    let _ = params.constraints.violation(&grasp, &params.clearance().hand);
}

/// Valid candidates are finite.
fn candidates(bytes: &[u8]) {
    let Ok(request) = pb::ScoreGraspsRequest::decode(bytes) else { return };
    let Ok(params) = DetectParams::try_from(&request.options.unwrap_or_default()) else { return };
    match grasp_proto::candidates(&request.candidates, &params) {
        Ok(candidates) => {
            for candidate in candidates {
                let pose = candidate.pose;
                assert!(pose.translation.vector.iter().all(|c| c.is_finite()), "{pose}");
            }
        }
        Err(error) => assert!(error.message.starts_with(error.field()), "{error:?}"),
    }
}

fn depth(bytes: &[u8]) {
    let Ok(request) = pb::DetectGraspsFromDepthRequest::decode(bytes) else { return };
    let Ok(mut workspace) = Workspace::try_from(request.workspace.unwrap_or_default()) else { return };
    match grasp_proto::frames(&request.views) {
        Err(error) => assert!(error.message.starts_with(error.field()), "{error:?}"),
        Ok(frames) => {
            let mut frames = Frames::Depth(frames);
            if let Err(error) = workspace.find_table(&mut frames, 0.05, 0.3) {
                assert!(error.message.starts_with(error.field()), "{error:?}");
            }
        }
    }
    request.views.iter().for_each(|view| check(view, &workspace.frame_from_task));
}

fn cloud(bytes: &[u8]) {
    let Ok(request) = pb::DetectGraspsFromCloudRequest::decode(bytes) else { return };
    let Ok(clouds) = grasp_proto::clouds(&request.views) else { return };
    for cloud in &clouds {
        if let Some(view) = seen_from(&cloud.points, &cloud.eye, 0.3) {
            assert!(view.image.depth().iter().all(|depth| depth.is_finite() && *depth >= 0.0));
            integrate(&view);
        }
    }
    if let Ok(mut workspace) = Workspace::try_from(request.workspace.unwrap_or_default())
        && let Err(error) = workspace.find_table(&mut Frames::Clouds(clouds), 0.05, 0.3)
    {
        assert!(error.message.starts_with(error.field()), "{error:?}");
    }
}

/// A depth image whose data has the length for its size, which random bytes almost never have.
fn fitting(mut bytes: &[u8]) {
    let mut number = || Some(f64::from_le_bytes(*bytes.split_off(..8)?.first_chunk()?));
    let mut view = || {
        let k = [number()?, 0.0, number()?, 0.0, number()?, number()?, 0.0, 0.0, 1.0].to_vec();
        let position = pb::Vector3 { x: number()?, y: number()?, z: number()? };
        let orientation = pb::Quaternion { x: number()?, y: number()?, z: number()?, w: number()? };
        let pose = pb::Pose { position: Some(position), orientation: Some(orientation) };
        Some((k, pose))
    };
    let Some((k, pose)) = view() else { return };
    let data: Vec<u8> = bytes.iter().copied().cycle().take(if bytes.is_empty() { 0 } else { 12 * 9 * 4 }).collect();
    let view = pb::DepthView {
        data: data.into(),
        unit: pb::DepthUnit::F32Metres.into(),
        camera: Some(pb::Camera { width: 12, height: 9, k }),
        extrinsics: Some(pb::depth_view::Extrinsics::CameraFromTask(pose)),
        labels: Some(pb::Labels { data: vec![3; 12 * 9].into(), r#type: pb::LabelType::U8.into() }),
    };
    check(&view, &Isometry3::identity());
}

fn check(view: &pb::DepthView, frame_from_task: &Isometry3<f64>) {
    match grasp_proto::frame(view).and_then(|frame| frame.in_task(frame_from_task)) {
        Ok(view) => integrate(&view),
        Err(error) => assert!(error.message.starts_with(error.field()), "{error:?}"),
    }
}

/// Every valid view gives a valid volume, or a reason why nothing was measured.
fn integrate(view: &View) {
    let image = &view.image;
    if let Ok(table) = Tabletop::find(image, None, 0.05) {
        assert!(table.camera_from_task.translation.vector.iter().all(|c| c.is_finite()), "{table:?}");
    }
    let mut fusion = Fusion::new(8, 0.3).forgetting(3.0);
    let _ = fusion.contradicted(image, &view.camera_from_task);
    if fusion.integrate(image, &view.camera_from_task) == 0 {
        assert!(!fusion.no_measurement(image, &view.camera_from_task).to_string().is_empty());
    }
    if let Ok(volume) = fusion.volume(Isometry3::identity()) {
        let _ = Warning::of_table(&volume, 0.05);
        let mesh = volume.mesh();
        assert!(mesh.triangles.iter().flatten().all(|&corner| (corner as usize) < mesh.vertices.len()));
    }
}
