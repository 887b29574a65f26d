//! Export of grasps as CSV, MoveIt and Isaac files.

use std::fmt::Write;

use grasp_client::{Detection, Proposal};
use nalgebra::Isometry3;
use serde_json::json;

use crate::numbers::rounded;

/// One row per grasp; metres, quaternions x y z w.
pub(crate) fn csv(detection: &Detection) -> String {
    let mut text =
        "quality,width,x,y,z,qx,qy,qz,qw,pregrasp_x,pregrasp_y,pregrasp_z,collides,retreat_x,retreat_y,retreat_z,object,\
         open_width\n"
            .to_owned();
    for Proposal { pose, width, quality, pregrasp, retreat, collides, object, open_width } in &detection.grasps {
        let ([x, y, z], [qx, qy, qz, qw]) = parts(pose);
        let ([px, py, pz], _) = parts(pregrasp);
        let ([rx, ry, rz], _) = parts(retreat);
        let collides = collides.map(|collides| collides.to_string()).unwrap_or_default();
        let object = object.map(|object| object.to_string()).unwrap_or_default();
        let open_width = open_width.map(|width| width.to_string()).unwrap_or_default();
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{quality},{width},{x},{y},{z},{qx},{qy},{qz},{qw},{px},{py},{pz},{collides},{rx},{ry},{rz},{object},\
             {open_width}"
        );
    }
    text
}

/// A list of `moveit_msgs/Grasp` without the gripper's joint postures, which depend on the robot's description.
pub(crate) fn moveit(detection: &Detection) -> String {
    let header = json!({ "frame_id": detection.frame_id });
    let motion = |from: &Isometry3<f64>, to: &Isometry3<f64>| {
        let displacement = to.translation.vector - from.translation.vector;
        let distance = displacement.norm();
        let [x, y, z] = if distance > 0.0 { (displacement / distance).into() } else { [0.0, 0.0, 1.0] };
        json!({
            "direction": { "header": header, "vector": { "x": x, "y": y, "z": z } },
            "desired_distance": distance,
            "min_distance": 0.5 * distance,
        })
    };
    let mut text = String::new();
    for (index, Proposal { pose, width, quality, pregrasp, retreat, .. }) in detection.grasps.iter().enumerate() {
        let ([x, y, z], [qx, qy, qz, qw]) = parts(pose);
        let pose_stamped = json!({
            "header": header,
            "pose": {
                "position": { "x": x, "y": y, "z": z },
                "orientation": { "x": qx, "y": qy, "z": qz, "w": qw },
            },
        });
        let _ = writeln!(text, "- id: grasp_{index}");
        // JSON is valid YAML.
        let _ = writeln!(text, "  grasp_pose: {pose_stamped}");
        let _ = writeln!(text, "  grasp_quality: {quality}");
        let _ = writeln!(text, "  pre_grasp_approach: {}", motion(pregrasp, pose));
        let _ = writeln!(text, "  post_grasp_retreat: {}", motion(pose, retreat));
        let _ = writeln!(text, "  max_contact_force: 0.0");
        let _ = writeln!(text, "  # opening between the fingers, m: {width}");
    }
    if text.is_empty() { "[]\n".to_owned() } else { text }
}

/// NVIDIA's `isaac_grasp` format, version 1.0. A gripper's state is the distance of each finger from the middle. The
/// pre-grasp state is an opening of `opening` metres.
pub(crate) fn isaac(detection: &Detection, opening: f64) -> String {
    let mut text = "format: isaac_grasp\nformat_version: \"1.0\"\n".to_owned();
    let frame = json!(detection.frame_id);
    let _ = writeln!(text, "object_frame_link: {frame}\ngripper_frame_link: \"\"\ngrasps:");
    if detection.grasps.is_empty() {
        text.truncate(text.len() - 1);
        text.push_str(" {}\n");
    }
    for (index, Proposal { pose, width, quality, .. }) in detection.grasps.iter().enumerate() {
        let ([x, y, z], [qx, qy, qz, qw]) = parts(pose);
        let _ = writeln!(text, "  grasp_{index}:");
        let _ = writeln!(text, "    confidence: {quality}");
        let _ = writeln!(text, "    position: [{x}, {y}, {z}]");
        let _ = writeln!(text, "    orientation: {{w: {qw}, xyz: [{qx}, {qy}, {qz}]}}");
        let _ = writeln!(text, "    cspace_position: {{finger: {}}}", width / 2.0);
        let _ = writeln!(text, "    pregrasp_cspace_position: {{finger: {}}}", opening / 2.0);
    }
    text
}

fn parts(pose: &Isometry3<f64>) -> ([f64; 3], [f64; 4]) {
    (pose.translation.vector.map(rounded).into(), pose.rotation.coords.map(rounded).into())
}
