//! Cameras from files, or from numbers on the command line.

use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use grasp_client::{Depth, DepthView, Extrinsics};
use serde_json::{Map, Value};

use crate::calibration;
use crate::distortion::Distortion;
use crate::document::{document, number};
use crate::files::{Purpose, in_file};
use crate::image::{self, Scale};
use crate::labels::Labels;
use crate::notes::note;
use crate::numbers::{Numbers, mistyped};

/// What a file says about a camera.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Camera {
    /// The intrinsic matrix, row by row.
    pub k: [f64; 9],
    /// Width and height of the images, pixels.
    pub size: [Option<u32>; 2],
    /// Distortion of the lens; None if there is none.
    pub distortion: Option<Distortion>,
    /// Unit of integer depths, metres.
    pub depth_scale: Option<f64>,
    /// How many pixels of the sensor one of the image combines, along x and y.
    pub binning: [u32; 2],
}

impl From<[f64; 9]> for Camera {
    fn from(k: [f64; 9]) -> Self {
        Self { k, size: [None; 2], distortion: None, depth_scale: None, binning: [1; 2] }
    }
}

impl Camera {
    /// FX,FY,CX,CY, nine numbers, or a file. `rectified`: the images are rectified already.
    pub fn read(text: &str, rectified: bool) -> anyhow::Result<Self> {
        if let Ok(Numbers([fx, fy, cx, cy])) = text.parse::<Numbers<4>>() {
            return Ok(matrix(fx, fy, cx, cy).into());
        }
        if let Ok(Numbers(k)) = text.parse::<Numbers<9>>() {
            return Ok(k.into());
        }
        if let Some(reason) = mistyped(text) {
            bail!("--intrinsics {text}: {reason}; must be a file, the numbers FX,FY,CX,CY, or the nine of the matrix");
        }
        in_file(Path::new(text), |path| {
            let camera = calibration::camera(&document(path, Purpose::Intrinsics)?, rectified)?;
            if let Some(lens) = &camera.distortion {
                note(format_args!(
                    "images of this camera are rectified with {lens}; if they are rectified already, as those of \
                     image_rect, add --rectified"
                ));
            }
            Ok(camera)
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
        let image = [width, height].map(f64::from);
        let own = self.size.map(|edge| edge.map(f64::from));
        let Some(axis) = (0..2).find(|&axis| own[axis].is_some_and(|edge| edge != image[axis])) else { return Ok(()) };
        let scale = image[axis] / own[axis].unwrap_or(image[axis]);
        // Rounded sizes of a scaled image differ by a pixel.
        let is_scaled = (0..2).all(|axis| own[axis].is_none_or(|edge| (scale * edge - image[axis]).abs() <= 1.0));
        let binned = |axis: usize| own[axis].is_none_or(|edge| edge * f64::from(self.binning[axis]) == image[axis]);
        let [w, h] = own.map(|edge| edge.map_or("?".to_owned(), |edge| edge.to_string()));
        let advice = if self.binning != [1; 2] && (0..2).all(binned) {
            let [x, y] = self.binning;
            format!("the file has a binning of {x} × {y}; if the image is not binned, set binning_x and binning_y to 1")
        } else if own == [Some(image[1]), Some(image[0])] {
            "width and height are exchanged: correct them in the file, or give the image as the camera sees it, not rotated"
                .to_owned()
        } else if is_scaled {
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

pub(crate) fn matrix(fx: f64, fy: f64, cx: f64, cy: f64) -> [f64; 9] {
    [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
}

/// The matrix of fx, fy, cx, cy, of nine numbers, row by row, or of the twelve of a projection matrix without a translation.
pub(crate) fn of_numbers(numbers: &[f64]) -> anyhow::Result<[f64; 9]> {
    match *numbers {
        [fx, fy, cx, cy] => Ok(matrix(fx, fy, cx, cy)),
        // Open3D has the columns one after the other.
        [a, b, 0.0, d, e, 0.0, g, h, i] if [g, h] != [0.0; 2] => Ok([a, d, g, b, e, h, 0.0, 0.0, i]),
        [a, b, c, d, e, f, g, h, i] => Ok([a, b, c, d, e, f, g, h, i]),
        [a, b, c, tx, d, e, f, ty, g, h, i, tz] => {
            ensure!([tx, ty, tz] == [0.0; 3], "the fourth column of the 3×4 matrix is {tx}, {ty}, {tz}, must be 0");
            Ok([a, b, c, d, e, f, g, h, i])
        }
        _ => bail!("{} numbers; an intrinsic matrix has nine, row by row", numbers.len()),
    }
}

/// The camera of the images that ROS sends if it crops them (`roi`) and then combines pixels (`binning`): CameraInfo
/// has the intrinsics of the whole sensor.
pub(crate) fn windowed(camera: Camera, map: &Map<String, Value>) -> Camera {
    let of_roi = |key: &str| map.get("roi").and_then(|roi| number(roi.get(key)?)).unwrap_or(0.0);
    let binning = ["binning_x", "binning_y"].map(|key| map.get(key).and_then(number).unwrap_or(0.0).max(1.0));
    let offset = ["x_offset", "y_offset"].map(of_roi);
    let cropped = ["width", "height"].map(of_roi);
    if binning == [1.0; 2] && offset == [0.0; 2] && cropped == [0.0; 2] {
        return camera;
    }
    let [fx, _, cx, _, fy, cy, ..] = camera.k;
    // Pixel centres are at whole numbers.
    let centre = |c: f64, axis: usize| (c - offset[axis] + 0.5) / binning[axis] - 0.5;
    let k = matrix(fx / binning[0], fy / binning[1], centre(cx, 0), centre(cy, 1));
    let size = std::array::from_fn(|axis| {
        let edge = camera.size[axis].map(f64::from)?;
        Some((if cropped[axis] > 0.0 { cropped[axis] } else { edge } / binning[axis]) as u32)
    });
    Camera { k, size, binning: binning.map(|bins| bins as u32), ..camera }
}

#[cfg(test)]
mod tests {
    use npyz::WriterBuilder;

    use super::*;

    const K: [f64; 9] = [540.0, 0.0, 320.0, 0.0, 541.0, 240.0, 0.0, 0.0, 1.0];

    #[test]
    fn intrinsics_are_numbers_or_files() {
        assert_eq!(Camera::read("540, 541,320,240", false).unwrap().k, K);
        assert_eq!(Camera::read("540,0,320,0,541,240,0,0,1", false).unwrap().k, K);
        assert_eq!(file("540,541,320,240"), None);
        assert_eq!(file("k,1.json"), Some(PathBuf::from("k,1.json")));
    }

    #[test]
    fn arrays_are_read_with_all_that_they_have() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        let mut npz = npyz::npz::NpzWriter::create(path("all.npz")).unwrap();
        let mtx = npz.array("mtx", Default::default()).unwrap();
        let mut writer = mtx.default_dtype().shape(&[3, 3]).begin_nd().unwrap();
        writer.extend(K.map(|number| number as i32)).unwrap();
        writer.finish().unwrap();
        let lens = [0.1, 0.0, 0.0, 0.0, 0.0];
        for (name, numbers) in [("dist", &lens[..]), ("depth_scale", &[0.0005]), ("w", &[640.0]), ("h", &[480.0])] {
            let array = npz.array(name, Default::default()).unwrap();
            let mut writer = array.default_dtype().shape(&[numbers.len() as u64]).begin_nd().unwrap();
            writer.extend(numbers.iter().copied()).unwrap();
            writer.finish().unwrap();
        }
        drop(npz);
        let camera = Camera::read(&path("all.npz"), false).unwrap();
        let distortion = Distortion::new(None, &lens).unwrap();
        let expected =
            Camera { k: K, size: [Some(640), Some(480)], distortion, depth_scale: Some(0.0005), binning: [1; 2] };
        assert_eq!(camera, expected);
    }

    #[test]
    fn the_size_of_the_image_is_compared() {
        let k = [600.0, 0.0, 320.0, 0.0, 602.0, 240.0, 0.0, 0.0, 1.0];
        let camera = Camera { size: [Some(640), Some(480)], ..Camera::from(k) };
        assert!(camera.check_size(640, 480).is_ok());
        let error = camera.check_size(320, 240).unwrap_err().to_string();
        let advice = "if the image was scaled, its intrinsics are 300,301,160,120";
        let expected = "the intrinsics are of images of 640 × 480 pixels, the image has 320 × 240; ";
        assert_eq!(error, format!("{expected}{advice}"));
        let exchanged = camera.check_size(480, 640).unwrap_err().to_string();
        assert!(exchanged.contains("width and height are exchanged: correct them in the file"), "{exchanged}");
        let binned = Camera { size: [Some(320), Some(240)], binning: [2; 2], ..camera.clone() };
        let error = binned.check_size(640, 480).unwrap_err().to_string();
        assert!(error.contains("has a binning of 2 × 2; if the image is not binned, set binning_x"), "{error}");
        assert!(camera.check_size(640, 400).unwrap_err().to_string().contains("if the image was cropped"));
        let of_width = Camera { size: [Some(640), None], ..camera };
        assert!(of_width.check_size(640, 400).is_ok());
        assert!(of_width.check_size(320, 240).unwrap_err().to_string().contains("640 × ? pixels"));
    }
}
