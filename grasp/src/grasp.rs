use nalgebra::Isometry3;

/// Opening of the Panda hand, metres: no grasp is wider.
pub const MAX_OPENING: f64 = 0.08;

/// Length of the Panda's fingers, metres: from the grasp frame's origin (finger base) to the fingertips, along +z.
pub const FINGER_DEPTH: f64 = 0.05;

/// A 6-DoF parallel-jaw grasp.
///
/// The grasp frame: z = approach, ±y = the axis along which the fingers close, origin = finger base; the fingertips
/// lie [`FINGER_DEPTH`] further along +z. A grasp turned by 180° about its z is the same grasp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grasp {
    /// `T_frame_grasp`.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers, metres.
    pub width: f64,
    /// Predicted probability of success, [0, 1].
    pub quality: f32,
}
