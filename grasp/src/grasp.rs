use nalgebra::Isometry3;

/// Largest opening of the Panda hand, metres.
pub const MAX_OPENING: f64 = 0.08;

/// Length of the Panda's fingers, metres: from the origin of the grasp frame (finger base) to the fingertips, along +z.
pub const FINGER_DEPTH: f64 = 0.05;

/// A 6-DoF parallel-jaw grasp.
///
/// The grasp frame: z is the approach direction, the fingers close along ±y, the origin is at the finger base. The
/// fingertips lie [`FINGER_DEPTH`] further along +z. A rotation by 180° about z gives the same grasp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grasp {
    /// `T_frame_grasp`.
    pub pose: Isometry3<f64>,
    /// Opening between the fingers, metres.
    pub width: f64,
    /// Predicted probability of success, in [0, 1].
    pub quality: f32,
}
