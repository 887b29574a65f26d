use grasp::RequestError;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::pb;

/// Largest deviation of an orientation's length from 1: room for single precision and for values printed with four
/// digits.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Converts and validates a pose message. Errors name it `field`.
///
/// # Errors
/// [`RequestError`] if a part is absent or not finite, or the orientation is not of unit length.
pub fn pose(pose: &pb::Pose, field: &'static str) -> Result<Isometry3<f64>, RequestError> {
    const FIELDS: PoseFields = PoseFields { position: "position", orientation: "orientation" };
    decode(pose, &FIELDS).map_err(|error| error.inside(field))
}

/// Paths of the parts of a pose in the request.
pub(crate) struct PoseFields {
    pub position: &'static str,
    pub orientation: &'static str,
}

/// The pose as an isometry with a normalised orientation.
pub(crate) fn decode(pose: &pb::Pose, fields: &PoseFields) -> Result<Isometry3<f64>, RequestError> {
    let position = pose.position.ok_or_else(|| RequestError::invalid(fields.position, "absent", "must be given"))?;
    let pb::Vector3 { x, y, z } = position;
    if ![x, y, z].iter().all(|c| c.is_finite()) {
        return Err(RequestError::invalid(fields.position, format_args!("({x}, {y}, {z})"), "must be finite"));
    }
    let translation = Translation3::new(x, y, z);

    let orientation =
        pose.orientation.ok_or_else(|| RequestError::invalid(fields.orientation, "absent", "must be given"))?;
    let pb::Quaternion { x, y, z, w } = orientation;
    let quaternion = Quaternion::new(w, x, y, z);
    let length = quaternion.norm();
    if length.is_nan() || (length - 1.0).abs() > UNIT_TOLERANCE {
        let value = format_args!("(x {x}, y {y}, z {z}, w {w}), of length {length}");
        return Err(RequestError::invalid(fields.orientation, value, "must be of unit length to within 0.001"));
    }
    Ok(Isometry3::from_parts(translation, UnitQuaternion::new_normalize(quaternion)))
}

impl From<&Isometry3<f64>> for pb::Pose {
    fn from(pose: &Isometry3<f64>) -> Self {
        let position = pose.translation.vector;
        let orientation = pose.rotation.coords;
        Self {
            position: Some(pb::Vector3 { x: position.x, y: position.y, z: position.z }),
            orientation: Some(pb::Quaternion {
                x: orientation.x,
                y: orientation.y,
                z: orientation.z,
                w: orientation.w,
            }),
        }
    }
}
