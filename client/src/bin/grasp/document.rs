//! Documents of numbers: JSON, YAML, YAML of OpenCV, and the text of `numpy.savetxt`.

use std::fs;
use std::path::Path;

use anyhow::Context;
use serde_json::Value;

/// Reads a document.
pub(crate) fn document(path: &Path) -> anyhow::Result<Value> {
    let bytes = fs::read(path)?;
    parse(std::str::from_utf8(&bytes).ok().context("neither text nor a .npy or .npz file")?)
}

/// Parses a document. Of several YAML documents, as `rostopic echo` prints them, it parses the first.
pub(crate) fn parse(text: &str) -> anyhow::Result<Value> {
    if let Some(rows) = rows(text) {
        return Ok(rows);
    }
    // OpenCV writes a directive without the space that YAML demands, and a tag that says nothing about the content.
    let text = text.trim_start();
    let text = if text.starts_with("%YAML:") { text.split_once('\n').map_or("", |(_, rest)| rest) } else { text };
    let text = text.replace("!!opencv-matrix", "");
    let first = text.trim_start().trim_start_matches("---").split("\n---").next().unwrap_or_default();
    // YAML includes JSON.
    serde_saphyr::from_str(first).context("neither JSON nor YAML, nor rows of numbers")
}

/// Rows of numbers, separated by spaces, commas or semicolons; lines with # are comments.
fn rows(text: &str) -> Option<Value> {
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or_default().trim());
    let row = |line: &str| {
        let words = line.split([' ', '\t', ',', ';']).filter(|word| !word.is_empty());
        words.map(|word| Some(Value::from(word.parse::<f64>().ok()?))).collect::<Option<Vec<_>>>().map(Value::from)
    };
    let rows: Vec<Value> = lines.filter(|line| !line.is_empty()).map(row).collect::<Option<_>>()?;
    (!rows.is_empty()).then(|| Value::from(rows))
}

/// All numbers of nested arrays, in order.
pub(crate) fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Number(number) => number.as_f64().into_iter().collect(),
        Value::Array(values) => values.iter().flat_map(flat).collect(),
        _ => Vec::new(),
    }
}
