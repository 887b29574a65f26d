//! Distortion of lenses, with the models of OpenCV and ROS.

use std::fmt::{self, Display, Formatter};

use anyhow::{bail, ensure};

use crate::document::plain;

/// Names of the polynomial model and of OpenCV's fisheye, without separators.
const POLYNOMIAL: [&str; 8] =
    ["plumbbob", "rationalpolynomial", "thinprism", "radtan", "radialtangential", "brownconrady", "pinhole", "opencv"];
const FISHEYE: [&str; 4] = ["equidistant", "fisheye", "kannalabrandt4", "opencvfisheye"];

pub(crate) fn is_fisheye(model: &str) -> bool {
    FISHEYE.contains(&plain(model).as_str())
}

/// Whether a text names a model of a lens.
pub(crate) fn is_model(text: &str) -> bool {
    is_fisheye(text) || POLYNOMIAL.contains(&plain(text).as_str())
}

/// How a lens moves the points of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Distortion {
    /// `plumb_bob` (4 or 5 coefficients), `rational_polynomial` (8) and its form with thin prisms (12):
    /// k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.
    Polynomial([f64; 12]),
    /// `equidistant` (OpenCV's fisheye): k1, k2, k3, k4.
    Equidistant([f64; 4]),
}

impl Display for Distortion {
    fn fmt(&self, f: &mut Formatter) -> fmt::Result {
        let (model, coefficients) = match self {
            Self::Equidistant(coefficients) => ("equidistant", &coefficients[..]),
            Self::Polynomial(all) if all[5..] == [0.0; 7] => ("plumb_bob", &all[..5]),
            Self::Polynomial(all) if all[8..] == [0.0; 4] => ("rational_polynomial", &all[..8]),
            Self::Polynomial(all) => ("thin_prism", &all[..]),
        };
        let numbers: Vec<String> = coefficients.iter().map(ToString::to_string).collect();
        write!(f, "{model} ({})", numbers.join(", "))
    }
}

impl Distortion {
    /// The distortion with these coefficients; None if all are 0.
    pub fn new(model: Option<&str>, coefficients: &[f64]) -> anyhow::Result<Option<Self>> {
        if coefficients.iter().all(|&coefficient| coefficient == 0.0) {
            return Ok(None);
        }
        ensure!(coefficients.iter().all(|c| c.is_finite()), "the distortion coefficients must be finite");
        let model = model.unwrap_or("plumb_bob").to_lowercase().replace([' ', '-'], "_");
        match (coefficients, coefficients.len()) {
            (&[k1, k2, k3, k4], _) if is_fisheye(&model) => Ok(Some(Self::Equidistant([k1, k2, k3, k4]))),
            (_, 4 | 5 | 8 | 12) if POLYNOMIAL.contains(&plain(&model).as_str()) => {
                Ok(Some(Self::Polynomial(std::array::from_fn(|i| coefficients.get(i).copied().unwrap_or(0.0)))))
            }
            _ => bail!(
                "distortion `{model}` with {} coefficients is not supported: rectify the image, and give the intrinsics \
                 of the rectified one without distortion",
                coefficients.len()
            ),
        }
    }

    /// Where the lens shows the point that a pinhole camera shows at (x, y), both for a focal length of 1.
    fn distorted(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        match *self {
            Self::Polynomial([k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4]) => {
                let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
                let prism = |a: f64, b: f64| r2 * (a + r2 * b);
                (
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + prism(s1, s2),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + prism(s3, s4),
                )
            }
            Self::Equidistant([k1, k2, k3, k4]) => {
                let r = r2.sqrt();
                let theta = r.atan();
                let t2 = theta * theta;
                let bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                let scale = if r > 1e-9 { bent / r } else { 1.0 };
                (x * scale, y * scale)
            }
        }
    }

    /// The image of a pinhole camera with the matrix `k`, from the image of this lens. Each pixel has the value of the
    /// nearest one, so that depths are not mixed over edges; `T::default()` outside of the image.
    pub fn rectified<T: Copy + Default>(&self, values: &[T], width: u32, height: u32, k: &[f64; 9]) -> Vec<T> {
        let [fx, _, cx, _, fy, cy, ..] = *k;
        let pixel = |index: usize| {
            let (u, v) = ((index % width as usize) as f64, (index / width as usize) as f64);
            let (x, y) = self.distorted((u - cx) / fx, (v - cy) / fy);
            let (u, v) = ((fx * x + cx).round(), (fy * y + cy).round());
            let is_inside = (0.0..f64::from(width)).contains(&u) && (0.0..f64::from(height)).contains(&v);
            if is_inside { values[v as usize * width as usize + u as usize] } else { T::default() }
        };
        (0..values.len()).map(pixel).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_where_opencv_shows_them() {
        let close = |(x, y): (f64, f64), expected: (f64, f64)| {
            assert!((x - expected.0).abs() < 1e-9 && (y - expected.1).abs() < 1e-9, "({x}, {y})");
        };
        let new = |model, coefficients: &[f64]| Distortion::new(Some(model), coefficients).unwrap().unwrap();
        // By hand from OpenCV's formulas, at (0.3, -0.2).
        let plumb_bob = new("plumb_bob", &[-0.28, 0.09, 0.001, -0.002, 0.01]);
        let radial = 1.0 - 0.28 * 0.13 + 0.09 * 0.0169 + 0.01 * 0.002197;
        let (x, y) =
            (0.3 * radial + 2.0 * 0.001 * -0.06 - 0.002 * (0.13 + 0.18), -0.2 * radial + 0.001 * 0.21 + 0.004 * 0.06);
        close(plumb_bob.distorted(0.3, -0.2), (x, y));
        let fisheye = new("equidistant", &[0.02, -0.01, 0.003, -0.0005]);
        let (r, theta) = (0.13_f64.sqrt(), 0.13_f64.sqrt().atan());
        let t2 = theta * theta;
        let bent = theta * (1.0 + 0.02 * t2 - 0.01 * t2 * t2 + 0.003 * t2.powi(3) - 0.0005 * t2.powi(4));
        close(fisheye.distorted(0.3, -0.2), (0.3 * bent / r, -0.2 * bent / r));
        close(fisheye.distorted(0.0, 0.0), (0.0, 0.0));
    }

    #[test]
    fn a_rectified_image_has_the_values_of_the_nearest_pixels() {
        let (width, height, k) = (101, 81, [80.0, 0.0, 50.0, 0.0, 80.0, 40.0, 0.0, 0.0, 1.0]);
        let distortion = Distortion::new(None, &[-0.3, 0.1, 0.0, 0.0, 0.0]).unwrap().unwrap();
        let columns: Vec<u16> = (0..width * height).map(|index| (index % width) as u16).collect();
        let rectified = distortion.rectified(&columns, width, height, &k);
        assert_eq!(rectified[(40 * width + 50) as usize], 50, "the centre stays");
        let expected = (80.0 * distortion.distorted(40.0 / 80.0, 0.0).0 + 50.0).round() as u16;
        assert_eq!(rectified[(40 * width + 90) as usize], expected);
        assert!(expected < 90, "a barrel shows it nearer to the centre");
    }

    #[test]
    fn models_that_are_not_known_are_refused() {
        assert_eq!(Distortion::new(Some("anything"), &[0.0; 5]).unwrap(), None);
        let error = Distortion::new(Some("Inverse Brown Conrady"), &[0.1, 0.0, 0.0, 0.0, 0.0]).unwrap_err().to_string();
        assert!(
            error.starts_with("distortion `inverse_brown_conrady` with 5 coefficients is not supported"),
            "{error}"
        );
        assert!(Distortion::new(Some("plumb_bob"), &[0.1; 14]).is_err());
        assert!(Distortion::new(None, &[f64::NAN, 0.0, 0.0, 0.0]).is_err());
    }
}
