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
    /// Height and width, as of an array.
    Shape,
    Coefficients,
    /// MATLAB's k1, k2 and possibly k3.
    Radial,
    /// MATLAB's p1 and p2.
    Tangential,
    /// May be a distortion under a name that is not known.
    Doubtful,
    /// One of k1, k2, p1, p2, k3, k4, k5, k6.
    Coefficient(usize),
    DistortionModel,
    /// Names the model of the lens where no other key does.
    CameraModel,
    Fisheye,
    /// Unit of integer depths: metres, millimetres, or units per metre.
    Unit,
    UnitsPerMetre,
    /// May be a unit of depths under a name that is not known.
    UnitLike,
}

/// Keys without case and separators.
pub(super) const NAMES: [(&[&str], Role); 25] = [
    (&["k", "camk", "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx"], Role::Matrix),
    (&["p", "projectionmatrix"], Role::Projection),
    (&["fx", "flx"], Role::Intrinsic(0)),
    (&["fy", "fly"], Role::Intrinsic(1)),
    (&["cx", "ppx", "xoffset"], Role::Intrinsic(2)),
    (&["cy", "ppy", "yoffset"], Role::Intrinsic(3)),
    (
        &[
            "width",
            "imagewidth",
            "imgwidth",
            "imwidth",
            "w",
            "widthpx",
            "framewidth",
            "sensorwidth",
            "cols",
            "columns",
            "ncols",
            "numcols",
            "imagecols",
            "resx",
            "xres",
            "resolutionx",
        ],
        Role::Edge(0),
    ),
    (
        &[
            "height",
            "imageheight",
            "imgheight",
            "imheight",
            "h",
            "heightpx",
            "frameheight",
            "sensorheight",
            "rows",
            "nrows",
            "numrows",
            "imagerows",
            "resy",
            "yres",
            "resolutiony",
        ],
        Role::Edge(1),
    ),
    (
        &[
            "imagesize",
            "imgsize",
            "imsize",
            "framesize",
            "size",
            "resolution",
            "imageresolution",
            "imgres",
            "res",
            "sensorresolution",
            "depthresolution",
        ],
        Role::Size,
    ),
    (&["shape", "imageshape", "imgshape", "frameshape"], Role::Shape),
    (&["distortionmodel", "distortiontype", "distmodel", "disttype"], Role::DistortionModel),
    (
        &["d", "coeffs", "coefficients", "coeff", "coefs", "coef", "lensdistortion", "cameradistortion"],
        Role::Coefficients,
    ),
    (&["radialdistortion", "radial"], Role::Radial),
    (&["tangentialdistortion", "tangential"], Role::Tangential),
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
    } else if has("dist") && !has("distance") || has("radial") || has("tangential") {
        Some(Role::Doubtful)
    } else if has("depth") && has("factor") || name == "pngdepthscale" || has("unitspermet") {
        Some(Role::UnitsPerMetre)
    } else if has("depth") && (has("scal") || has("unit")) {
        Some(Role::Unit)
    } else if is_unit_like(&name) {
        Some(Role::UnitLike)
    } else {
        None
    }
}

fn is_unit_like(name: &str) -> bool {
    let of_depth = ["to", "2"].iter().any(|to| ["m", "mm"].iter().any(|unit| name.ends_with(&format!("{to}{unit}"))));
    ["unit", "units", "zscale", "zunit", "zfactor", "scalefactor"].contains(&name)
        || name.contains("perunit")
        || name.contains("depth") && (of_depth || name.contains("step") || name.contains("lsb"))
}

/// Whether a key counts rows or columns, which matrices and boards also have.
pub(super) fn is_of_grid(key: &str) -> bool {
    let name = plain(key);
    ["rows", "cols", "columns"].iter().any(|word| name.ends_with(word))
}
