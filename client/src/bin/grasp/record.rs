//! MCAP recording for Foxglove and Rerun. The messages are Foxglove's protobuf types, which Rerun requires.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::SystemTime;

use anyhow::Context;
use foxglove::Encode;
use foxglove::messages::line_primitive::Type;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    Color, KeyValuePair, LinePrimitive, PackedElementField, Point3, PointCloud, Pose, Quaternion, SceneEntity,
    SceneUpdate, Timestamp, Vector3,
};
use grasp::SurfacePoint;
use grasp_client::{Detection, Proposal};
use grasp_picture::quality_color;
use mcap::Writer;
use mcap::records::MessageHeader;
use nalgebra::Point3 as Point;

/// Segments of a line of a hand that is drawn as points.
const DOTS: u32 = 32;

/// Writes the observed surface and the grasps, in the frame of the grasps. `depth` is the length of the fingers,
/// metres.
pub(crate) fn write(path: &Path, surface: &[SurfacePoint], depth: f64, detection: &Detection) -> anyhow::Result<()> {
    let file = File::create(path).with_context(|| path.display().to_string())?;
    let mut writer = Writer::new(BufWriter::new(file))?;
    let timestamp = Timestamp::try_from(detection.stamp.unwrap_or_else(SystemTime::now)).unwrap_or_default();
    let frame = if detection.frame_id.is_empty() { "task" } else { &detection.frame_id };
    let surface: Vec<_> = surface.iter().map(|point| (point.position, [90, 160, 200])).collect();
    add(&mut writer, "/surface", timestamp, &cloud(&surface, frame, timestamp))?;
    add(&mut writer, "/grasps", timestamp, &scene(&detection.grasps, depth, frame, timestamp))?;
    // The hands again as points: Rerun does not draw `SceneUpdate` messages.
    let dots: Vec<_> = detection.grasps.iter().flat_map(|grasp| dots(grasp, depth)).collect();
    add(&mut writer, "/hands", timestamp, &cloud(&dots, frame, timestamp))?;
    writer.finish()?;
    Ok(())
}

fn add<M: Encode>(
    writer: &mut Writer<BufWriter<File>>,
    topic: &str,
    timestamp: Timestamp,
    message: &M,
) -> anyhow::Result<()>
where
    M::Error: Send + Sync + 'static,
{
    let schema = M::get_schema().context("Foxglove's types have schemas")?;
    let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data)?;
    let channel_id = writer.add_channel(schema, topic, &M::get_message_encoding(), &BTreeMap::new())?;
    let mut data = Vec::new();
    message.encode(&mut data)?;
    let time = timestamp.total_nanos();
    writer.write_to_known_channel(
        &MessageHeader { channel_id, sequence: 0, log_time: time, publish_time: time },
        &data,
    )?;
    Ok(())
}

fn cloud(points: &[(Point<f64>, [u8; 3])], frame: &str, timestamp: Timestamp) -> PointCloud {
    let mut data = Vec::with_capacity(16 * points.len());
    for (point, [red, green, blue]) in points {
        data.extend(point.iter().flat_map(|&coordinate| (coordinate as f32).to_le_bytes()));
        data.extend([*red, *green, *blue, 255]);
    }
    let field =
        |name: &str, offset, kind: NumericType| PackedElementField { name: name.into(), offset, r#type: kind.into() };
    let coordinates = (0..).step_by(4).zip(["x", "y", "z"]).map(|(at, name)| field(name, at, NumericType::Float32));
    let colors = (12..).zip(["red", "green", "blue", "alpha"]).map(|(at, name)| field(name, at, NumericType::Uint8));
    PointCloud {
        timestamp: Some(timestamp),
        frame_id: frame.into(),
        pose: Some(pose([0.0; 3], [0.0, 0.0, 0.0, 1.0])),
        point_stride: 16,
        fields: coordinates.chain(colors).collect(),
        data: data.into(),
    }
}

fn scene(grasps: &[Proposal], depth: f64, frame: &str, timestamp: Timestamp) -> SceneUpdate {
    let entity = |(index, grasp): (usize, &Proposal)| {
        let [r, g, b] = quality_color(f64::from(grasp.quality)).map(|channel| f64::from(channel) / 255.0);
        let note = |key: &str, value: String| KeyValuePair { key: key.into(), value };
        SceneEntity {
            timestamp: Some(timestamp),
            frame_id: frame.into(),
            id: format!("grasp {index}"),
            metadata: vec![note("quality", grasp.quality.to_string()), note("width", grasp.width.to_string())],
            lines: vec![LinePrimitive {
                r#type: Type::LineList.into(),
                pose: Some(pose(grasp.pose.translation.vector.into(), grasp.pose.rotation.coords.into())),
                thickness: 0.003,
                points: hand(grasp.width, depth).map(|p| Point3 { x: p.x, y: p.y, z: p.z }).into(),
                color: Some(Color { r, g, b, a: 1.0 }),
                ..LinePrimitive::default()
            }],
            ..SceneEntity::default()
        }
    };
    SceneUpdate { deletions: vec![], entities: grasps.iter().enumerate().map(entity).collect() }
}

/// The lines of a hand as points.
fn dots(grasp: &Proposal, depth: f64) -> Vec<(Point<f64>, [u8; 3])> {
    let (hand, color) = (hand(grasp.width, depth), quality_color(f64::from(grasp.quality)));
    let along =
        |[from, to]: [Point<f64>; 2]| (0..=DOTS).map(move |dot| from + (to - from) * f64::from(dot) / f64::from(DOTS));
    hand.as_chunks().0.iter().copied().flat_map(along).map(|dot| (grasp.pose * dot, color)).collect()
}

fn pose([x, y, z]: [f64; 3], [qx, qy, qz, qw]: [f64; 4]) -> Pose {
    Pose { position: Some(Vector3 { x, y, z }), orientation: Some(Quaternion { x: qx, y: qy, z: qz, w: qw }) }
}

/// The lines of a hand in the grasp frame, as pairs of points: two fingers, the bar between them, and the wrist.
fn hand(width: f64, depth: f64) -> [Point<f64>; 8] {
    let (y, tip) = (width / 2.0, depth);
    [[-y, 0.0, -y, tip], [y, 0.0, y, tip], [-y, 0.0, y, 0.0], [0.0, 0.0, 0.0, -0.04]]
        .map(|[y, z, to_y, to_z]| [Point::new(0.0, y, z), Point::new(0.0, to_y, to_z)])
        .as_flattened()
        .try_into()
        .unwrap_or([Point::origin(); 8])
}
