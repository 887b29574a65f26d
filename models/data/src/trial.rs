use grasp::Grasp;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// Number of yaws at which a point is tried, evenly over half a turn. After half a turn the hand is the same.
pub const TURNS: usize = 5;

/// Upper limit of [`Trial::clearance`], metres. A larger distance does not make a grasp safer.
pub const MAX_CLEARANCE: f32 = 0.02;

/// A tried grasp in the frame of the volume. Lengths are in voxels, except the clearance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// Position in voxels (position / voxel size, not rounded).
    pub position: Point3<f64>,
    /// Orientation of the grasp frame.
    pub rotation: UnitQuaternion<f64>,
    /// Opening, voxels; defined for successes only.
    pub width: f64,
    /// Whether the grasp succeeded.
    pub success: bool,
    /// For a success, the other yaws that succeeded too: bit k stands for k/[`TURNS`] of half a turn, from k = 1. 0 in
    /// the formats of VGN and GIGA, which do not store yaws.
    pub turns: u8,
    /// Fraction of successful tries, in [0, 1]. A grasp whose first try succeeds is repeated with small pose errors,
    /// and counts as a success if nearly all tries succeed. For a grasp with a single try it is 1 or 0.
    pub share: f32,
    /// Smallest distance between the open hand on its approach and the objects, at most [`MAX_CLEARANCE`]; 0 if it is
    /// unknown or the hand touches something. In metres in every format, because it does not depend on the voxel size.
    pub clearance: f32,
}

impl Trial {
    /// A trial of `grasp`, given in the volume's frame (metres), converted to voxels of `voxel_size` metres. Its other
    /// yaws, tries and clearance are unknown.
    #[must_use]
    pub fn new(grasp: &Grasp, success: bool, voxel_size: f64) -> Self {
        Self {
            position: Point3::from(grasp.pose.translation.vector / voxel_size),
            rotation: grasp.pose.rotation,
            width: grasp.width / voxel_size,
            success,
            turns: 0,
            share: if success { 1.0 } else { 0.0 },
            clearance: 0.0,
        }
    }

    /// The successful rotations: that of the grasp and its successful [yaws](Self::turns).
    pub fn rotations(&self) -> impl Iterator<Item = UnitQuaternion<f64>> {
        let turn = |k: usize| {
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), k as f64 * std::f64::consts::PI / TURNS as f64)
        };
        let (own, turns) = (self.rotation, self.turns);
        (0..TURNS).filter(move |&k| k == 0 || turns & (1 << k) != 0).map(move |k| own * turn(k))
    }

    /// The grasp in metres. Its quality is 1 for a success and 0 for a failure.
    #[must_use]
    pub fn grasp(&self, voxel_size: f64) -> Grasp {
        let translation = Translation3::from(self.position.coords * voxel_size);
        Grasp {
            pose: Isometry3::from_parts(translation, self.rotation),
            width: self.width * voxel_size,
            quality: if self.success { 1.0 } else { 0.0 },
        }
    }
}
