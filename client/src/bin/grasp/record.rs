//! A recording that Foxglove opens (MCAP, JSON messages of Foxglove's own schemas), and Rerun, too.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use grasp::{FINGER_DEPTH, SurfacePoint};
use grasp_client::{Detection, Proposal};
use grasp_picture::quality_color;
use mcap::Writer;
use mcap::records::MessageHeader;
use nalgebra::Point3;
use serde_json::{Value, json};

/// Writes what was seen and the grasps in it, in the frame of the grasps.
pub(crate) fn write(path: &Path, surface: &[SurfacePoint], detection: &Detection) -> anyhow::Result<()> {
    let file = File::create(path).with_context(|| path.display().to_string())?;
    let mut writer = Writer::new(BufWriter::new(file))?;
    let now = detection.stamp.unwrap_or_else(SystemTime::now).duration_since(UNIX_EPOCH).unwrap_or_default();
    let log_time = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX);
    let frame = if detection.frame_id.is_empty() { "task" } else { &detection.frame_id };
    let timestamp = json!({ "sec": now.as_secs(), "nsec": now.subsec_nanos() });
    let messages = [
        ("/surface", "foxglove.PointCloud", cloud_schema(), cloud(surface, frame, &timestamp)),
        ("/grasps", "foxglove.SceneUpdate", scene_schema(), scene(&detection.grasps, frame, &timestamp)),
    ];
    for (topic, name, schema, message) in messages {
        let schema = writer.add_schema(name, "jsonschema", schema.to_string().as_bytes())?;
        let channel_id = writer.add_channel(schema, topic, "json", &BTreeMap::new())?;
        let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, message.to_string().as_bytes())?;
    }
    writer.finish()?;
    Ok(())
}

fn cloud(surface: &[SurfacePoint], frame: &str, timestamp: &Value) -> Value {
    let data: Vec<u8> = surface
        .iter()
        .flat_map(|point| <[f64; 3]>::from(point.position.coords))
        .flat_map(|coordinate| (coordinate as f32).to_le_bytes())
        .collect();
    // 7 is FLOAT32.
    let field = |(index, name): (u32, &str)| json!({ "name": name, "offset": 4 * index, "type": 7 });
    json!({
        "timestamp": timestamp,
        "frame_id": frame,
        "pose": { "position": { "x": 0, "y": 0, "z": 0 }, "orientation": { "x": 0, "y": 0, "z": 0, "w": 1 } },
        "point_stride": 12,
        "fields": (0..).zip(["x", "y", "z"]).map(field).collect::<Vec<_>>(),
        "data": STANDARD.encode(data),
    })
}

fn scene(grasps: &[Proposal], frame: &str, timestamp: &Value) -> Value {
    let entity = |(index, grasp): (usize, &Proposal)| {
        let ([x, y, z], [qx, qy, qz, qw]) =
            (grasp.pose.translation.vector.into(), <[f64; 4]>::from(grasp.pose.rotation.coords));
        let [red, green, blue] = quality_color(f64::from(grasp.quality)).map(|channel| f64::from(channel) / 255.0);
        json!({
            "timestamp": timestamp,
            "frame_id": frame,
            "id": format!("grasp {index}"),
            "lifetime": { "sec": 0, "nsec": 0 },
            "frame_locked": false,
            "metadata": [
                { "key": "quality", "value": grasp.quality.to_string() },
                { "key": "width", "value": grasp.width.to_string() },
            ],
            "arrows": [], "cubes": [], "spheres": [], "cylinders": [], "triangles": [], "texts": [], "models": [],
            "lines": [{
                // 2 is a list of segments.
                "type": 2,
                "pose": { "position": { "x": x, "y": y, "z": z }, "orientation": { "x": qx, "y": qy, "z": qz, "w": qw } },
                "thickness": 0.003,
                "scale_invariant": false,
                "points": hand(grasp.width).map(|Point3 { coords, .. }| json!({ "x": coords.x, "y": coords.y, "z": coords.z })),
                "color": { "r": red, "g": green, "b": blue, "a": 1 },
                "colors": [],
                "indices": [],
            }],
        })
    };
    json!({ "deletions": [], "entities": grasps.iter().enumerate().map(entity).collect::<Vec<_>>() })
}

/// Two fingers, the bar between them, and the wrist: pairs of points of the grasp frame.
fn hand(width: f64) -> [Point3<f64>; 8] {
    let (y, tip) = (width / 2.0, FINGER_DEPTH);
    [[-y, 0.0, -y, tip], [y, 0.0, y, tip], [-y, 0.0, y, 0.0], [0.0, 0.0, 0.0, -0.04]]
        .map(|[y, z, to_y, to_z]| [Point3::new(0.0, y, z), Point3::new(0.0, to_y, to_z)])
        .as_flattened()
        .try_into()
        .unwrap_or([Point3::origin(); 8])
}

fn number() -> Value {
    json!({ "type": "number" })
}

fn object(properties: &[(&str, Value)]) -> Value {
    let properties: serde_json::Map<_, _> =
        properties.iter().map(|(name, schema)| ((*name).to_owned(), schema.clone())).collect();
    json!({ "type": "object", "properties": properties })
}

fn list(items: &Value) -> Value {
    json!({ "type": "array", "items": items })
}

fn time() -> Value {
    object(&[("sec", json!({ "type": "integer" })), ("nsec", json!({ "type": "integer" }))])
}

fn vector() -> Value {
    object(&[("x", number()), ("y", number()), ("z", number())])
}

fn pose() -> Value {
    let orientation = object(&[("x", number()), ("y", number()), ("z", number()), ("w", number())]);
    object(&[("position", vector()), ("orientation", orientation)])
}

fn text() -> Value {
    json!({ "type": "string" })
}

/// What of Foxglove's schema the messages use.
fn cloud_schema() -> Value {
    let field = object(&[("name", text()), ("offset", number()), ("type", number())]);
    object(&[
        ("timestamp", time()),
        ("frame_id", text()),
        ("pose", pose()),
        ("point_stride", number()),
        ("fields", list(&field)),
        ("data", json!({ "type": "string", "contentEncoding": "base64" })),
    ])
}

/// The same.
fn scene_schema() -> Value {
    let color = object(&[("r", number()), ("g", number()), ("b", number()), ("a", number())]);
    let line = object(&[
        ("type", number()),
        ("pose", pose()),
        ("thickness", number()),
        ("scale_invariant", json!({ "type": "boolean" })),
        ("points", list(&vector())),
        ("color", color.clone()),
        ("colors", list(&color)),
        ("indices", list(&number())),
    ]);
    let none = || list(&json!({ "type": "object" }));
    let entity = object(&[
        ("timestamp", time()),
        ("frame_id", text()),
        ("id", text()),
        ("lifetime", time()),
        ("frame_locked", json!({ "type": "boolean" })),
        ("metadata", list(&object(&[("key", text()), ("value", text())]))),
        ("arrows", none()),
        ("cubes", none()),
        ("spheres", none()),
        ("cylinders", none()),
        ("lines", list(&line)),
        ("triangles", none()),
        ("texts", none()),
        ("models", none()),
    ]);
    object(&[("deletions", none()), ("entities", list(&entity))])
}
