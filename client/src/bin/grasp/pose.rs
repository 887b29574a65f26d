//! Poses and intrinsic matrices from .npy and JSON files.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, anyhow, bail, ensure};
use grasp_client::Candidate;
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;

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

    /// All poses as grasps, each with its `width` if the file has one. The file may be the output of `grasp detect --json`.
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

/// The nine numbers of an intrinsic matrix in row-major order: FX,FY,CX,CY, nine numbers, or a file.
pub(crate) fn intrinsics(text: &str) -> anyhow::Result<[f64; 9]> {
    if let Ok(Numbers([fx, fy, cx, cy])) = text.parse::<Numbers<4>>() {
        return Ok([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    }
    if let Ok(Numbers(k)) = text.parse::<Numbers<9>>() {
        return Ok(k);
    }
    in_file(Path::new(text), matrix_k)
}

/// The file of intrinsics, if they are in one.
pub(crate) fn intrinsics_file(text: &str) -> Option<PathBuf> {
    let is_numbers = text.split(',').all(|number| number.trim().parse::<f64>().is_ok());
    (!is_numbers).then(|| PathBuf::from(text))
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
    let numbers =
        if has_extension(path, "npy") { numbers(path)? } else { intrinsic_numbers(&std::fs::read_to_string(path)?)? };
    let count = numbers.len();
    numbers
        .try_into()
        .ok()
        .with_context(|| format!("{count} numbers in the file; an intrinsic matrix has nine, in row-major order"))
}

/// The numbers of an intrinsic matrix in JSON or YAML, in row-major order.
fn intrinsic_numbers(text: &str) -> anyhow::Result<Vec<f64>> {
    // YAML includes JSON. `rostopic echo` separates messages by `---`.
    let first = text.trim_start_matches("---").split("\n---").next().unwrap_or_default();
    let value: Value = serde_saphyr::from_str(first).context("neither JSON nor YAML")?;
    // ROS's CameraInfo and calibration file, librealsense and Open3D.
    let of_ros = value.get("camera_matrix").and_then(|matrix| matrix.get("data"));
    if let Some(k) = ["k", "K"].iter().find_map(|key| value.get(key)).or(of_ros) {
        return Ok(flat(k));
    }
    if let Some(columns) = value.get("intrinsic").unwrap_or(&value).get("intrinsic_matrix") {
        // Column by column.
        let numbers = flat(columns);
        ensure!(
            numbers.len() == 9,
            "{} numbers in `intrinsic_matrix`; it must have nine, column by column",
            numbers.len()
        );
        return Ok((0..numbers.len()).map(|i| numbers[i % 3 * 3 + i / 3]).collect());
    }
    let number = |names: [&str; 2]| names.iter().find_map(|name| value.get(name)?.as_f64());
    if let [Some(fx), Some(fy), Some(cx), Some(cy)] = [["fx"; 2], ["fy"; 2], ["cx", "ppx"], ["cy", "ppy"]].map(number) {
        return Ok(vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    }
    Ok(flat(&value))
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

fn candidates(path: &Path) -> anyhow::Result<Vec<Candidate>> {
    if has_extension(path, "npy") {
        return Ok(poses(path)?.into_iter().map(Candidate::from).collect());
    }
    let value = json(path)?;
    let candidate = |value: &Value| {
        let pose = named(value)?;
        let width = value.get("width").filter(|width| !width.is_null());
        let width = width.map(|width| width.as_f64().with_context(|| format!("`width` is {width}, must be a number")));
        Ok(Candidate { pose, width: width.transpose()? })
    };
    match value.get("grasps").unwrap_or(&value) {
        value @ Value::Object(_) => Ok(vec![candidate(value)?]),
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(candidate).collect(),
        value => Ok(matrices(&flat(value))?.into_iter().map(Candidate::from).collect()),
    }
}

fn named(value: &Value) -> anyhow::Result<Isometry3<f64>> {
    let part = |key: &str| value.get(key).map(flat).unwrap_or_default();
    // `grasp detect --json` writes `orientation_xyzw`.
    let key = if value.get("orientation").is_some() { "orientation" } else { "orientation_xyzw" };
    let (position, orientation) = (part("position"), part(key));
    let (&[x, y, z], &[qx, qy, qz, qw]) = (&position[..], &orientation[..]) else {
        bail!("a pose must have `position` (x, y, z) and `orientation` or `orientation_xyzw` (quaternion x, y, z, w)")
    };
    let rotation = unit(Quaternion::new(qw, qx, qy, qz)).map_err(|reason| anyhow!("`{key}`: {reason}"))?;
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
            "invalid pose matrix: the upper left 3×3 block must be a rotation, the last row 0 0 0 1; got {:?}",
            numbers.chunks(4).collect::<Vec<_>>()
        );
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Ok(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
    };
    numbers.chunks(16).map(pose).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    const K: [f64; 9] = [540.0, 0.0, 320.0, 0.0, 541.0, 240.0, 0.0, 0.0, 1.0];

    #[test]
    fn intrinsics_are_read_in_the_formats_of_other_tools() {
        let texts = [
            r#"{"k": [540, 0, 320, 0, 541, 240, 0, 0, 1]}"#,
            "[[540, 0, 320], [0, 541, 240], [0, 0, 1]]",
            // ROS 2, ROS 1, the calibration file of camera_calibration.
            "header:\n  frame_id: camera\nk:\n- 540.0\n- 0.0\n- 320.0\n- 0.0\n- 541.0\n- 240.0\n- 0.0\n- 0.0\n- 1.0\nr: []\n---\n",
            "height: 480\nK: [540.0, 0.0, 320.0, 0.0, 541.0, 240.0,\n  0.0, 0.0, 1.0]\nD: [0.1]\n---\nheight: 1\n",
            "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [540, 0, 320, 0, 541, 240, 0, 0, 1]\n",
            // Open3D, column by column, alone and in a PinholeCameraParameters; librealsense.
            r#"{"width": 640, "height": 480, "intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}"#,
            r#"{"extrinsic": [1], "intrinsic": {"intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}}"#,
            r#"{"width": 640, "fx": 540, "fy": 541, "ppx": 320, "ppy": 240, "coeffs": [0, 0, 0, 0, 0]}"#,
        ];
        for text in texts {
            assert_eq!(intrinsic_numbers(text).unwrap(), K, "{text}");
        }
        assert!(intrinsic_numbers("k: [1, 2").is_err());
        let error = intrinsic_numbers(r#"{"intrinsic_matrix": [540, 540, 320, 240]}"#).unwrap_err().to_string();
        assert!(error.contains("4 numbers in `intrinsic_matrix`"), "{error}");
        assert_eq!(intrinsics("540, 541,320,240").unwrap(), [540.0, 0.0, 320.0, 0.0, 541.0, 240.0, 0.0, 0.0, 1.0]);
        assert_eq!(intrinsics("540,0,320,0,541,240,0,0,1").unwrap(), K);
        assert_eq!(intrinsics_file("540,541,320,240"), None);
        assert_eq!(intrinsics_file("k,1.json"), Some(PathBuf::from("k,1.json")));
    }

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
            let pose = named(&serde_json::json!({ "position": [1, 2, 3], key: [0, 0, 1, 0] })).unwrap();
            assert!((pose * Point3::new(1.0, 0.0, 0.0) - Point3::new(0.0, 2.0, 3.0)).norm() < 1e-12, "{key}");
            let long = named(&serde_json::json!({ "position": [1, 2, 3], key: [0, 0, 0, 2] }));
            let error = long.unwrap_err().to_string();
            assert!(error.starts_with(&format!("`{key}`: the norm of the quaternion is 2")), "{error}");
        }
        assert!(named(&serde_json::json!({ "position": [1, 2, 3] })).is_err());
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
