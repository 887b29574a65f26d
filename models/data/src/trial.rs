use grasp::Grasp;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// Turns of the hand about its approach at which a point is tried, evenly over half a turn, after which it is the same.
pub const TURNS: usize = 5;

/// Where [`Trial::clearance`] is capped, metres: more room than this makes a grasp no safer.
pub const MAX_CLEARANCE: f32 = 0.02;

/// A grasp that was tried, in the volume's frame, lengths in voxels but for the clearance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// Where, in voxels (position / voxel size, not rounded).
    pub position: Point3<f64>,
    /// Orientation of the grasp frame.
    pub rotation: UnitQuaternion<f64>,
    /// Opening, voxels; meaningful for successes only.
    pub width: f64,
    /// Whether it held.
    pub success: bool,
    /// Of a success: which turns about its approach held too, bit k for k/[`TURNS`] of half a turn, from 1 on. None in the
    /// forms of VGN and GIGA, which do not say.
    pub turns: u8,
    /// The share of the tries that held, in [0, 1]. Where the first held, it was tried again with small errors of its pose,
    /// and is a success if it nearly always held. Of a grasp that was tried once 1 or 0.
    pub share: f32,
    /// The smallest distance between the open hand on its way to the grasp and the objects, up to [`MAX_CLEARANCE`]; 0
    /// where it is not known, or the hand touches something. In metres in every form, for it is of the hand and the
    /// objects, whatever a voxel measures.
    pub clearance: f32,
}

impl Trial {
    /// A grasp in the volume's frame (metres), in voxels of `voxel_size` metres, of which nothing more is known: none of its
    /// turns, no other tries, no clearance.
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

    /// The rotations that held: its own and those [turned](Self::turns) about its approach.
    pub fn rotations(&self) -> impl Iterator<Item = UnitQuaternion<f64>> {
        let turn = |k: usize| {
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), k as f64 * std::f64::consts::PI / TURNS as f64)
        };
        let (own, turns) = (self.rotation, self.turns);
        (0..TURNS).filter(move |&k| k == 0 || turns & (1 << k) != 0).map(move |k| own * turn(k))
    }

    /// The grasp in metres; its quality is 1 for a success and 0 for a failure.
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
