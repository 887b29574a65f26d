//! Poses and intrinsic matrices from .npy and JSON files.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion};
use serde_json::Value;

use crate::files::{self, has_extension, in_file};

/// The only pose of a file.
pub(crate) fn one(path: &Path) -> anyhow::Result<Isometry3<f64>> {
    match in_file(path, poses)?[..] {
        [pose] => Ok(pose),
        ref poses => bail!("{}: {} poses in the file, exactly one is needed", path.display(), poses.len()),
    }
}

/// One pose for each of `count` inputs; `inputs` names them in the error.
pub(crate) fn each(path: &Path, count: usize, inputs: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
    let poses = in_file(path, poses)?;
    ensure!(
        poses.len() == count,
        "{}: {} poses in the file for {count} {inputs}; give one pose for each",
        path.display(),
        poses.len()
    );
    Ok(poses)
}

/// The nine numbers of an intrinsic matrix in row-major order.
pub(crate) fn intrinsics(path: &Path) -> anyhow::Result<[f64; 9]> {
    in_file(path, matrix_k)
}

/// The numbers of a .npy file.
fn numbers(path: &Path) -> anyhow::Result<Vec<f64>> {
    files::floats(files::array(path, "")?)
}

fn json(path: &Path) -> anyhow::Result<Value> {
    Ok(serde_json::from_reader(BufReader::new(File::open(path)?))?)
}

/// All numbers of nested arrays, in order.
fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Number(number) => number.as_f64().into_iter().collect(),
        Value::Array(values) => values.iter().flat_map(flat).collect(),
        _ => Vec::new(),
    }
}

fn matrix_k(path: &Path) -> anyhow::Result<[f64; 9]> {
    let numbers = if has_extension(path, "npy") {
        numbers(path)?
    } else {
        let value = json(path)?;
        let k = ["k", "K"].iter().find_map(|key| value.get(key)).unwrap_or(&value);
        flat(k)
    };
    let count = numbers.len();
    numbers
        .try_into()
        .ok()
        .with_context(|| format!("{count} numbers in the file; an intrinsic matrix has nine, in row-major order"))
}

fn poses(path: &Path) -> anyhow::Result<Vec<Isometry3<f64>>> {
    if has_extension(path, "npy") {
        return matrices(&numbers(path)?);
    }
    match json(path)? {
        value @ Value::Object(_) => Ok(vec![named(&value)?]),
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(named).collect(),
        value => matrices(&flat(&value)),
    }
}

fn named(value: &Value) -> anyhow::Result<Isometry3<f64>> {
    let part = |key: &str| value.get(key).map(flat).unwrap_or_default();
    let (position, orientation) = (part("position"), part("orientation"));
    let (&[x, y, z], &[qx, qy, qz, qw]) = (&position[..], &orientation[..]) else {
        bail!("a pose must have `position` (x, y, z) and `orientation` (quaternion x, y, z, w)")
    };
    let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6);
    let rotation = rotation.context("the norm of `orientation` is 0; it must be a unit quaternion")?;
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

fn matrices(numbers: &[f64]) -> anyhow::Result<Vec<Isometry3<f64>>> {
    ensure!(
        !numbers.is_empty() && numbers.len().is_multiple_of(16),
        "{} numbers in the file; each pose is a 4×4 matrix",
        numbers.len()
    );
    let pose = |numbers: &[f64]| {
        let matrix = Matrix4::from_row_slice(numbers);
        let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let orthonormal = (rotation * rotation.transpose() - Matrix3::identity()).norm() < 1e-3;
        ensure!(
            orthonormal && rotation.determinant() > 0.0 && numbers[12..] == [0.0, 0.0, 0.0, 1.0],
            "invalid pose matrix: the upper left 3×3 block must be a rotation, the last row 0 0 0 1"
        );
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Ok(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
    };
    numbers.chunks(16).map(pose).collect()
}
