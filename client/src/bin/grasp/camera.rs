//! Intrinsics from files of ROS, OpenCV, Open3D, librealsense, kalibr, BOP and others, or from numbers on the command
//! line.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use grasp_client::{Depth, DepthView, Extrinsics};
use serde_json::{Map, Value};

use crate::distortion::Distortion;
use crate::document::{document, flat};
use crate::files::{self, has_extension, in_file};
use crate::image::{self, Scale};
use crate::labels::Labels;
use crate::numbers::Numbers;

/// What a file says about a camera.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Camera {
    /// The intrinsic matrix, row by row.
    pub k: [f64; 9],
    /// Width and height of the images, pixels.
    pub size: Option<[u32; 2]>,
    /// Distortion of the lens; None if there is none.
    pub distortion: Option<Distortion>,
    /// Unit of integer depths, metres.
    pub depth_scale: Option<f64>,
}

impl From<[f64; 9]> for Camera {
    fn from(k: [f64; 9]) -> Self {
        Self { k, size: None, distortion: None, depth_scale: None }
    }
}

impl Camera {
    /// FX,FY,CX,CY, nine numbers, or a file.
    pub fn read(text: &str) -> anyhow::Result<Self> {
        if let Ok(Numbers([fx, fy, cx, cy])) = text.parse::<Numbers<4>>() {
            return Ok(matrix(fx, fy, cx, cy).into());
        }
        if let Ok(Numbers(k)) = text.parse::<Numbers<9>>() {
            return Ok(k.into());
        }
        in_file(Path::new(text), |path| {
            if has_extension(path, "npy") || has_extension(path, "npz") {
                return Ok(of_numbers(&files::floats(files::array_of(
                    path,
                    &["k", "camera_matrix", "cam_K", "intrinsics", "mtx"],
                )?)?)?
                .into());
            }
            of_document(&document(path)?)
        })
    }

    /// Reads a depth image of this camera, rectified, with the labels of its pixels.
    pub fn view(
        &self,
        file: &Path,
        scale: Scale,
        labels: Option<Labels>,
        extrinsics: Extrinsics,
    ) -> anyhow::Result<DepthView> {
        let (mut depth, width, height) = image::read(file, scale)?;
        in_file(file, |_| self.check_size(width, height))?;
        let mut labels = labels.map(|labels| labels.of_image(width, height)).transpose()?;
        if let Some(lens) = &self.distortion {
            depth = match depth {
                Depth::Metres(depth) => Depth::Metres(lens.rectified(&depth, width, height, &self.k)),
                Depth::Millimetres(depth) => Depth::Millimetres(lens.rectified(&depth, width, height, &self.k)),
                Depth::Png(depth) => Depth::Png(lens.rectified(&depth, width, height, &self.k)),
            };
            labels = labels.map(|labels| lens.rectified(&labels, width, height, &self.k));
        }
        Ok(DepthView { depth, width, height, k: self.k, extrinsics, labels })
    }

    /// Checks that an image has the size that the file gives.
    fn check_size(&self, width: u32, height: u32) -> anyhow::Result<()> {
        let Some([w, h]) = self.size else { return Ok(()) };
        if [w, h] == [width, height] {
            return Ok(());
        }
        let scale = f64::from(width) / f64::from(w);
        // Rounded sizes of a scaled image differ by a pixel.
        let advice = if (scale * f64::from(h) - f64::from(height)).abs() <= 1.0 {
            let [fx, _, cx, _, fy, cy, ..] = self.k.map(|number| (number * scale * 1e4).round() / 1e4);
            format!("if the image was scaled, its intrinsics are {fx},{fy},{cx},{cy}")
        } else {
            "if the image was cropped, subtract the left and upper margin from cx and cy".to_owned()
        };
        bail!("the intrinsics are of images of {w} × {h} pixels, the image has {width} × {height}; {advice}")
    }
}

/// The file of intrinsics, if they are in one.
pub(crate) fn file(text: &str) -> Option<PathBuf> {
    let is_numbers = text.split(',').all(|number| number.trim().parse::<f64>().is_ok());
    (!is_numbers).then(|| PathBuf::from(text))
}

fn matrix(fx: f64, fy: f64, cx: f64, cy: f64) -> [f64; 9] {
    [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
}

/// The matrix of nine numbers, row by row, or of the twelve of a projection matrix without a translation.
fn of_numbers(numbers: &[f64]) -> anyhow::Result<[f64; 9]> {
    match *numbers {
        [a, b, c, d, e, f, g, h, i] => Ok([a, b, c, d, e, f, g, h, i]),
        [a, b, c, tx, d, e, f, ty, g, h, i, tz] => {
            ensure!([tx, ty, tz] == [0.0; 3], "the fourth column of the 3×4 matrix is {tx}, {ty}, {tz}, must be 0");
            Ok([a, b, c, d, e, f, g, h, i])
        }
        _ => bail!("{} numbers; an intrinsic matrix has nine, row by row", numbers.len()),
    }
}

/// The camera of a document: the first object in it that has intrinsics, or bare numbers.
fn of_document(value: &Value) -> anyhow::Result<Camera> {
    if let Some(camera) = find(value)? {
        return Ok(camera);
    }
    let numbers = flat(value);
    let keys = value.as_object().map(|map| map.keys().cloned().collect::<Vec<_>>().join(", "));
    let found = keys.map_or_else(String::new, |keys| format!("; keys in the file: {keys}"));
    Ok(of_numbers(&numbers).with_context(|| format!("no intrinsics found{found}"))?.into())
}

fn find(value: &Value) -> anyhow::Result<Option<Camera>> {
    let Value::Object(map) = value else { return Ok(None) };
    if let Some(camera) = of_object(map)? {
        return Ok(Some(camera));
    }
    for inner in map.values() {
        if let Some(camera) = find(inner)? {
            return Ok(Some(camera));
        }
    }
    Ok(None)
}

/// The first of these keys, as numbers. OpenCV and ROS put matrices into `data`.
fn numbers(map: &Map<String, Value>, keys: &[&str]) -> Option<Vec<f64>> {
    let value = keys.iter().find_map(|key| map.get(*key))?;
    Some(flat(value.get("data").unwrap_or(value)))
}

fn number(map: &Map<String, Value>, keys: &[&str]) -> Option<f64> {
    keys.iter().find_map(|key| map.get(*key)?.as_f64())
}

fn of_object(map: &Map<String, Value>) -> anyhow::Result<Option<Camera>> {
    let k = if let Some(numbers) = numbers(map, &["k", "K", "cam_K", "camera_matrix", "cameraMatrix"]) {
        of_numbers(&numbers)?
    } else if let Some(columns) = map.get("intrinsic_matrix") {
        // Open3D, column by column.
        let numbers = flat(columns);
        ensure!(numbers.len() == 9, "{} numbers in `intrinsic_matrix`; it has nine, column by column", numbers.len());
        std::array::from_fn(|i| numbers[i % 3 * 3 + i / 3])
    } else if let (Some(fx), Some(fy), Some(cx), Some(cy)) = (
        number(map, &["fx"]),
        number(map, &["fy"]),
        number(map, &["cx", "ppx", "x_offset"]),
        number(map, &["cy", "ppy", "y_offset"]),
    ) {
        matrix(fx, fy, cx, cy)
    } else if let Some(&[fx, fy, cx, cy]) = numbers(map, &["intrinsics"]).as_deref() {
        // kalibr
        matrix(fx, fy, cx, cy)
    } else {
        return Ok(None);
    };
    let whole = |value: f64| (value >= 1.0 && value <= f64::from(u32::MAX)).then_some(value as u32);
    let edge = |keys: &[&str]| number(map, keys).and_then(whole);
    let size = edge(&["width", "image_width"]).zip(edge(&["height", "image_height"])).map(|(w, h)| [w, h]);
    let resolution = numbers(map, &["resolution"]).and_then(|sizes| match sizes[..] {
        [w, h] => Some([whole(w)?, whole(h)?]),
        _ => None,
    });
    let coefficients =
        ["d", "D", "distortion_coefficients", "distortion_coeffs", "dist_coeff", "dist_coeffs", "coeffs"];
    let coefficients = numbers(map, &coefficients).unwrap_or_default();
    let model = ["distortion_model", "model"].iter().find_map(|key| map.get(*key)?.as_str());
    let distortion = Distortion::new(model, &coefficients)?;
    let depth_scale = number(map, &["depth_scale"]).map(metres).or(number(map, &["factor_depth"]).map(f64::recip));
    if let Some(scale) = depth_scale {
        ensure!(scale.is_finite() && scale > 0.0, "the depth scale of the file must be above 0");
    }
    let camera = Camera { k, size: size.or(resolution), distortion, depth_scale };
    Ok(Some(windowed(camera, map)))
}

/// The unit of `depth_scale`, metres: BOP gives it in millimetres, others in metres, or as units per metre.
fn metres(depth_scale: f64) -> f64 {
    if depth_scale >= 50.0 {
        depth_scale.recip()
    } else if depth_scale > 0.02 {
        depth_scale * 1e-3
    } else {
        depth_scale
    }
}

/// The camera of the images that ROS sends if it crops them (`roi`) and then combines pixels (`binning`): CameraInfo
/// has the intrinsics of the whole sensor.
fn windowed(camera: Camera, map: &Map<String, Value>) -> Camera {
    let roi = map.get("roi").and_then(Value::as_object);
    let of_roi = |key: &str| roi.and_then(|roi| roi.get(key)?.as_f64()).unwrap_or(0.0);
    let binning = ["binning_x", "binning_y"].map(|key| number(map, &[key]).unwrap_or(0.0).max(1.0));
    let offset = ["x_offset", "y_offset"].map(of_roi);
    let cropped = ["width", "height"].map(of_roi);
    if binning == [1.0; 2] && offset == [0.0; 2] && cropped == [0.0; 2] {
        return camera;
    }
    let [fx, _, cx, _, fy, cy, ..] = camera.k;
    // Pixel centres are at whole numbers.
    let centre = |c: f64, axis: usize| (c - offset[axis] + 0.5) / binning[axis] - 0.5;
    let k = matrix(fx / binning[0], fy / binning[1], centre(cx, 0), centre(cy, 1));
    let size = camera.size.map(|[w, h]| {
        let of_axis = |whole: u32, axis: usize| {
            let edge = if cropped[axis] > 0.0 { cropped[axis] } else { f64::from(whole) };
            (edge / binning[axis]) as u32
        };
        [of_axis(w, 0), of_axis(h, 1)]
    });
    Camera { k, size, ..camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::document::parse;

    const K: [f64; 9] = [540.0, 0.0, 320.0, 0.0, 541.0, 240.0, 0.0, 0.0, 1.0];

    fn camera(text: &str) -> anyhow::Result<Camera> {
        of_document(&parse(text)?)
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
            // Open3D, column by column, alone and in a PinholeCameraParameters; librealsense.
            r#"{"width": 640, "height": 480, "intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}"#,
            r#"{"extrinsic": [1], "intrinsic": {"intrinsic_matrix": [540, 0, 0, 0, 541, 0, 320, 240, 1]}}"#,
            r#"{"width": 640, "fx": 540, "fy": 541, "ppx": 320, "ppy": 240, "coeffs": [0, 0, 0, 0, 0]}"#,
            // BOP, VGN, kalibr, OpenCV, numpy.savetxt.
            r#"{"0": {"cam_K": [540, 0, 320, 0, 541, 240, 0, 0, 1], "depth_scale": 1.0}}"#,
            r#"{"intrinsic": {"width": 640, "height": 480, "K": [540, 0, 320, 0, 541, 240, 0, 0, 1]}}"#,
            "cam0:\n  camera_model: pinhole\n  intrinsics: [540.0, 541.0, 320.0, 240.0]\n  resolution: [640, 480]\n",
            "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 540., 0., 320., 0., 541., 240., 0., 0., 1. ]\n",
            "5.4e+02 0.0 3.2e+02\n0.0 5.41e+02 2.4e+02\n0.0 0.0 1.0\n",
            // A projection matrix.
            "[[540, 0, 320, 0], [0, 541, 240, 0], [0, 0, 1, 0]]",
        ];
        for text in texts {
            assert_eq!(camera(text).unwrap().k, K, "{text}");
        }
        assert!(camera("k: [1, 2").is_err());
        let error = camera(r#"{"intrinsic_matrix": [540, 540, 320, 240]}"#).unwrap_err().to_string();
        assert!(error.contains("4 numbers in `intrinsic_matrix`"), "{error}");
        let error = camera(r#"{"focal": 540, "centre": 320}"#).unwrap_err().to_string();
        assert_eq!(error, "no intrinsics found; keys in the file: centre, focal");
        assert_eq!(Camera::read("540, 541,320,240").unwrap().k, K);
        assert_eq!(Camera::read("540,0,320,0,541,240,0,0,1").unwrap().k, K);
        assert_eq!(file("540,541,320,240"), None);
        assert_eq!(file("k,1.json"), Some(PathBuf::from("k,1.json")));
    }

    #[test]
    fn the_size_of_the_image_is_compared() {
        let text = r#"{"width": 640, "height": 480, "fx": 600, "fy": 602, "ppx": 320, "ppy": 240}"#;
        let camera = camera(text).unwrap();
        assert!(camera.check_size(640, 480).is_ok());
        let error = camera.check_size(320, 240).unwrap_err().to_string();
        let advice = "if the image was scaled, its intrinsics are 300,301,160,120";
        let expected = "the intrinsics are of images of 640 × 480 pixels, the image has 320 × 240; ";
        assert_eq!(error, format!("{expected}{advice}"));
        assert!(camera.check_size(640, 400).unwrap_err().to_string().contains("if the image was cropped"));
    }

    #[test]
    fn the_depth_scale_of_the_file_is_in_metres() {
        for (text, expected) in [("0.0005", 0.0005), ("1.0", 0.001), ("0.1", 0.0001), ("5000", 0.0002), ("1000", 0.001)]
        {
            let text = format!(r#"{{"cam_K": {K:?}, "depth_scale": {text}}}"#);
            let scale = camera(&text).unwrap().depth_scale.unwrap();
            assert!((scale - expected).abs() < 1e-12, "{text}");
        }
        assert!(camera(&format!(r#"{{"cam_K": {K:?}, "depth_scale": 0}}"#)).is_err());
    }

    #[test]
    fn cropped_and_binned_images_have_their_own_intrinsics() {
        let roi = "roi:\n  x_offset: 20\n  y_offset: 40\n  width: 600\n  height: 400\n";
        let text = format!("width: 640\nheight: 480\nbinning_x: 2\nbinning_y: 2\nk: {K:?}\n{roi}");
        let camera = camera(&text).unwrap();
        assert_eq!(camera.size, Some([300, 200]));
        assert_eq!(camera.k, [270.0, 0.0, 149.75, 0.0, 270.5, 99.75, 0.0, 0.0, 1.0]);
    }
}
