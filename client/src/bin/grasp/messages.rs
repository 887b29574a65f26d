//! What Foxglove and Rerun show of a detection. The messages are Foxglove's protobuf types, which Rerun requires.

use std::time::SystemTime;

use anyhow::Context;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    Color, KeyValuePair, LinePrimitive, PackedElementField, Point3, PointCloud, Pose, Quaternion, SceneEntity,
    SceneEntityDeletion, SceneUpdate, Timestamp, Vector3, line_primitive, scene_entity_deletion,
};
use foxglove::{Encode, Schema};
use grasp::DetectParams;
use grasp_client::{DetectOptions, Detection, Proposal};
use grasp_picture::quality_color;
use nalgebra::{Isometry3, Point3 as Point};

use crate::drawing::outline;
use crate::scene::Scene;

/// Colours of the points that the cameras measured, and of the fused surface.
const CLOUD: [u8; 3] = [150, 150, 150];
const SURFACE: [u8; 3] = [90, 160, 200];

/// Points of a cloud of at most 1 MB.
const MAX_POINTS: usize = 60_000;

/// Thickness of the lines of a hand, metres.
const THICKNESS: f64 = 0.003;

/// Segments of a line of a hand that is drawn as points.
const DOTS: u32 = 32;

/// An encoded message, and what a reader needs to decode it.
pub(crate) struct Message {
    pub topic: &'static str,
    pub schema: Schema,
    /// Encoding of `data`.
    pub encoding: String,
    /// Time of the observation, nanoseconds since the epoch.
    pub time: u64,
    pub data: Vec<u8>,
}

/// One message for each topic, in the frame of the grasps:
///
/// - `/cloud`: what the cameras measured, also outside the workspace; absent for a volume,
/// - `/surface`: the fused surface in the workspace,
/// - `/workspace`: the edges of the workspace, the height of the table on its sides, and the axes of the task frame,
/// - `/grasps`: the hands as lines, with their quality and width,
/// - `/hands`: the hands again, as points.
///
/// `options` are those of the request.
pub(crate) fn messages(scene: &Scene, options: &DetectOptions, detection: &Detection) -> anyhow::Result<Vec<Message>> {
    let params = DetectParams::try_from(options)?;
    let depth = params.finger_depth();
    let finger_base = |grasp: &Proposal| Proposal { pose: params.convention.grasp(&grasp.pose, depth), ..*grasp };
    let grasps: Vec<Proposal> = detection.grasps.iter().map(finger_base).collect();
    let header = Header::new(detection);

    let mut messages = Vec::new();
    if let Some(points) = scene.points(detection, MAX_POINTS)? {
        messages.push(header.cloud("/cloud", points.into_iter().map(|point| (point, CLOUD)))?);
    }
    let volume = scene.volume(detection)?;
    let surface = volume.surface().into_iter().map(|point| (volume.pose() * point.position, SURFACE));
    messages.push(header.cloud("/surface", surface)?);
    messages.push(header.scene("/workspace", vec![header.workspace(scene, &params, detection)?])?);
    let entities = grasps.iter().enumerate().map(|(index, grasp)| header.hand(index, grasp, depth));
    messages.push(header.scene("/grasps", entities.collect())?);
    // Rerun does not draw `SceneUpdate` messages.
    messages.push(header.cloud("/hands", grasps.iter().flat_map(|grasp| dots(grasp, depth)))?);
    Ok(messages)
}

/// Time and frame of all messages.
struct Header {
    timestamp: Timestamp,
    frame_id: String,
}

impl Header {
    fn new(detection: &Detection) -> Self {
        let timestamp = Timestamp::try_from(detection.stamp.unwrap_or_else(SystemTime::now)).unwrap_or_default();
        let frame_id = if detection.frame_id.is_empty() { "task" } else { &detection.frame_id };
        Self { timestamp, frame_id: frame_id.to_owned() }
    }

    fn message<M: Encode>(&self, topic: &'static str, message: &M) -> anyhow::Result<Message>
    where
        M::Error: Send + Sync + 'static,
    {
        let schema = M::get_schema().context("Foxglove's types have schemas")?;
        let mut data = Vec::new();
        message.encode(&mut data)?;
        Ok(Message { topic, schema, encoding: M::get_message_encoding(), time: self.timestamp.total_nanos(), data })
    }

    fn cloud(
        &self,
        topic: &'static str,
        points: impl Iterator<Item = (Point<f64>, [u8; 3])>,
    ) -> anyhow::Result<Message> {
        let mut data = Vec::new();
        for (point, [red, green, blue]) in points {
            data.extend(point.iter().flat_map(|&coordinate| (coordinate as f32).to_le_bytes()));
            data.extend([red, green, blue, 255]);
        }
        let field = |name: &str, offset, kind: NumericType| PackedElementField {
            name: name.into(),
            offset,
            r#type: kind.into(),
        };
        let coordinates = (0..).step_by(4).zip(["x", "y", "z"]).map(|(at, name)| field(name, at, NumericType::Float32));
        let colors =
            (12..).zip(["red", "green", "blue", "alpha"]).map(|(at, name)| field(name, at, NumericType::Uint8));
        let cloud = PointCloud {
            timestamp: Some(self.timestamp),
            frame_id: self.frame_id.clone(),
            pose: Some(pose(&Isometry3::identity())),
            point_stride: 16,
            fields: coordinates.chain(colors).collect(),
            data: data.into(),
        };
        self.message(topic, &cloud)
    }

    /// Replaces all entities of the topic.
    fn scene(&self, topic: &'static str, entities: Vec<SceneEntity>) -> anyhow::Result<Message> {
        let all = SceneEntityDeletion {
            timestamp: Some(self.timestamp),
            r#type: scene_entity_deletion::Type::All.into(),
            ..SceneEntityDeletion::default()
        };
        self.message(topic, &SceneUpdate { deletions: vec![all], entities })
    }

    fn entity(&self, id: String) -> SceneEntity {
        SceneEntity { timestamp: Some(self.timestamp), frame_id: self.frame_id.clone(), id, ..SceneEntity::default() }
    }

    fn workspace(&self, scene: &Scene, params: &DetectParams, detection: &Detection) -> anyhow::Result<SceneEntity> {
        let (frame_from_task, lengths) = scene.workspace(detection)?;
        let outline = outline(lengths, params.table);
        let line = |of_color: &[crate::drawing::Line]| {
            let points = of_color.iter().flat_map(|line| line.ends);
            lines(&frame_from_task, of_color[0].thickness, of_color[0].color, points)
        };
        let lines = outline.chunk_by(|a, b| a.color == b.color).map(line).collect();
        Ok(SceneEntity { lines, ..self.entity("workspace".to_owned()) })
    }

    fn hand(&self, index: usize, grasp: &Proposal, depth: f64) -> SceneEntity {
        let note = |key: &str, value: String| KeyValuePair { key: key.into(), value };
        let color = quality_color(f64::from(grasp.quality));
        SceneEntity {
            metadata: vec![note("quality", grasp.quality.to_string()), note("width", grasp.width.to_string())],
            lines: vec![lines(&grasp.pose, THICKNESS, color, hand(grasp.width, depth))],
            ..self.entity(format!("grasp {index}"))
        }
    }
}

/// Lines between pairs of points, which are in the frame at `at`.
fn lines(
    at: &Isometry3<f64>,
    thickness: f64,
    color: [u8; 3],
    points: impl IntoIterator<Item = Point<f64>>,
) -> LinePrimitive {
    let [r, g, b] = color.map(|channel| f64::from(channel) / 255.0);
    LinePrimitive {
        r#type: line_primitive::Type::LineList.into(),
        pose: Some(pose(at)),
        thickness,
        points: points.into_iter().map(|p| Point3 { x: p.x, y: p.y, z: p.z }).collect(),
        color: Some(Color { r, g, b, a: 1.0 }),
        ..LinePrimitive::default()
    }
}

/// The lines of a hand as points.
fn dots(grasp: &Proposal, depth: f64) -> impl Iterator<Item = (Point<f64>, [u8; 3])> {
    let (pose, color) = (grasp.pose, quality_color(f64::from(grasp.quality)));
    let along =
        |[from, to]: [Point<f64>; 2]| (0..=DOTS).map(move |dot| from + (to - from) * f64::from(dot) / f64::from(DOTS));
    let lines: Vec<[Point<f64>; 2]> = hand(grasp.width, depth).as_chunks().0.to_vec();
    lines.into_iter().flat_map(along).map(move |dot| (pose * dot, color))
}

fn pose(pose: &Isometry3<f64>) -> Pose {
    let ([x, y, z], [qx, qy, qz, qw]) = (pose.translation.vector.into(), pose.rotation.coords.into());
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
