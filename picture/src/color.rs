//! Colours: sRGB, linear light, and the colours of objects and qualities.

use nalgebra::Vector3;

/// A colour: red, green and blue in sRGB, 0–255.
pub type Color = [u8; 3];

pub(crate) const PAPER: Color = [246, 246, 244];
pub(crate) const TABLE_TOP: Color = [226, 224, 220];
pub(crate) const GRID: Color = [196, 194, 190];
const PALETTE: [Color; 12] = [
    [214, 96, 77],
    [67, 133, 190],
    [240, 178, 66],
    [90, 160, 108],
    [150, 116, 180],
    [232, 140, 100],
    [88, 178, 190],
    [222, 200, 150],
    [190, 90, 120],
    [120, 140, 90],
    [236, 236, 230],
    [110, 122, 150],
];

/// The colour of object `index` of a scene.
pub fn object_color(index: usize) -> Color {
    PALETTE[index % PALETTE.len()]
}

/// The colour of a quality: red at 0, yellow at 0.5, green at 1.
pub fn quality_color(quality: f64) -> Color {
    let q = quality.clamp(0.0, 1.0);
    let mix = |low: f64, high: f64, t: f64| (low + (high - low) * t) as u8;
    let (red, yellow, green) = ([205.0, 40.0, 40.0], [245.0, 195.0, 50.0], [40.0, 165.0, 75.0]);
    let (from, to, t) = if q < 0.5 { (red, yellow, 2.0 * q) } else { (yellow, green, 2.0 * q - 1.0) };
    std::array::from_fn(|i| mix(from[i], to[i], t))
}

/// Converts sRGB to linear light.
pub(crate) fn linear(color: Color) -> Vector3<f64> {
    Vector3::from(color.map(|c| (f64::from(c) / 255.0).powf(2.2)))
}

/// Converts linear light to sRGB.
pub(crate) fn srgb(light: Vector3<f64>) -> Color {
    light.map(|x| (x.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quality_goes_from_red_to_green() {
        assert!(quality_color(0.0)[0] > quality_color(0.0)[1]);
        assert!(quality_color(1.0)[1] > quality_color(1.0)[0]);
        assert_eq!(quality_color(7.0), quality_color(1.0));
    }
}
