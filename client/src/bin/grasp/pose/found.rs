//! Finds the poses in a document.

use anyhow::{Context, anyhow, bail, ensure};
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion};
use serde_json::Value;

use crate::document::{keys, listed, number, numbers, plain};
use crate::notes::note;

/// Largest deviation of a rotation from an orthonormal matrix, and of the norm of a quaternion from 1, that is
/// corrected: room for numbers with few decimals.
const CORRECTED: f64 = 1e-2;

/// Deviations that are not reported.
const EXACT: f64 = 1e-3;

/// Names of an orientation. `grasp detect --json` writes `orientation_xyzw`.
const ORIENTATIONS: [&str; 7] = ["orientation", "orientationxyzw", "rotation", "quaternion", "rot", "r", "q"];

/// The poses of a document: of a list of objects, of an object or of bare numbers.
pub(super) fn all(value: &Value) -> anyhow::Result<Vec<Isometry3<f64>>> {
    match value {
        Value::Array(values) if !values.is_empty() && values.iter().all(Value::is_object) => {
            values.iter().map(pose).collect()
        }
        Value::Object(_) => of_object(value),
        value => of_rows(value).unwrap_or_else(|| {
            bail!("no pose: each is a 4×4 or 3×4 matrix, or a row x, y, z, qx, qy, qz, qw; got {}", shown(value))
        }),
    }
}

fn shown(value: &Value) -> String {
    value.to_string().chars().take(80).collect()
}

/// The pose of an object with a single one.
pub(super) fn pose(value: &Value) -> anyhow::Result<Isometry3<f64>> {
    match of_object(value)?[..] {
        [pose] => Ok(pose),
        ref poses => bail!("{} poses in one object, exactly one is needed", poses.len()),
    }
}

/// The poses under one key: position and orientation under the names of this program, of ROS or of easy_handeye, or
/// matrices, in the object or in others in it. Poses under several keys are refused: one may be the inverse of another.
fn of_object(value: &Value) -> anyhow::Result<Vec<Isometry3<f64>>> {
    let mut found = Vec::new();
    find(value, "", &mut found)?;
    let Some((_, poses)) = found.first() else {
        if let Some(key) = short_orientation(value) {
            bail!("`{key}` has three numbers, must have the four of a quaternion x, y, z, w, or the nine of a matrix");
        }
        bail!(
            "a pose must have `position` (x, y, z) and `orientation` (quaternion x, y, z, w, or a 3×3 matrix), or be a \
             4×4 matrix{}",
            keys(value)
        )
    };
    if found.iter().any(|(_, other)| other != poses) {
        let names = listed(found.iter().map(|(name, _)| name.as_str()));
        bail!("several poses in the file: {names}; give a file with one of them");
    }
    Ok(poses.clone())
}

fn find(value: &Value, path: &str, found: &mut Vec<(String, Vec<Isometry3<f64>>)>) -> anyhow::Result<()> {
    if let Some(pose) = of_parts(value) {
        found.push((path.to_owned(), vec![pose?]));
        return Ok(());
    }
    let inner: Vec<(String, &Value)> = match value {
        Value::Object(map) => map
            .iter()
            .map(|(key, inner)| (if path.is_empty() { key.clone() } else { format!("{path}.{key}") }, inner))
            .collect(),
        Value::Array(values) => values.iter().enumerate().map(|(i, inner)| (format!("{path}[{i}]"), inner)).collect(),
        _ => return Ok(()),
    };
    for (path, inner) in inner {
        let matrix = inner.get("data").unwrap_or(inner);
        if may_be_pose(&plain(&path), matrix)
            && let Some(poses) = of_rows(matrix)
        {
            found.push((path.clone(), poses.with_context(|| format!("`{path}`"))?));
        } else {
            find(inner, &path, found)?;
        }
    }
    Ok(())
}

/// The key of an orientation with three numbers, such as angles, beside a position.
fn short_orientation(value: &Value) -> Option<&str> {
    let inner = match value {
        Value::Object(map) => {
            let has_position = map.keys().any(|key| ["position", "translation", "t"].contains(&&*plain(key)));
            let is_short = |(key, value): &(&String, &Value)| {
                ORIENTATIONS.contains(&&*plain(key)) && numbers(value).is_some_and(|numbers| numbers.len() == 3)
            };
            if let Some((key, _)) = map.iter().find(is_short).filter(|_| has_position) {
                return Some(key);
            }
            map.values().collect::<Vec<_>>()
        }
        Value::Array(values) => values.iter().collect(),
        _ => return None,
    };
    inner.into_iter().find_map(short_orientation)
}

/// Whether numbers beside others are those of a pose: a matrix with its last row, or a name that says so.
fn may_be_pose(name: &str, value: &Value) -> bool {
    let numbers = numbers(value).unwrap_or_default();
    let of_unit = |last: [f64; 4]| last.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(a, b)| (a - b).abs() < 1e-6);
    match shape(value)[..] {
        [.., 4, 4] | [.., 16] => {
            numbers.chunks(16).any(|m| of_unit([m[12], m[13], m[14], m[15]]) || of_unit([m[3], m[7], m[11], m[15]]))
        }
        [.., 3, 4] => !["p", "projectionmatrix"].contains(&name),
        _ => ["pose", "transform", "tf"].iter().any(|part| name.contains(part)),
    }
}

/// The pose of an object with a position and an orientation.
fn of_parts(value: &Value) -> Option<anyhow::Result<Isometry3<f64>>> {
    let map = value.as_object()?;
    let get = |value: &Value, name: &str| {
        value.as_object()?.iter().find(|(key, _)| plain(key) == name).and_then(|(_, v)| number(v))
    };
    let direct = |value: &Value, names: &[&str]| names.iter().map(|name| get(value, name)).collect::<Option<Vec<_>>>();
    // Numbers, or an object with these keys.
    let part = |names: &[&str], keys: &[&[&str]]| {
        let (key, value) = names.iter().find_map(|name| map.iter().find(|(key, _)| plain(key) == *name))?;
        let numbers = keys.iter().find_map(|keys| direct(value, keys)).or_else(|| numbers(value))?;
        Some((key.as_str(), numbers))
    };
    const QUATERNIONS: [&[&str]; 2] = [&["x", "y", "z", "w"], &["qx", "qy", "qz", "qw"]];
    let position = part(&["position", "translation", "trans", "t"], &[&["x", "y", "z"]]).map(|(_, numbers)| numbers);
    let position = position.or_else(|| direct(value, &["x", "y", "z"]))?;
    let (key, turn) = part(&ORIENTATIONS, &QUATERNIONS).or_else(|| Some(("qw", direct(value, QUATERNIONS[1])?)))?;
    let &[x, y, z] = &position[..] else { return None };
    let at = Translation3::new(x, y, z);
    let rotation = match turn[..] {
        [qx, qy, qz, qw] => unit(Quaternion::new(qw, qx, qy, qz)).map_err(|reason| anyhow!("`{key}`: {reason}")),
        [..] if turn.len() == 9 => {
            rotation(Matrix3::from_row_slice(&turn)).map_err(|reason| reason.context(format!("`{key}`")))
        }
        _ => return None,
    };
    Some(rotation.and_then(|rotation| finite(Isometry3::from_parts(at, rotation))))
}

/// The poses of 4×4 and 3×4 matrices, and of rows x, y, z, qx, qy, qz, qw, which may follow a time stamp (TUM). None if
/// the numbers are something else.
fn of_rows(value: &Value) -> Option<anyhow::Result<Vec<Isometry3<f64>>>> {
    let found = numbers(value)?;
    let shape = shape(value);
    let with_last = |rows: &[f64]| [rows, &[0.0, 0.0, 0.0, 1.0]].concat();
    let of_row = |row: &[f64]| {
        let &[x, y, z, qx, qy, qz, qw] = row else { bail!("{} numbers", row.len()) };
        let rotation = unit(Quaternion::new(qw, qx, qy, qz)).map_err(|reason| anyhow!(reason))?;
        finite(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
    };
    match shape[..] {
        [.., 4, 4] | [.., 16] | [_, 4] | [_] if !found.is_empty() && found.len().is_multiple_of(16) => {
            Some(found.chunks(16).map(of_matrix).collect())
        }
        [.., 3, 4] | [.., 12] => Some(found.chunks(12).map(|rows| of_matrix(&with_last(rows))).collect()),
        [.., 7] => Some(found.chunks(7).map(of_row).collect()),
        [.., 8] => Some(found.chunks(8).map(|row| of_row(&row[1..])).collect()),
        _ => None,
    }
}

/// The lengths of nested arrays.
fn shape(value: &Value) -> Vec<usize> {
    match value {
        Value::Array(values) => {
            let inner = values.first().map(shape).unwrap_or_default();
            [vec![values.len()], inner].concat()
        }
        _ => Vec::new(),
    }
}

/// The pose of a 4×4 matrix, row by row.
pub(super) fn of_matrix(numbers: &[f64]) -> anyhow::Result<Isometry3<f64>> {
    let matrix = Matrix4::from_row_slice(numbers);
    let last = matrix.row(3) - Matrix4::<f64>::identity().row(3);
    ensure!(
        last.norm() < 1e-6,
        "invalid pose matrix: the last row must be 0 0 0 1{}; got {:?}",
        if matrix.transpose().row(3) == Matrix4::<f64>::identity().row(3) {
            ", send the matrix row by row"
        } else {
            ""
        },
        numbers.chunks(4).collect::<Vec<_>>()
    );
    let rotation = rotation(matrix.fixed_view::<3, 3>(0, 0).into())?;
    finite(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
}

fn rotation(rotation: Matrix3<f64>) -> anyhow::Result<UnitQuaternion<f64>> {
    let deviation = (rotation * rotation.transpose() - Matrix3::identity()).norm();
    ensure!(
        deviation < CORRECTED && rotation.determinant() > 0.0,
        "invalid pose matrix: the upper left 3×3 block must be a rotation (R·Rᵀ deviates from the identity by \
         {deviation:.3}, at most {CORRECTED} is corrected{}); got {:?}",
        if rotation.determinant() < 0.0 { ", its determinant is negative: it mirrors" } else { "" },
        rotation.row_iter().map(|row| row.iter().copied().collect::<Vec<_>>()).collect::<Vec<_>>()
    );
    corrected(deviation);
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation)))
}

fn finite(pose: Isometry3<f64>) -> anyhow::Result<Isometry3<f64>> {
    let position = pose.translation.vector;
    ensure!(position.iter().all(|c| c.is_finite()), "the position is {:?}, must be finite", position.as_slice());
    Ok(pose)
}

/// The rotation of a quaternion.
pub(super) fn unit(quaternion: Quaternion<f64>) -> Result<UnitQuaternion<f64>, String> {
    let norm = quaternion.norm();
    let deviation = (norm - 1.0).abs();
    if deviation.is_nan() || deviation > CORRECTED {
        return Err(format!("the norm of the quaternion is {norm}; it must be 1 ± {CORRECTED}"));
    }
    corrected(deviation);
    Ok(UnitQuaternion::new_normalize(quaternion))
}

fn corrected(deviation: f64) {
    if deviation > EXACT {
        note(format_args!("the rotation of a pose has few decimals; it was orthonormalised ({deviation:.4} off)"));
    }
}
