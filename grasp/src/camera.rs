use thiserror::Error;

/// A pinhole camera: pixels, with pixel centres at whole numbers. Optical axes: z forward, x right, y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point along u, pixels.
    pub cx: f64,
    /// Principal point along v, pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// The camera of the benchmark: 640×480, f = 540.
    pub const BENCHMARK: Self = Self { width: 640, height: 480, fx: 540.0, fy: 540.0, cx: 320.0, cy: 240.0 };
}

/// A depth image: metres along the optical axis, row by row; 0, negative or NaN where there is no reading.
#[derive(Clone, Debug)]
pub struct DepthImage<'a> {
    intrinsics: Intrinsics,
    depth: &'a [f32],
}

/// Why a depth image was refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CameraError {
    /// The number of pixels does not fit the intrinsics.
    #[error("depth holds {got} pixels, {width}×{height} needs {expected}")]
    Length {
        /// Pixels that came.
        got: usize,
        /// Pixels needed.
        expected: usize,
        /// Image width.
        width: usize,
        /// Image height.
        height: usize,
    },
    /// A focal length is not positive or a number is not finite.
    #[error("{name} is {value}, must be a finite number of pixels{bound}", bound = if *.positive { " above 0" } else { "" })]
    Intrinsics {
        /// Which number.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Whether it must be positive.
        positive: bool,
    },
}

impl<'a> DepthImage<'a> {
    /// Checks that the image and the intrinsics fit each other.
    ///
    /// # Errors
    /// [`CameraError`] names what does not fit.
    pub fn new(intrinsics: Intrinsics, depth: &'a [f32]) -> Result<Self, CameraError> {
        let Intrinsics { width, height, fx, fy, cx, cy } = intrinsics;
        for (name, value, positive) in [("fx", fx, true), ("fy", fy, true), ("cx", cx, false), ("cy", cy, false)] {
            if !value.is_finite() || (positive && value <= 0.0) {
                return Err(CameraError::Intrinsics { name, value, positive });
            }
        }
        let expected = width * height;
        if depth.len() != expected || expected == 0 {
            return Err(CameraError::Length { got: depth.len(), expected, width, height });
        }
        Ok(Self { intrinsics, depth })
    }

    /// The camera's intrinsics.
    #[must_use]
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The pixels, row by row.
    #[must_use]
    pub fn depth(&self) -> &[f32] {
        self.depth
    }
}
