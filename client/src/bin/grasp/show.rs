use std::io::{self, Write};
use std::time::Duration;

use anyhow::Context;
use comfy_table::{Cell, CellAlignment, Table, presets};
use grasp_client::pb::geometry_warning;
use grasp_client::pb::score::Violation;
use grasp_client::{Detection, Dropped, FoundTable, GeometryWarning, Latency, Model, Report, Score, Scores};
use nalgebra::Isometry3;
use serde_json::{Value, json};
use tonic::Code;

use crate::numbers::rounded;

/// Prints a line. Returns false if stdout is a closed pipe, as after `| head`, which is not an error.
pub(crate) fn print(text: &str) -> anyhow::Result<bool> {
    match writeln!(io::stdout().lock(), "{text}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error).context("cannot print"),
    }
}

/// Rows of a table. More would push the first ones out of sight.
const ROWS: usize = 40;

pub(crate) fn detection(detection: &Detection) -> String {
    let mut text = String::new();
    if detection.grasps.is_empty() {
        text += "No grasps.\n";
    } else {
        let has_objects = detection.grasps.iter().any(|grasp| grasp.object.is_some());
        let columns = ["", "quality", "x m", "y m", "z m", "qx", "qy", "qz", "qw", "width m"];
        let columns = columns.into_iter().chain(has_objects.then_some("object"));
        let mut table = numbers(&columns.collect::<Vec<_>>());
        for (rank, grasp) in detection.grasps.iter().take(ROWS).enumerate() {
            let (position, rotation) = (grasp.pose.translation.vector, grasp.pose.rotation.coords);
            let pose = position.iter().chain(&rotation).map(|c| format!("{c:.4}"));
            let row = [(rank + 1).to_string(), format!("{:.3}", grasp.quality)].into_iter().chain(pose);
            let object = has_objects.then(|| grasp.object.map(|object| object.to_string()).unwrap_or_default());
            table.add_row(right(row.chain([format!("{:.4}", grasp.width)]).chain(object)));
        }
        text += &format!("{table}\n");
        if let Some(more @ 1..) = detection.grasps.len().checked_sub(ROWS) {
            text += &format!("… {more} more; --json prints all of them\n");
        }
    }
    if let Some(dropped) = &detection.dropped {
        let reasons = reasons(dropped).map(|(reason, voxels)| format!("{} {voxels}", reason.replace('_', " ")));
        text += &format!("dropped: {}\n", reasons.join(", "));
    }
    text += &found(detection.table.as_ref(), &detection.depth_factors);
    for warning in &detection.warnings {
        text += &format!("warning: {}\n", warning.message);
    }
    let stages = stages(&detection.latency).map(|(stage, seconds)| format!("{stage} {:.2}", seconds * 1e3));
    text += &format!("{} {}; in ms: {}", detection.model, detection.version, stages.join(", "));
    text
}

/// The lines about the table that was found and about the correction of the depths, if there are any.
fn found(table: Option<&FoundTable>, depth_factors: &[f64]) -> String {
    let mut text = String::new();
    if let Some(table) = table {
        text += &format!(
            "table: {:.3} m from the camera, {:.1}° from its optical axis, {:.0} % of the image, {}\n",
            table.distance,
            table.angle.to_degrees(),
            table.share * 100.0,
            match table.objects {
                1 => "1 object".to_owned(),
                objects => format!("{objects} objects"),
            }
        );
    }
    if !depth_factors.is_empty() {
        let factors = depth_factors.iter().map(|factor| format!("{factor:.4}"));
        text += &format!("depths multiplied by {}\n", factors.collect::<Vec<_>>().join(", "));
    }
    text
}

pub(crate) fn detection_json(detection: &Detection) -> String {
    let grasps = detection.grasps.iter().map(|grasp| {
        json!({
            "quality": exact(grasp.quality),
            "position": grasp.pose.translation.vector.map(rounded).as_slice(),
            "orientation_xyzw": grasp.pose.rotation.coords.map(rounded).as_slice(),
            "width": grasp.width,
            "pregrasp": pose(&grasp.pregrasp),
            "retreat": pose(&grasp.retreat),
            "collides": grasp.collides,
            "object": grasp.object,
            "open_width": grasp.open_width,
        })
    });
    let object =
        |pairs: &[(&str, Value)]| -> Value { pairs.iter().map(|(k, v)| ((*k).to_owned(), v.clone())).collect() };
    let value = json!({
        "request_id": detection.request_id,
        "frame_id": detection.frame_id,
        "model": detection.model,
        "version": detection.version,
        "grasps": grasps.collect::<Vec<_>>(),
        "table": detection.table.as_ref().map(table_json),
        "depth_factors": detection.depth_factors,
        "warnings": detection.warnings.iter().map(warning_json).collect::<Vec<_>>(),
        "latency_seconds": object(&stages(&detection.latency).map(|(stage, seconds)| (stage, json!(seconds)))),
        "dropped": detection.dropped.as_ref().map(|d| object(&reasons(d).map(|(reason, n)| (reason, json!(n))))),
    });
    format!("{value:#}")
}

pub(crate) fn scores(scores: &Scores) -> String {
    let mut table = numbers(&["", "quality", "open width m", "object", "violations"]);
    for (index, score) in scores.scores.iter().enumerate() {
        let open_width = score.open_width.map(|width| format!("{width:.4}")).unwrap_or_default();
        let object = score.object.map(|object| object.to_string()).unwrap_or_default();
        let quality = format!("{:.3}", score.quality);
        table.add_row(right([(index + 1).to_string(), quality, open_width, object, violations(score).join(", ")]));
    }
    let mut text = format!("{table}\n") + &found(scores.table.as_ref(), &scores.depth_factors);
    for warning in &scores.warnings {
        text += &format!("warning: {}\n", warning.message);
    }
    text + &format!("{} {}; {:.2} ms", scores.model, scores.version, scores.latency.total * 1e3)
}

pub(crate) fn scores_json(scores: &Scores) -> String {
    let score = |score: &Score| {
        json!({
            "quality": exact(score.quality),
            "violations": violations(score),
            "object": score.object,
            "open_width": score.open_width,
        })
    };
    let value = json!({
        "request_id": scores.request_id,
        "model": scores.model,
        "version": scores.version,
        "scores": scores.scores.iter().map(score).collect::<Vec<_>>(),
        "table": scores.table.as_ref().map(table_json),
        "depth_factors": scores.depth_factors,
        "warnings": scores.warnings.iter().map(warning_json).collect::<Vec<_>>(),
    });
    format!("{value:#}")
}

/// The shortest number that is read as the same `f32`: 0.95 instead of 0.949999988079071.
fn exact(number: f32) -> Value {
    number.to_string().parse::<f64>().map_or(Value::Null, Value::from)
}

/// The names of the violations of a score.
fn violations(score: &Score) -> Vec<String> {
    // A newer server may know more of them.
    let name = |&number: &i32| match Violation::try_from(number) {
        Ok(violation) => violation.as_str_name().trim_start_matches("VIOLATION_").to_lowercase(),
        Err(_) => number.to_string(),
    };
    score.violations.iter().map(name).collect()
}

fn table_json(table: &FoundTable) -> Value {
    let workspace = table.workspace.as_ref().and_then(|pose| grasp_proto::pose(pose, "table.workspace").ok());
    json!({
        "workspace": workspace.as_ref().map(pose),
        "distance": table.distance,
        "angle": table.angle,
        "share": table.share,
        "deviation": table.deviation,
        "tilt": table.tilt,
        "extent": table.extent.as_ref().map(|extent| [extent.x, extent.y]),
        "objects": table.objects,
    })
}

fn warning_json(warning: &GeometryWarning) -> Value {
    json!({
        "code": warning_code(warning),
        "message": warning.message,
        "figures": warning.figures,
        "view": warning.view,
    })
}

fn warning_code(warning: &GeometryWarning) -> String {
    match geometry_warning::Code::try_from(warning.code) {
        Ok(code) => code.as_str_name().trim_start_matches("CODE_").to_owned(),
        Err(_) => warning.code.to_string(),
    }
}

fn pose(pose: &Isometry3<f64>) -> Value {
    json!({
        "position": pose.translation.vector.map(rounded).as_slice(),
        "orientation_xyzw": pose.rotation.coords.map(rounded).as_slice(),
    })
}

const QUANTILES: [(&str, f64); 4] = [("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("max", 1.0)];

/// Name and sorted latencies of each outcome of the calls.
fn outcomes(report: &Report) -> impl Iterator<Item = (String, &Vec<Duration>)> {
    let refused = report.refused.iter().map(|(&code, times)| (format!("{:?}", Code::from_i32(code)), times));
    std::iter::once(("answered".to_owned(), &report.answered)).chain(refused)
}

pub(crate) fn report(report: &Report) -> String {
    let mut table = numbers(&["", "calls", "p50 ms", "p90 ms", "p99 ms", "max ms"]);
    for (outcome, times) in outcomes(report) {
        let quantiles =
            QUANTILES.map(|(_, share)| format!("{:.2}", Report::quantile(times, share).as_secs_f64() * 1e3));
        table.add_row(right([outcome, times.len().to_string()].into_iter().chain(quantiles)));
    }
    format!("{table}\n{:.1} answers/s over {:.1} s", report.throughput(), report.elapsed.as_secs_f64())
}

pub(crate) fn report_json(report: &Report) -> String {
    let outcomes = outcomes(report).map(|(outcome, times)| {
        let quantiles = QUANTILES
            .map(|(name, share)| (format!("{name}_seconds"), json!(Report::quantile(times, share).as_secs_f64())));
        let calls = [("calls".to_owned(), json!(times.len()))];
        (outcome, calls.into_iter().chain(quantiles).collect::<Value>())
    });
    let outcomes: Value = outcomes.collect();
    let value = json!({
        "elapsed_seconds": report.elapsed.as_secs_f64(),
        "answers_per_second": report.throughput(),
        "outcomes": outcomes,
    });
    format!("{value:#}")
}

pub(crate) fn models(models: &[Model]) -> String {
    let mut table = numbers(&[
        "model",
        "version",
        "resolution",
        "voxel m",
        "camera",
        "threshold",
        "provider",
        "precision",
        "sha256",
    ]);
    for model in models {
        let Model { name, version, resolution, voxel_size, threshold, sha256, provider, precision, .. } = model;
        let camera = model.camera_azimuth.map_or_else(|| "any".to_owned(), |azimuth| format!("{azimuth}°"));
        let sha256 = sha256.get(..12).unwrap_or(sha256).to_owned();
        let any = |number: String| if number == "0" { "any".to_owned() } else { number };
        let [resolution, voxel_size] = [resolution.to_string(), voxel_size.to_string()].map(any);
        let threshold = threshold.to_string();
        table.add_row(right([
            name.clone(),
            version.clone(),
            resolution,
            voxel_size,
            camera,
            threshold,
            provider.clone(),
            precision.clone(),
            sha256,
        ]));
    }
    table.to_string()
}

pub(crate) fn models_json(models: &[Model]) -> String {
    let models = models.iter().map(|model| {
        json!({
            "name": model.name,
            "version": model.version,
            "resolution": model.resolution,
            "voxel_size": model.voxel_size,
            "voxel_origin": model.voxel_origin,
            "camera_azimuth": model.camera_azimuth,
            "threshold": exact(model.threshold),
            "provider": model.provider,
            "precision": model.precision,
            "sha256": model.sha256,
            "provenance": model.provenance,
        })
    });
    format!("{:#}", Value::from_iter(models))
}

pub(crate) fn health(serving: bool) -> String {
    if serving { "serving" } else { "not serving: warming up, shutting down, or all sessions of a model hang or fail" }
        .to_owned()
}

pub(crate) fn health_json(serving: bool) -> String {
    format!("{:#}", json!({ "serving": serving }))
}

fn stages(latency: &Latency) -> [(&'static str, f64); 7] {
    [
        ("queue", latency.queue),
        ("preprocessing", latency.preprocessing),
        ("fusion", latency.fusion),
        ("inference", latency.inference),
        ("evaluation", latency.evaluation),
        ("postprocessing", latency.postprocessing),
        ("total", latency.total),
    ]
}

fn reasons(dropped: &Dropped) -> [(&'static str, u32); 10] {
    [
        ("below_threshold", dropped.below_threshold),
        ("mask", dropped.mask),
        ("width", dropped.width),
        ("region", dropped.region),
        ("approach", dropped.approach),
        ("height", dropped.height),
        ("object", dropped.object),
        ("collision", dropped.collision),
        ("suppressed", dropped.suppressed),
        ("over_limit", dropped.over_limit),
    ]
}

fn numbers(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_header(right(header));
    table
}

fn right<T: ToString>(cells: impl IntoIterator<Item = T>) -> Vec<Cell> {
    cells.into_iter().map(|cell| Cell::new(cell.to_string()).set_alignment(CellAlignment::Right)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_models_fits_a_terminal_and_shows_the_camera_azimuth() {
        let model = Model {
            name: "vgn-packed".to_owned(),
            version: "2.0.1".to_owned(),
            resolution: 40,
            voxel_size: 0.0075,
            threshold: 0.9,
            sha256: "0123456789abcdef".repeat(4),
            provider: "tensorrt".to_owned(),
            precision: "fp32".to_owned(),
            voxel_origin: "center".to_owned(),
            camera_azimuth: Some(-90.0),
            ..Model::default()
        };
        let list = [model.clone(), Model { camera_azimuth: None, ..model }];
        let table = models(&list);
        assert!(table.lines().all(|line| line.chars().count() <= 110), "{table}");
        assert!(table.contains("-90°") && table.contains("any"), "{table}");
        let json: Value = serde_json::from_str(&models_json(&list)).unwrap();
        assert_eq!(json[0]["camera_azimuth"], -90.0);
        assert_eq!((&json[1]["camera_azimuth"], &json[1]["voxel_origin"]), (&Value::Null, &json!("center")));
    }
}
