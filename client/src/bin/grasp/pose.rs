//! Poses and intrinsic matrices, of .npy and JSON files.

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
        ref poses => bail!("{}: holds {} poses, one is needed", path.display(), poses.len()),
    }
}

/// The poses of so many images or point clouds.
pub(crate) fn each(path: &Path, count: usize, things: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
    let poses = in_file(path, poses)?;
    ensure!(poses.len() == count, "{}: holds {} poses for {count} {things}", path.display(), poses.len());
    Ok(poses)
}

/// The nine numbers of an intrinsic matrix, row by row.
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

/// Every number in it, in their order.
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
    numbers.try_into().ok().with_context(|| format!("holds {count} numbers, nine are needed, row by row"))
}

/// One or more poses.
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
        bail!("a pose needs `position` with three numbers and `orientation` with four: x, y, z, w")
    };
    let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6);
    let rotation = rotation.context("an orientation is a quaternion of unit length")?;
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

fn matrices(numbers: &[f64]) -> anyhow::Result<Vec<Isometry3<f64>>> {
    ensure!(
        !numbers.is_empty() && numbers.len().is_multiple_of(16),
        "holds {} numbers, 4×4 for each pose are needed",
        numbers.len()
    );
    let pose = |numbers: &[f64]| {
        let matrix = Matrix4::from_row_slice(numbers);
        let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let orthonormal = (rotation * rotation.transpose() - Matrix3::identity()).norm() < 1e-3;
        ensure!(
            orthonormal && rotation.determinant() > 0.0 && numbers[12..] == [0.0, 0.0, 0.0, 1.0],
            "a matrix is no pose: its upper left must be a rotation, its last row 0 0 0 1"
        );
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Ok(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
    };
    numbers.chunks(16).map(pose).collect()
}
