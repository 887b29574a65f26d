//! Poses from files, and from numbers on the command line.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, anyhow, bail, ensure};
use grasp_client::Candidate;
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;

use crate::document::{document, flat};
use crate::files::{self, has_extension, in_file};
use crate::numbers::Numbers;

/// Largest deviation of the norm of a quaternion from 1, as in the server.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Poses as given on the command line: the numbers of one pose, or a file.
#[derive(Clone, Debug)]
pub(crate) enum Poses {
    Numbers(Isometry3<f64>),
    File(PathBuf),
}

impl FromStr for Poses {
    type Err = String;

    /// X,Y,Z or X,Y,Z,QX,QY,QZ,QW; anything else is a file.
    fn from_str(text: &str) -> Result<Self, String> {
        let pose = |position: [f64; 3], [x, y, z, w]: [f64; 4]| {
            let rotation = unit(Quaternion::new(w, x, y, z))?;
            Ok(Self::Numbers(Isometry3::from_parts(Translation3::from(Vector3::from(position)), rotation)))
        };
        if let Ok(Numbers(position)) = text.parse::<Numbers<3>>() {
            pose(position, [0.0, 0.0, 0.0, 1.0])
        } else if let Ok(Numbers([x, y, z, qx, qy, qz, qw])) = text.parse::<Numbers<7>>() {
            pose([x, y, z], [qx, qy, qz, qw])
        } else {
            Ok(Self::File(PathBuf::from(text)))
        }
    }
}

impl Poses {
    /// The file, if they are in one.
    pub fn file(&self) -> Option<&PathBuf> {
        match self {
            Self::Numbers(_) => None,
            Self::File(path) => Some(path),
        }
    }

    /// The only pose.
    pub fn one(&self) -> anyhow::Result<Isometry3<f64>> {
        match self {
            Self::Numbers(pose) => Ok(*pose),
            Self::File(path) => one(path),
        }
    }

    /// All poses as grasps, each with its `width` if the file has one. The file may be the output of
    /// `grasp detect --json`.
    pub fn candidates(&self) -> anyhow::Result<Vec<Candidate>> {
        match self {
            Self::Numbers(pose) => Ok(vec![Candidate::from(*pose)]),
            Self::File(path) => in_file(path, candidates),
        }
    }

    /// One pose for each of `count` inputs; `inputs` names them in the error.
    pub fn each(&self, count: usize, inputs: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
        match self {
            Self::Numbers(pose) if count == 1 => Ok(vec![*pose]),
            Self::Numbers(_) => bail!("the numbers of 1 pose for {count} {inputs}; give a file with one pose for each"),
            Self::File(path) => each(path, count, inputs),
        }
    }
}

/// The only pose of a file.
pub(crate) fn one(path: &Path) -> anyhow::Result<Isometry3<f64>> {
    match in_file(path, poses)?[..] {
        [pose] => Ok(pose),
        ref poses => bail!("{}: {} poses in the file, exactly one is needed", path.display(), poses.len()),
    }
}

/// One pose for each of `count` inputs; `inputs` names them in the error.
fn each(path: &Path, count: usize, inputs: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
    let poses = in_file(path, poses)?;
    ensure!(
        poses.len() == count,
        "{}: {} poses in the file for {count} {inputs}; give one pose for each",
        path.display(),
        poses.len()
    );
    Ok(poses)
}

/// The rotation of a quaternion, with the server's check of its norm.
fn unit(quaternion: Quaternion<f64>) -> Result<UnitQuaternion<f64>, String> {
    let norm = quaternion.norm();
    // Written so that NaN fails.
    if (norm - 1.0).abs() <= UNIT_TOLERANCE {
        Ok(UnitQuaternion::new_normalize(quaternion))
    } else {
        Err(format!("the norm of the quaternion is {norm}; it must be 1 ± {UNIT_TOLERANCE}"))
    }
}

fn is_array(path: &Path) -> bool {
    has_extension(path, "npy") || has_extension(path, "npz")
}

fn poses(path: &Path) -> anyhow::Result<Vec<Isometry3<f64>>> {
    if is_array(path) {
        return matrices(&files::floats(files::array(path, "pose")?)?);
    }
    match document(path)? {
        value @ Value::Object(_) => Ok(vec![pose(&value)?]),
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(pose).collect(),
        value => matrices(&flat(&value)),
    }
}

fn candidates(path: &Path) -> anyhow::Result<Vec<Candidate>> {
    if is_array(path) {
        return Ok(poses(path)?.into_iter().map(Candidate::from).collect());
    }
    let value = document(path)?;
    let candidate = |value: &Value| {
        let width = value.get("width").filter(|width| !width.is_null());
        let width = width.map(|width| width.as_f64().with_context(|| format!("`width` is {width}, must be a number")));
        Ok(Candidate { pose: pose(value)?, width: width.transpose()? })
    };
    match value.get("grasps").unwrap_or(&value) {
        value @ Value::Object(_) => Ok(vec![candidate(value)?]),
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(candidate).collect(),
        value => Ok(matrices(&flat(value))?.into_iter().map(Candidate::from).collect()),
    }
}

/// The pose of an object: position and orientation under the names of this program, of ROS or of easy_handeye, or a
/// named matrix, alone or in another object.
fn pose(value: &Value) -> anyhow::Result<Isometry3<f64>> {
    if let Some(found) = find(value) {
        return found;
    }
    let keys = value.as_object().map(|map| map.keys().cloned().collect::<Vec<_>>().join(", ")).unwrap_or_default();
    bail!(
        "a pose must have `position` (x, y, z) and `orientation` (quaternion x, y, z, w), or be a 4×4 matrix; keys in the \
         file: {keys}"
    )
}

fn find(value: &Value) -> Option<anyhow::Result<Isometry3<f64>>> {
    let map = value.as_object()?;
    // Arrays, or objects with these keys.
    let part = |names: &[&'static str], keys: &[&str]| {
        names.iter().find_map(|&name| {
            let value = map.get(name)?;
            let numbers = keys.iter().map(|key| value.get(*key)?.as_f64()).collect::<Option<_>>();
            Some((name, numbers.unwrap_or_else(|| flat(value))))
        })
    };
    let direct = |keys: &[&str]| keys.iter().map(|key| map.get(*key)?.as_f64()).collect::<Option<Vec<_>>>();
    let position = part(&["position", "translation"], &["x", "y", "z"]).map(|(_, position)| position);
    let position = position.or_else(|| direct(&["x", "y", "z"]));
    // `grasp detect --json` writes `orientation_xyzw`.
    let names = ["orientation", "orientation_xyzw", "rotation", "quaternion"];
    let orientation = part(&names, &["x", "y", "z", "w"]).or_else(|| Some(("qw", direct(&["qx", "qy", "qz", "qw"])?)));
    if let (Some(&[x, y, z]), Some((key, &[qx, qy, qz, qw]))) =
        (position.as_deref(), orientation.as_ref().map(|(key, numbers)| (key, &numbers[..])))
    {
        let rotation = unit(Quaternion::new(qw, qx, qy, qz)).map_err(|reason| anyhow!("`{key}`: {reason}"));
        return Some(rotation.map(|rotation| Isometry3::from_parts(Translation3::new(x, y, z), rotation)));
    }
    map.values().find_map(|inner| {
        let numbers = flat(inner.get("data").unwrap_or(inner));
        if numbers.len() == 16 {
            return Some(matrices(&numbers).map(|poses| poses[0]));
        }
        find(inner)
    })
}

/// Largest deviation of a rotation from an orthonormal matrix that is corrected: room for three decimals.
const CORRECTED: f64 = 1e-2;

fn matrices(numbers: &[f64]) -> anyhow::Result<Vec<Isometry3<f64>>> {
    ensure!(
        !numbers.is_empty() && numbers.len().is_multiple_of(16),
        "{} numbers in the file; each pose is a 4×4 matrix",
        numbers.len()
    );
    let pose = |numbers: &[f64]| {
        let matrix = Matrix4::from_row_slice(numbers);
        let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let deviation = (rotation * rotation.transpose() - Matrix3::identity()).norm();
        ensure!(
            deviation < CORRECTED && rotation.determinant() > 0.0 && numbers[12..] == [0.0, 0.0, 0.0, 1.0],
            "invalid pose matrix: the upper left 3×3 block must be a rotation (R·Rᵀ deviates from the identity by \
             {deviation:.3}, at most {CORRECTED} is corrected), the last row 0 0 0 1; got {:?}",
            numbers.chunks(4).collect::<Vec<_>>()
        );
        if deviation > 1e-3 {
            eprintln!("warning: the rotation of a pose has few decimals; it was orthonormalised ({deviation:.4} off)");
        }
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Ok(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
    };
    numbers.chunks(16).map(pose).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn poses_are_numbers_or_files() {
        let Ok(Poses::Numbers(pose)) = "-0.2,-0.28,-0.05".parse() else { panic!("three numbers are a position") };
        assert_eq!(pose, Isometry3::translation(-0.2, -0.28, -0.05));
        let Ok(Poses::Numbers(pose)) = "1,2,3, 0,0,1.0009,0".parse() else { panic!("seven numbers are a pose") };
        assert!((pose * Point3::new(1.0, 0.0, 0.0) - Point3::new(0.0, 2.0, 3.0)).norm() < 1e-12);
        let Ok(Poses::File(path)) = "corner.json".parse() else { panic!("other texts are files") };
        assert_eq!(path.to_str(), Some("corner.json"));
        let refused = |text: &str| text.parse::<Poses>().unwrap_err();
        assert!(refused("1,2,3,0,0,0,0").contains("the norm of the quaternion is 0"));
        assert!(refused("1,2,3,0,0,2,0").contains("the norm of the quaternion is 2; it must be 1 ± 0.001"));
        assert!(refused("1,2,3,0,0,nan,0").contains("NaN"));
        let error = Poses::Numbers(pose).each(2, "images").unwrap_err().to_string();
        assert!(error.contains("1 pose for 2 images"), "{error}");
    }

    #[test]
    fn poses_of_files_and_of_detect_are_read() {
        for key in ["orientation", "orientation_xyzw"] {
            let pose = super::pose(&serde_json::json!({ "position": [1, 2, 3], key: [0, 0, 1, 0] })).unwrap();
            assert!((pose * Point3::new(1.0, 0.0, 0.0) - Point3::new(0.0, 2.0, 3.0)).norm() < 1e-12, "{key}");
            let long = super::pose(&serde_json::json!({ "position": [1, 2, 3], key: [0, 0, 0, 2] }));
            let error = long.unwrap_err().to_string();
            assert!(error.starts_with(&format!("`{key}`: the norm of the quaternion is 2")), "{error}");
        }
        assert!(super::pose(&serde_json::json!({ "position": [1, 2, 3] })).is_err());
    }

    #[test]
    fn poses_of_other_tools_are_read() {
        let texts = [
            "position: [1.0, 2.0, 3.0]\norientation: [0.0, 0.0, 1.0, 0.0]\n",
            r#"{"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}}"#,
            // A TransformStamped and a PoseStamped of ROS, easy_handeye, OpenCV, a named matrix.
            "header:\n  frame_id: base\ntransform:\n  translation: {x: 1.0, y: 2.0, z: 3.0}\n  rotation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}\n",
            "header:\n  frame_id: base\npose:\n  position: {x: 1.0, y: 2.0, z: 3.0}\n  orientation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}\n",
            "parameters:\n  eye_on_hand: false\ntransformation: {qw: 0.0, qx: 0.0, qy: 0.0, qz: 1.0, x: 1.0, y: 2.0, z: 3.0}\n",
            "%YAML:1.0\n---\nState: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: [-1, 0, 0, 1, 0, -1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]\n",
            r#"{"T_base_camera": [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]}"#,
        ];
        for text in texts {
            let found = pose(&crate::document::parse(text).unwrap()).unwrap();
            assert!((found * Point3::new(1.0, 0.0, 0.0) - Point3::new(0.0, 2.0, 3.0)).norm() < 1e-12, "{text}");
        }
        let rows = crate::document::parse("-1.0 0 0 1\n0 -1 0 2\n0 0 1 3\n0 0 0 1\n").unwrap();
        assert!(matrices(&flat(&rows)).is_ok());
        let error = super::pose(&serde_json::json!({ "where": 1 })).unwrap_err().to_string();
        assert!(error.ends_with("keys in the file: where"), "{error}");
    }

    #[test]
    fn rotations_with_three_decimals_are_orthonormalised() {
        let rotation = UnitQuaternion::from_euler_angles(0.3, -0.7, 2.1);
        let mut numbers = vec![0.0_f64; 16];
        for (row, column) in (0..3).flat_map(|row| (0..3).map(move |column| (row, column))) {
            let exact: f64 = rotation.to_rotation_matrix()[(row, column)];
            numbers[4 * row + column] = (exact * 1000.0).round() / 1000.0;
        }
        numbers[15] = 1.0;
        assert!(matrices(&numbers).unwrap()[0].rotation.angle_to(&rotation) < 1e-3);
        numbers[0] += 0.05;
        let error = matrices(&numbers).unwrap_err().to_string();
        assert!(error.contains("deviates from the identity by"), "{error}");
    }

    #[test]
    fn grasps_have_a_width_if_the_file_has_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("grasps.json");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let found = Poses::File(path.clone()).candidates()?;
            anyhow::Ok(found.into_iter().map(|candidate| candidate.width).collect::<Vec<_>>())
        };
        let with = r#"{"position": [1, 2, 3], "orientation_xyzw": [0, 0, 0, 1], "width": 0.04}"#;
        let without = r#"{"position": [1, 2, 3], "orientation_xyzw": [0, 0, 0, 1], "width": null}"#;
        assert_eq!(read(with).unwrap(), [Some(0.04)]);
        assert_eq!(read(&format!("[{with}, {without}]")).unwrap(), [Some(0.04), None]);
        assert_eq!(
            read(&format!(r#"{{"model": "graspd", "grasps": [{without}, {with}]}}"#)).unwrap(),
            [None, Some(0.04)]
        );
        assert_eq!(read(r#"{"grasps": []}"#).unwrap(), []);
        assert_eq!(read("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]").unwrap(), [None]);
        let error = format!("{:#}", read(&with.replace("0.04", r#""wide""#)).unwrap_err());
        assert!(error.contains(r#"`width` is "wide""#), "{error}");
    }

    #[test]
    fn an_invalid_matrix_is_printed() {
        let mut numbers: Vec<f64> = Matrix4::identity().iter().copied().collect();
        assert!(matrices(&numbers).is_ok());
        numbers[5] = 2.0;
        let error = matrices(&numbers).unwrap_err().to_string();
        assert!(error.contains("[0.0, 2.0, 0.0, 0.0]"), "{error}");
    }
}
