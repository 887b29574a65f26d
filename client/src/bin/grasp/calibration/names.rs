//! Names of what tools say about a camera.

use crate::document::plain;

/// What a key says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// Nine numbers, twelve of a projection matrix, or fx, fy, cx, cy.
    Matrix,
    /// A projection matrix, which counts if there is no other.
    Projection,
    /// One of fx, fy, cx, cy.
    Intrinsic(usize),
    /// Width or height.
    Edge(usize),
    /// Width and height.
    Size,
    Coefficients,
    /// One of k1, k2, p1, p2, k3, k4, k5, k6.
    Coefficient(usize),
    DistortionModel,
    /// Names the model of the lens where no other key does.
    CameraModel,
    Fisheye,
    /// Unit of integer depths: metres, millimetres, or units per metre.
    Unit,
    UnitsPerMetre,
}

/// Keys without case and separators.
pub(super) const NAMES: [(&[&str], Role); 22] = [
    (&["k", "camk", "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx"], Role::Matrix),
    (&["p", "projectionmatrix"], Role::Projection),
    (&["fx", "flx"], Role::Intrinsic(0)),
    (&["fy", "fly"], Role::Intrinsic(1)),
    (&["cx", "ppx", "xoffset"], Role::Intrinsic(2)),
    (&["cy", "ppy", "yoffset"], Role::Intrinsic(3)),
    (&["width", "imagewidth", "imgwidth", "imwidth", "w"], Role::Edge(0)),
    (&["height", "imageheight", "imgheight", "imheight", "h"], Role::Edge(1)),
    (&["imagesize", "imgsize", "imsize", "resolution", "imageresolution", "size"], Role::Size),
    (&["distortionmodel", "distortiontype", "distmodel", "disttype"], Role::DistortionModel),
    (&["d", "coeffs", "coefficients"], Role::Coefficients),
    (&["k1"], Role::Coefficient(0)),
    (&["k2"], Role::Coefficient(1)),
    (&["p1"], Role::Coefficient(2)),
    (&["p2"], Role::Coefficient(3)),
    (&["k3"], Role::Coefficient(4)),
    (&["k4"], Role::Coefficient(5)),
    (&["k5"], Role::Coefficient(6)),
    (&["k6"], Role::Coefficient(7)),
    (&["model", "cameramodel", "lensmodel"], Role::CameraModel),
    (&["fisheye", "isfisheye"], Role::Fisheye),
    (&["scale"], Role::Unit),
];

pub(super) fn role(key: &str) -> Option<Role> {
    let name = plain(key);
    if let Some((_, role)) = NAMES.iter().find(|(names, _)| names.contains(&name.as_str())) {
        return Some(*role);
    }
    let has = |part: &str| name.contains(part);
    if name.starts_with("dist") && !name.starts_with("distance") || name.starts_with("kc") {
        Some(Role::Coefficients)
    } else if has("depth") && has("factor") || name == "pngdepthscale" {
        Some(Role::UnitsPerMetre)
    } else if has("depth") && (has("scal") || has("unit")) {
        Some(Role::Unit)
    } else {
        None
    }
}
