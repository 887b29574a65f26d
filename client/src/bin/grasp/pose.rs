//! Poses from files, and from numbers on the command line.

mod found;

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, bail, ensure};
use grasp_client::Candidate;
use nalgebra::{Isometry3, Quaternion, Translation3, Vector3};
use serde_json::Value;

use self::found::{all, pose, unit};
use crate::document::document;
use crate::files::{Purpose, in_file};
use crate::numbers::{Numbers, counted, mistyped};

/// Poses as given on the command line: the numbers of one pose, or a file.
#[derive(Clone, Debug)]
pub(crate) enum Poses {
    Numbers(Isometry3<f64>),
    File(PathBuf),
}

impl FromStr for Poses {
    type Err = String;

    /// X,Y,Z or X,Y,Z,QX,QY,QZ,QW; anything else is a file, unless it can only be numbers.
    fn from_str(text: &str) -> Result<Self, String> {
        let pose = |position: [f64; 3], [x, y, z, w]: [f64; 4]| {
            let rotation = unit(Quaternion::new(w, x, y, z))?;
            Ok(Self::Numbers(Isometry3::from_parts(Translation3::from(Vector3::from(position)), rotation)))
        };
        if let Ok(Numbers(position)) = text.parse::<Numbers<3>>() {
            pose(position, [0.0, 0.0, 0.0, 1.0])
        } else if let Ok(Numbers([x, y, z, qx, qy, qz, qw])) = text.parse::<Numbers<7>>() {
            pose([x, y, z], [qx, qy, qz, qw])
        } else if let Some(reason) = mistyped(text) {
            Err(format!("{reason}; must be a file, or the numbers X,Y,Z or X,Y,Z,QX,QY,QZ,QW"))
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

    /// One pose for each of `count` inputs; `input` names one in the error.
    pub fn each(&self, count: usize, input: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
        match self {
            Self::Numbers(pose) if count == 1 => Ok(vec![*pose]),
            Self::Numbers(_) => {
                bail!("the numbers of 1 pose for {}; give a file with one pose for each", counted(count, input))
            }
            Self::File(path) => each(path, count, input),
        }
    }
}

/// The only pose of a file.
pub(crate) fn one(path: &Path) -> anyhow::Result<Isometry3<f64>> {
    match in_file(path, poses)?[..] {
        [pose] => Ok(pose),
        ref poses => {
            bail!("{}: {} in the file, exactly one is needed", path.display(), counted(poses.len(), "pose"))
        }
    }
}

/// One pose for each of `count` inputs; `input` names one in the error.
fn each(path: &Path, count: usize, input: &str) -> anyhow::Result<Vec<Isometry3<f64>>> {
    let poses = in_file(path, poses)?;
    ensure!(
        poses.len() == count,
        "{}: {} in the file for {}; give one pose for each",
        path.display(),
        counted(poses.len(), "pose"),
        counted(count, input)
    );
    Ok(poses)
}

fn poses(path: &Path) -> anyhow::Result<Vec<Isometry3<f64>>> {
    all(&document(path, Purpose::Pose)?)
}

fn candidates(path: &Path) -> anyhow::Result<Vec<Candidate>> {
    let value = document(path, Purpose::Pose)?;
    let candidate = |value: &Value| {
        let width = value.get("width").filter(|width| !width.is_null());
        let width = width.map(|width| width.as_f64().with_context(|| format!("`width` is {width}, must be a number")));
        Ok(Candidate { pose: pose(value)?, width: width.transpose()? })
    };
    match value.get("grasps").unwrap_or(&value) {
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(candidate).collect(),
        value @ Value::Object(_) if value.get("width").is_some() => Ok(vec![candidate(value)?]),
        value => Ok(all(value)?.into_iter().map(Candidate::from).collect()),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix4, Point3, UnitQuaternion};

    use super::found::of_matrix;
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
        assert!(refused("1,2,3,0,0,2,0").contains("the norm of the quaternion is 2; it must be 1 ± 0.01"));
        assert!(refused("1,2,3,0,0,nan,0").contains("NaN"));
        assert!(refused("1,2").starts_with("it has 2 numbers; must be a file, or the numbers X,Y,Z or"));
        assert!(refused("1,2,o").starts_with("`o` is not a number"));
        let error = Poses::Numbers(pose).each(2, "image").unwrap_err().to_string();
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
            r#"{"T_base_camera": [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], "K": [1, 2, 3]}"#,
            r#"{"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"qx": 0, "qy": 0, "qz": 1, "qw": 0}}"#,
            r#"{"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"X": 0, "Y": 0, "Z": 1, "W": 0}}"#,
            r#"{"position": ["1", "2", "3"], "orientation": ["0", "0", "1", "0"]}"#,
            r#"{"position": [1, 2, 3], "orientation": [0, 0, 0.991, 0]}"#,
            r#"{"R": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]], "t": [1, 2, 3]}"#,
            r#"{"rotation": [-1, 0, 0, 0, -1, 0, 0, 0, 1], "translation": [[1], [2], [3]]}"#,
            r#"{"camera": {"pose": [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3]]}}"#,
            r#"{"numbers": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15], "T": [-1, 0, 0, 1, 0, -1, 0, 2, 0, 0, 1, 3, 0, 0, 1e-9, 1]}"#,
            "transforms:\n- child_frame_id: camera\n  transform:\n    translation: {x: 1.0, y: 2.0, z: 3.0}\n    rotation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}\n",
            // Text of numpy.savetxt, rows of poses, and a trajectory of TUM.
            "-1.0 0 0 1\n0 -1 0 2\n0 0 1 3\n0 0 0 1\n",
            "-1.0 0 0 1\n0 -1 0 2\n0 0 1 3\n",
            "1 2 3 0 0 1 0\n",
            "1311867170.4 1 2 3 0 0 1 0\n",
        ];
        for text in texts {
            let found = all(&crate::document::parse(text).unwrap()).unwrap();
            assert_eq!(found.len(), 1, "{text}");
            assert!((found[0] * Point3::new(1.0, 0.0, 0.0) - Point3::new(0.0, 2.0, 3.0)).norm() < 1e-12, "{text}");
        }
    }

    #[test]
    fn poses_that_are_in_doubt_are_refused() {
        let one = "[[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]";
        let other = "[[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, -3], [0, 0, 0, 1]]";
        let nested = r#"{"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}"#;
        let texts = [
            (
                format!(r#"{{"T_base_cam": {one}, "T_cam_base": {other}}}"#),
                "several poses in the file: T_base_cam, T_cam_base",
            ),
            (format!(r#"{{"camera": {nested}, "base": {{"T": {one}}}}}"#), "several poses in the file: base.T, camera"),
            (r#"{"position": [NaN, 0, 0], "orientation": [0, 0, 0, 1]}"#.to_owned(), "the position is [NaN, 0.0, 0.0]"),
            ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]".to_owned(), "send the matrix row by row"),
            ("[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]".to_owned(), "it mirrors"),
            (r#"{"position": [1, 2, 3], "orientation": [0, 0, 1]}"#.to_owned(), "`orientation` has three numbers"),
            ("{}".to_owned(), "or be a 4×4 matrix: the file has no keys"),
            ("[1, 2, 3, 4, 5]".to_owned(), "no pose: each is a 4×4 or 3×4 matrix, or a row"),
        ];
        for (text, part) in texts {
            let error = format!("{:#}", all(&crate::document::parse(&text).unwrap()).unwrap_err());
            assert!(error.contains(part), "{text}: {error}");
        }
        let same = format!(r#"{{"T_base_cam": {one}, "again": {one}}}"#);
        assert_eq!(all(&crate::document::parse(&same).unwrap()).unwrap().len(), 1);
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
        assert!(of_matrix(&numbers).unwrap().rotation.angle_to(&rotation) < 1e-3);
        numbers[0] += 0.05;
        let error = of_matrix(&numbers).unwrap_err().to_string();
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
        assert!(of_matrix(&numbers).is_ok());
        numbers[5] = 2.0;
        let error = of_matrix(&numbers).unwrap_err().to_string();
        assert!(error.contains("[0.0, 2.0, 0.0]"), "{error}");
    }
}
