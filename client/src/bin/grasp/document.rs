//! Documents of numbers: JSON, YAML, YAML of OpenCV, the text of `numpy.savetxt`, and the arrays of .npy and .npz files.

use std::fs;
use std::path::Path;

use anyhow::{Context, bail};
use serde_json::{Map, Value};

use crate::files::{self, Purpose, Values};

/// Reads a document. The arrays of a .npz file are an object with their names.
pub(crate) fn document(path: &Path, purpose: Purpose) -> anyhow::Result<Value> {
    if let Some(arrays) = files::arrays(path, purpose)? {
        let nested = |(name, array): (String, files::Array)| {
            let shape: Vec<usize> = array.shape().iter().map(|&edge| edge as usize).collect();
            Ok((name, nested(&leaves(array)?, &shape)))
        };
        let arrays = arrays.into_iter().map(nested).collect::<anyhow::Result<Map<_, _>>>()?;
        let is_single = arrays.len() == 1 && arrays.contains_key("");
        return Ok(if is_single { arrays.into_values().next().unwrap_or_default() } else { Value::Object(arrays) });
    }
    let bytes = fs::read(path)?;
    parse(std::str::from_utf8(&bytes).ok().context("neither text (UTF-8) nor a .npy or .npz file")?)
}

/// The values of an array as JSON: numbers, texts, or texts of numbers that are not finite, which JSON has not.
fn leaves(array: files::Array) -> anyhow::Result<Vec<Value>> {
    if files::is_text(&array) {
        return Ok(array.into_vec::<String>()?.into_iter().map(Value::from).collect());
    }
    Ok(match files::numbers(array, "numbers")? {
        Values::Integers(numbers) => numbers.into_iter().map(Value::from).collect(),
        Values::Floats(numbers) => numbers.into_iter().map(float).collect(),
    })
}

fn float(number: f64) -> Value {
    if number.is_finite() { Value::from(number) } else { Value::from(number.to_string()) }
}

/// Arrays in arrays of this shape, from their numbers in row-major order.
fn nested(numbers: &[Value], shape: &[usize]) -> Value {
    match shape {
        [] => numbers.first().cloned().unwrap_or_default(),
        [_] => numbers.to_vec().into(),
        [edge, inner @ ..] => {
            let size = (numbers.len() / (*edge).max(1)).max(1);
            numbers.chunks(size).map(|part| nested(part, inner)).collect()
        }
    }
}

/// Parses a document. Of several YAML documents, as `rostopic echo` prints them, it parses the first.
pub(crate) fn parse(text: &str) -> anyhow::Result<Value> {
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if text.is_empty() {
        bail!("the file is empty");
    }
    if let Some(rows) = rows(text) {
        return Ok(rows);
    }
    // OpenCV writes a directive without the space that YAML demands, and a tag that says nothing about the content.
    let text = if text.starts_with("%YAML:") { text.split_once('\n').map_or("", |(_, rest)| rest) } else { text };
    let text = text.replace("!!opencv-matrix", "");
    let first = text.trim_start().trim_start_matches("---").split("\n---").next().unwrap_or_default();
    // YAML includes JSON.
    serde_saphyr::from_str(first).map_err(|error| {
        if error.to_string().contains("non-finite") {
            return anyhow::anyhow!("a number is nan or infinite; all must be finite, as those of a calibrated camera");
        }
        anyhow::Error::from(error).context("neither JSON nor YAML, nor rows of numbers")
    })
}

/// Rows of numbers, separated by spaces, commas or semicolons; lines with # are comments.
fn rows(text: &str) -> Option<Value> {
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or_default().trim());
    let row = |line: &str| {
        // Without an empty cell the others would move.
        let has_gap = cells(line.trim_end_matches([',', ';', ' '])).contains(&"");
        words(line).map(|word| Some(float(word.parse().ok()?))).collect::<Option<Value>>().filter(|_| !has_gap)
    };
    let rows: Vec<Value> = lines.filter(|line| !line.is_empty()).map(row).collect::<Option<_>>()?;
    (!rows.is_empty()).then(|| Value::from(rows))
}

fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split([' ', '\t', ',', ';']).filter(|word| !word.is_empty())
}

/// The cells of a row: between semicolons or commas, where a cell may be empty, or else between spaces.
pub(crate) fn cells(line: &str) -> Vec<&str> {
    match [';', ','].into_iter().find(|&separator| line.contains(separator)) {
        Some(separator) => line.split(separator).map(str::trim).collect(),
        None => line.split_whitespace().collect(),
    }
}

/// All numbers of nested arrays, in order. Texts of numbers are numbers, and OpenCV and ROS put matrices into `data`.
/// None if anything else is among them.
pub(crate) fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Number(number) => Some(vec![number.as_f64()?]),
        Value::String(text) => Some(vec![text.trim().parse().ok()?]),
        Value::Array(values) => Some(values.iter().map(numbers).collect::<Option<Vec<_>>>()?.concat()),
        Value::Object(map) => numbers(map.get("data")?),
        _ => None,
    }
}

/// A number, also as text or in arrays of one.
pub(crate) fn number(value: &Value) -> Option<f64> {
    match numbers(value)?[..] {
        [number] => Some(number),
        _ => None,
    }
}

/// A key as it is compared: its last part without case and separators, so that `image_Width` is `imagewidth`.
pub(crate) fn plain(key: &str) -> String {
    let last = key.rsplit('.').next().unwrap_or_default();
    last.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// The keys of a document, for errors.
pub(crate) fn keys(value: &Value) -> String {
    let Some(map) = value.as_object() else { return String::new() };
    if map.is_empty() {
        return ": the file has no keys".to_owned();
    }
    format!("; keys in the file: {}", listed(map.keys().map(String::as_str)))
}

/// The first names, and how many more there are.
pub(crate) fn listed<'a>(names: impl ExactSizeIterator<Item = &'a str>) -> String {
    const SHOWN: usize = 10;
    let more = names.len().saturating_sub(SHOWN);
    let shown = names.take(SHOWN).collect::<Vec<_>>().join(", ");
    if more > 0 { format!("{shown}, … {more} more") } else { shown }
}
