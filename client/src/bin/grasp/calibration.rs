//! Finds the camera in a document of ROS, OpenCV, Open3D, librealsense, kalibr, BOP or another tool.
//!
//! One walk collects the cameras, and one table names what may be said of them, in their object or in those around it.
//! What looks like a part of the calibration but cannot be understood is an error: with half of a calibration the
//! grasps would be wrong without a word.

mod names;
mod values;

use anyhow::{Context, bail, ensure};
use serde_json::{Map, Value};

use self::names::{NAMES, Role, is_of_grid, role};
use self::values::{of_said, short};
use crate::camera::{Camera, matrix, of_numbers, windowed};
use crate::distortion;
use crate::document::{keys, listed, number, numbers, plain};
use crate::notes::note;

/// Something that a document says.
#[derive(Clone)]
struct Said<'a> {
    role: Role,
    key: &'a str,
    value: &'a Value,
    /// Steps to the object of the camera: even for it and those around it, odd for what else these contain.
    distance: usize,
}

/// The camera of a document, which may also be bare numbers. `rectified`: that of its rectified images, which have the
/// projection matrix, if there is one, and no distortion.
pub(crate) fn camera(document: &Value, rectified: bool) -> anyhow::Result<Camera> {
    let mut found = Vec::new();
    Walk { rectified, found: &mut found }.walk(document, String::new(), &[])?;
    let is_other = |camera: &Camera| found.first().is_some_and(|(_, first)| first != camera);
    if found.iter().any(|(_, camera)| is_other(camera)) {
        let is_depth = |path: &str| path.split('.').any(|key| plain(key).starts_with("depth"));
        let names = listed(found.iter().map(|(path, _)| path.as_str()));
        let [(path, camera)] = &found.iter().filter(|(path, _)| is_depth(path)).collect::<Vec<_>>()[..] else {
            bail!("several cameras in the file: {names}; give a file with the depth camera alone")
        };
        note(format_args!("the intrinsics are those of `{path}`, one of {names}"));
        return Ok(camera.clone());
    }
    if let Some((_, camera)) = found.pop() {
        return Ok(camera);
    }
    // A .npz file with one array of any name.
    let only = document.as_object().filter(|map| map.len() == 1).and_then(|map| map.values().next());
    let bare = numbers(only.unwrap_or(document)).unwrap_or_default();
    ensure!(bare.len() >= 4, "no intrinsics found{}", keys(document));
    Ok(Camera::from(checked(of_numbers(&bare)?)?))
}

/// Collects the cameras of a document with their paths.
struct Walk<'f> {
    rectified: bool,
    found: &'f mut Vec<(String, Camera)>,
}

impl Walk<'_> {
    fn walk<'a>(&mut self, value: &'a Value, path: String, around: &[Said<'a>]) -> anyhow::Result<()> {
        if let Value::Array(values) = value {
            let mut items = values.iter().enumerate().filter(|(_, value)| has_camera(value));
            return items.try_for_each(|(i, value)| self.walk(value, format!("{path}[{i}]"), around));
        }
        let Value::Object(map) = value else { return Ok(()) };
        let mut said = Vec::new();
        collect(map, 0, &mut said);
        said.extend(around.iter().map(|outer| Said { distance: outer.distance + 2, ..outer.clone() }));
        if let Some(k) = self.matrix_of(map)? {
            let name = if path.is_empty() { "the file itself".to_owned() } else { path.clone() };
            self.found.push((name, windowed(of_said(k, &said, self.rectified)?, map)));
        }
        for (key, inner) in map.iter().filter(|(_, inner)| has_camera(inner)) {
            self.walk(inner, if path.is_empty() { key.clone() } else { format!("{path}.{key}") }, &said)?;
        }
        Ok(())
    }

    fn matrix_of(&self, map: &Map<String, Value>) -> anyhow::Result<Option<[f64; 9]>> {
        match projection_of(map).filter(|_| self.rectified) {
            Some(projection) => Ok(Some(checked(projection?)?)),
            None => matrix_of(map),
        }
    }
}

fn has_camera(value: &Value) -> bool {
    let is_camera = |(key, value): (&String, &Value)| match role(key) {
        Some(Role::Matrix | Role::Projection) => {
            is_quoted(value) || numbers(value).is_some_and(|numbers| numbers.len() >= 4)
        }
        Some(Role::Intrinsic(0)) => number(value).is_some(),
        _ => false,
    };
    match value {
        Value::Object(map) => map.iter().any(is_camera) || map.values().any(has_camera),
        Value::Array(values) => values.iter().any(has_camera),
        _ => false,
    }
}

/// Whether a text has the numbers of a matrix.
fn is_quoted(value: &Value) -> bool {
    let text = value.as_str().unwrap_or_default().trim_start();
    let words = text.split(|c: char| !(c.is_ascii_digit() || ".+-eE".contains(c)));
    text.starts_with(|c: char| c.is_ascii_digit() || "[-".contains(c))
        && words.filter(|word| word.parse::<f64>().is_ok()).count() >= 4
}

/// What an object says, and what the objects in it say that are no cameras themselves.
fn collect<'a>(map: &'a Map<String, Value>, distance: usize, said: &mut Vec<Said<'a>>) {
    let has = |name: &str| map.keys().any(|key| plain(key) == name);
    for (key, value) in map {
        let role = role(key);
        match (role, value) {
            (_, Value::Null) => (),
            // A quaternion has w alone, and a region of interest its own size.
            (Some(Role::Edge(_)), _) if plain(key).len() == 1 && !(has("w") && has("h")) => (),
            (Some(Role::Edge(_)), _) if is_of_grid(key) && (has("data") || distance % 2 == 1) => (),
            (_, Value::Object(_)) if key == "roi" || has_camera(value) => (),
            (Some(Role::Coefficients), Value::Object(inner)) if numbers(value).is_none() => {
                lens(key, value, inner, distance, said);
            }
            (Some(Role::Size), Value::Object(inner)) => collect(inner, distance, said),
            (Some(Role::Matrix | Role::Projection | Role::Intrinsic(_)), _) => (),
            (Some(Role::Coefficients | Role::Doubtful), Value::String(text)) if distortion::is_model(text) => {
                said.push(Said { role: Role::DistortionModel, key, value, distance });
            }
            (Some(role), _) => said.push(Said { role, key, value, distance }),
            (None, Value::Object(inner)) => collect(inner, distance | 1, said),
            (None, _) => (),
        }
    }
}

/// What the object of a distortion says: its coefficients by name or as a list, and its model.
fn lens<'a>(key: &'a str, value: &'a Value, map: &'a Map<String, Value>, distance: usize, said: &mut Vec<Said<'a>>) {
    let before = said.len();
    for (key, value) in map {
        let role = match plain(key).as_str() {
            "type" | "name" => Some(Role::DistortionModel),
            "parameters" | "values" | "params" => Some(Role::Coefficients),
            _ => role(key),
        };
        said.extend(role.map(|role| Said { role, key, value, distance }));
    }
    let is_coefficient =
        |said: &Said| matches!(said.role, Role::Coefficients | Role::Coefficient(_) | Role::Radial | Role::Tangential);
    if !said[before..].iter().any(is_coefficient) {
        said.push(Said { role: Role::Coefficients, key, value, distance });
    }
}

/// The intrinsic matrix of an object.
fn matrix_of(map: &Map<String, Value>) -> anyhow::Result<Option<[f64; 9]>> {
    let of_role = |wanted: Role| map.iter().filter(move |(key, value)| role(key) == Some(wanted) && !value.is_null());
    let mut found: Vec<(&str, [f64; 9])> = Vec::new();
    for (key, value) in of_role(Role::Matrix) {
        let is_plain = value.as_array().is_some_and(|values| !values.iter().any(Value::is_object));
        match numbers(value) {
            Some(numbers) if numbers.len() > 1 => {
                found.push((key, of_numbers(&numbers).with_context(|| format!("`{key}`"))?));
            }
            None if is_plain => bail!("`{key}` is {}, must be numbers", short(value)),
            None if is_quoted(value) => bail!("`{key}` is the text {}, must be numbers without quotes", short(value)),
            _ => (),
        }
    }
    let name = |axis: usize| {
        let (names, _) = NAMES.iter().find(|(_, role)| *role == Role::Intrinsic(axis))?;
        names.iter().find_map(|name| map.iter().find(|(key, _)| plain(key) == *name))
    };
    if let (Some(fx), Some(fy), Some(cx), Some(cy)) = (name(0), name(1), name(2), name(3)) {
        let read = |(key, value): (&String, &Value)| {
            number(value).with_context(|| format!("`{key}` is {}, must be a number", short(value)))
        };
        found.push((fx.0, matrix(read(fx)?, read(fy)?, read(cx)?, read(cy)?)));
    }
    let Some(&(first, k)) = found.first() else { return projection_of(map).transpose()?.map(checked).transpose() };
    for (key, other) in &found {
        let is_same = k.iter().zip(other).all(|(a, b)| (a - b).abs() <= 1e-3);
        ensure!(is_same || k.iter().any(|c| c.is_nan()), "`{first}` and `{key}` are different intrinsics");
    }
    checked(k).map(Some)
}

/// The matrix of the projection matrix of an object.
fn projection_of(map: &Map<String, Value>) -> Option<anyhow::Result<[f64; 9]>> {
    let numbers_of = |(key, value): (&String, &Value)| (role(key) == Some(Role::Projection)).then(|| numbers(value))?;
    let numbers = |(key, value)| Some((key, numbers_of((key, value)).filter(|numbers| numbers.len() == 12)?));
    let (key, numbers) = map.iter().find_map(numbers)?;
    Some(of_numbers(&numbers).with_context(|| format!("`{key}`")))
}

fn checked(k: [f64; 9]) -> anyhow::Result<[f64; 9]> {
    ensure!(k.iter().all(|number| number.is_finite()), "the intrinsics are {k:?}, must be finite");
    ensure!(k[0] != 0.0 && k[4] != 0.0, "the intrinsics are 0: the camera is not calibrated");
    Ok(k)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distortion::Distortion;
    use crate::document::parse;

    const K: [f64; 9] = [540.0, 0.0, 320.0, 0.0, 541.0, 240.0, 0.0, 0.0, 1.0];
    const FX: &str = r#""fx": 540, "fy": 541, "cx": 320, "cy": 240"#;

    fn read(text: &str) -> anyhow::Result<Camera> {
        camera(&parse(text)?, false)
    }

    #[test]
    fn intrinsics_are_read_in_the_formats_of_other_tools() {
        let texts = [
            r#"{"k": [540, 0, 320, 0, 541, 240, 0, 0, 1]}"#,
            "[[540, 0, 320], [0, 541, 240], [0, 0, 1]]",
            // ROS 2, ROS 1, the calibration file of camera_calibration.
            "header:\n  frame_id: camera\nk:\n- 540.0\n- 0.0\n- 320.0\n- 0.0\n- 541.0\n- 240.0\n- 0.0\n- 0.0\n- 1.0\nr: []\n---\n",
            "height: 480\nK: [540.0, 0.0, 320.0, 0.0, 541.0, 240.0,\n  0.0, 0.0, 1.0]\nD: [0]\n---\nheight: 1\n",
            "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [540, 0, 320, 0, 541, 240, 0, 0, 1]\n",
            // Open3D, column by column, alone and in a PinholeCameraParameters; the same key with rows; librealsense.
            r#"{"width": 640, "height": 480, "intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}"#,
            r#"{"extrinsic": [1], "intrinsic": {"intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}}"#,
            r#"{"intrinsic_matrix": [[540, 0, 320], [0, 541, 240], [0, 0, 1]]}"#,
            r#"{"width": 640, "fx": 540, "fy": 541, "ppx": 320, "ppy": 240, "coeffs": [0, 0, 0, 0, 0]}"#,
            // BOP, VGN, kalibr, OpenCV, numpy.savetxt, ORB-SLAM, NeRF.
            r#"{"0": {"cam_K": [540, 0, 320, 0, 541, 240, 0, 0, 1], "depth_scale": 1.0}}"#,
            r#"{"size": 0.3, "intrinsic": {"width": 640, "height": 480, "K": [540, 0, 320, 0, 541, 240, 0, 0, 1]}}"#,
            "cam0:\n  camera_model: pinhole\n  intrinsics: [540.0, 541.0, 320.0, 240.0]\n  resolution: [640, 480]\n",
            "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 540., 0., 320., 0., 541., 240., 0., 0., 1. ]\n",
            "5.4e+02 0.0 3.2e+02\n0.0 5.41e+02 2.4e+02\n0.0 0.0 1.0\n",
            "%YAML:1.0\nCamera.type: \"PinHole\"\nCamera.fx: 540\nCamera.fy: 541\nCamera.cx: 320\nCamera.cy: 240\n",
            r#"{"fl_x": 540, "fl_y": 541, "cx": 320, "cy": 240, "frames": [{"transform_matrix": [[1]]}]}"#,
            // A projection matrix; numbers as text; keys in upper case.
            "[[540, 0, 320, 0], [0, 541, 240, 0], [0, 0, 1, 0]]",
            "p: [540, 0, 320, 0, 0, 541, 240, 0, 0, 0, 1, 0]",
            r#"{"FX": "540", "FY": "541", "CX": "320", "CY": "240"}"#,
        ];
        for text in texts {
            assert_eq!(read(text).unwrap().k, K, "{text}");
        }
    }

    #[test]
    fn the_size_is_read_wherever_it_is() {
        let texts = [
            format!(r#"{{"w": 848, "h": 480, {FX}}}"#),
            format!(r#"{{"image_size": [848, 480], {FX}}}"#),
            format!(r#"{{"resolution": {{"width": 848, "height": 480}}, {FX}}}"#),
            format!(r#"{{"resolution": "848x480", {FX}}}"#),
            format!(r#"{{"width": "848", "height": "480", {FX}}}"#),
            format!(r#"{{"image_Width": 848, "image_Height": 480, {FX}}}"#),
            format!(r#"{{"width": 848, "height": 480, "intrinsics": {{{FX}}}}}"#),
            format!(r#"{{"image": {{"width": 848, "height": 480}}, "K": {K:?}}}"#),
            format!(r#"{{"rows": 480, "cols": 848, {FX}}}"#),
            format!(r#"{{"nCols": 848, "nRows": 480, {FX}}}"#),
            format!(r#"{{"image_shape": [480, 848, 3], {FX}}}"#),
            format!(r#"{{"shape": [480, 848], {FX}}}"#),
            format!(r#"{{"frame_size": [848, 480], {FX}}}"#),
            format!(r#"{{"res": "848x480", {FX}}}"#),
            format!(r#"{{"width_px": 848, "height_px": 480, {FX}}}"#),
            format!(r#"{{"sensor_width": 848, "sensor_height": 480, {FX}}}"#),
        ];
        for text in texts {
            assert_eq!(read(&text).unwrap().size, [Some(848), Some(480)], "{text}");
        }
        assert_eq!(read(&format!(r#"{{"width": 848, {FX}}}"#)).unwrap().size, [Some(848), None]);
        // The region of interest, the quaternion of a pose and the width of a hand are no sizes.
        let other = r#""pose": {"x": 0, "y": 0, "z": 0, "w": 1}, "gripper": {"width": 0.08}, "roi": {"width": 0},
            "board": {"rows": 6, "cols": 9}, "r": {"rows": 3, "cols": 3, "data": []}, "sensor_width": 5.76"#;
        assert_eq!(read(&format!("{{{other}, {FX}}}")).unwrap().size, [None, None]);
    }

    #[test]
    fn the_distortion_is_read_wherever_it_is() {
        let d = "[-0.28, 0.09, 0, 0, 0]";
        let expected = Distortion::new(None, &[-0.28, 0.09, 0.0, 0.0, 0.0]).unwrap();
        let names = "d dist distCoeffs dist_coefs distortion distortion_coeff Distortion_Coefficients coeffs kc";
        let named = names.split(' ').map(|name| format!(r#"{{"K": {K:?}, "{name}": [{d}]}}"#));
        let others = [
            format!(r#"{{{FX}, "k1": -0.28, "k2": 0.09, "p1": 0, "p2": 0}}"#),
            format!(r#"{{{FX}, "distortion": {{"k1": -0.28, "k2": "0.09"}}}}"#),
            format!(r#"{{{FX}, "distortion": {{"type": "radtan", "parameters": {d}}}}}"#),
            format!(r#"{{{FX}, "coeffs": {{"k1": -0.28, "k2": 0.09}}}}"#),
            format!(r#"{{"intrinsics": {{{FX}}}, "distortion": {d}}}"#),
            format!(r#"{{{FX}, "d": ["-0.28", "0.09", "0", "0", "0"]}}"#),
            format!(r#"{{{FX}, "model": "distortion.brown_conrady", "coeffs": {d}}}"#),
            format!(r#"{{{FX}, "lens_distortion": {d}}}"#),
            format!(r#"{{{FX}, "RadialDistortion": [-0.28, 0.09], "TangentialDistortion": [0, 0]}}"#),
            format!(r#"{{{FX}, "distortion": {{"radial": [-0.28, 0.09, 0]}}, "rad_dist": [0, 0], "min_dist": 0.2}}"#),
            format!(
                "%YAML:1.0\n---\ncameraMatrix: !!opencv-matrix\n   data: {K:?}\ndistCoeffs: !!opencv-matrix\n   data: {d}\n"
            ),
        ];
        for text in named.chain(others) {
            assert_eq!(read(&text).unwrap().distortion, expected, "{text}");
        }
        let fisheye = Distortion::new(Some("equidistant"), &[0.02, -0.01, 0.003, -0.0005]).unwrap();
        for key in [r#""distortion_type": "equidistant""#, r#""fisheye": true"#, r#""camera_model": "OPENCV_FISHEYE""#]
        {
            let text = format!(r#"{{{FX}, {key}, "d": [0.02, -0.01, 0.003, -0.0005]}}"#);
            assert_eq!(read(&text).unwrap().distortion, fisheye, "{text}");
        }
        for none in ["[]", "0", "false", r#""none""#, "null"] {
            assert_eq!(read(&format!(r#"{{{FX}, "distortion": {none}}}"#)).unwrap().distortion, None, "{none}");
        }
    }

    #[test]
    fn rectified_images_have_the_projection_matrix_and_no_distortion() {
        let p = "[530, 0, 310, 0, 0, 531, 230, 0, 0, 0, 1, 0]";
        let lens = r#""D": [0.1, 0.2, 0, 0, 0], "distortion_model": "double_sphere""#;
        let read = |text: &str| camera(&parse(text).unwrap(), true);
        let rectified = read(&format!(r#"{{"K": {K:?}, {lens}, "P": {p}}}"#)).unwrap();
        assert_eq!((rectified.k[0], rectified.distortion), (530.0, None));
        let without = read(&format!(r#"{{"K": {K:?}, {lens}}}"#)).unwrap();
        assert_eq!((without.k, without.distortion), (K, None));
        assert!(read(&format!(r#"{{"K": {K:?}, "P": {:?}}}"#, [0; 12])).is_err());
    }

    #[test]
    fn the_depth_scale_is_read_wherever_it_is() {
        let keys = [
            (r#""depth_scale": 0.0005"#, 0.0005),
            (r#""depth_scale": 1.0"#, 0.001),
            (r#""depth_scale": 0.1"#, 0.0001),
            (r#""depth_scale": 5000"#, 0.0002),
            (r#""depth_scale": "0.0005""#, 0.0005),
            (r#""depthScale": 0.0005"#, 0.0005),
            (r#""depth_unit": 0.0005"#, 0.0005),
            (r#""depth_units": "mm""#, 0.001),
            (r#""depth_unit": "cm""#, 0.01),
            (r#""units_per_meter": 2000"#, 0.0005),
            (r#""factor_depth": [[2000]]"#, 0.0005),
            (r#""depth_factor": 2000"#, 0.0005),
            (r#""DepthMapFactor": 2000"#, 0.0005),
            (r#""png_depth_scale": 2000"#, 0.0005),
            (r#""depth_scaling": 0.0005"#, 0.0005),
            (r#""scale": 0.0005"#, 0.0005),
        ];
        for (key, expected) in keys {
            for text in [format!(r#"{{{FX}, {key}}}"#), format!(r#"{{{key}, "intrinsics": {{{FX}}}}}"#)] {
                let scale = read(&text).unwrap().depth_scale.unwrap();
                assert!((scale - expected).abs() < 1e-12, "{text}: {scale}");
            }
        }
        assert_eq!(read(&format!(r#"{{{FX}, "scale": 0.5}}"#)).unwrap().depth_scale, None, "that of an image");
    }

    #[test]
    fn what_cannot_be_understood_is_refused_by_name() {
        let texts = [
            (format!(r#"{{{FX}, "width": "wide"}}"#), r#"`width` is "wide", must be a number of pixels"#),
            (
                format!(r#"{{{FX}, "resolution": [1, 2, 3]}}"#),
                "`resolution` is [1,2,3], must be the width and the height",
            ),
            (
                format!(r#"{{{FX}, "d": "<sequence>"}}"#),
                r#"`d` is "<sequence>", must be the numbers of the distortion"#,
            ),
            (format!(r#"{{{FX}, "distortion": {{"a": 1}}}}"#), r#"`distortion` is {"a":1}, must be the numbers"#),
            (format!(r#"{{{FX}, "k1": [1, 2]}}"#), "`k1` is [1,2], must be a number of the distortion"),
            (format!(r#"{{{FX}, "k1": 1, "k2": 1, "k3": 1, "k4": 1}}"#), "name its `distortion_model`"),
            (format!(r#"{{{FX}, "model": 2, "coeffs": [0.1, 0, 0, 0, 0]}}"#), "`inverse_brown_conrady` with 5"),
            (format!(r#"{{{FX}, "d": [0.1, 0.2]}}"#), "with 2 coefficients is not supported"),
            (format!(r#"{{{FX}, "rad_dist": [0.1, 0.2]}}"#), "`rad_dist` is [0.1,0.2], which may be the distortion"),
            (format!(r#"{{{FX}, "undistortion": {{"a": 1}}}}"#), "`undistortion` is"),
            (format!(r#"{{{FX}, "radial": [1, 2, 3, 4]}}"#), "`radial` is [1,2,3,4], must be k1, k2 and k3"),
            (format!(r#"{{{FX}, "depth_scale": 0}}"#), "`depth_scale` is 0, must be the unit of the depths"),
            (format!(r#"{{{FX}, "depth_unit": "inch"}}"#), r#"`depth_unit` is "inch", must be the unit of the depths"#),
            (format!(r#"{{{FX}, "k": [1, 0, 3, 0, 1, 3, 0, 0, 1]}}"#), "`k` and `fx` are different intrinsics"),
            (format!(r#"{{"K": {K:?}, "dist": [0.1, 0, 0, 0], "D": [0, 0, 0, 0]}}"#), "but `dist` is [0.1,0,0,0]"),
            ("k: [0, 0, 0, 0, 0, 0, 0, 0, 0]".to_owned(), "the camera is not calibrated"),
            ("k: [540, 0, 320, 0, .nan, 240, 0, 0, 1]".to_owned(), "a number is nan or infinite"),
            (r#"{"k": [540, 0, 320, 0, NaN, 240, 0, 0, 1]}"#.to_owned(), "must be finite"),
            (r#"{"k": [540, 0, 320]}"#.to_owned(), "`k`: 3 numbers; an intrinsic matrix has nine"),
            (r#"{"k": "[540, 0, 320, 0, 541, 240, 0, 0, 1]"}"#.to_owned(), "`k` is the text \"[540, 0, 320,"),
            ("{}".to_owned(), "no intrinsics found: the file has no keys"),
            (r#"{"focal": 540, "centre": 320}"#.to_owned(), "no intrinsics found; keys in the file: centre, focal"),
            ("k: [1, 2".to_owned(), "neither JSON nor YAML"),
            (String::new(), "the file is empty"),
        ];
        for (text, part) in texts {
            let error = format!("{:#}", read(&text).unwrap_err());
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn of_several_cameras_only_that_of_the_depth_is_chosen() {
        let other = FX.replace("540", "250");
        let error = read(&format!(r#"{{"cam0": {{{FX}}}, "cam1": {{{other}}}}}"#)).unwrap_err().to_string();
        assert_eq!(error, "several cameras in the file: cam0, cam1; give a file with the depth camera alone");
        assert!(read(&format!(r#"[{{{FX}}}, {{{other}}}]"#)).unwrap_err().to_string().contains("[0], [1]"));
        assert_eq!(read(&format!(r#"{{"color": {{{other}}}, "depth": {{{FX}}}}}"#)).unwrap().k, K);
        assert_eq!(read(&format!(r#"{{"0": {{{FX}}}, "1": {{{FX}}}}}"#)).unwrap().k, K, "the same twice");
    }

    #[test]
    fn cropped_and_binned_images_have_their_own_intrinsics() {
        let roi = "roi:\n  x_offset: 20\n  y_offset: 40\n  width: 600\n  height: 400\n";
        let text = format!("width: 640\nheight: 480\nbinning_x: 2\nbinning_y: 2\nk: {K:?}\n{roi}");
        let camera = read(&text).unwrap();
        assert_eq!(camera.size, [Some(300), Some(200)]);
        assert_eq!(camera.k, [270.0, 0.0, 149.75, 0.0, 270.5, 99.75, 0.0, 0.0, 1.0]);
    }
}
