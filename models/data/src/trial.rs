use grasp::Grasp;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// Number of yaws of a trial that differ: k · 36°, k from 0 to 4. The hand is symmetric, so a yaw of 180° is the same
/// grasp.
pub const DISTINCT_YAWS: usize = 5;

/// Upper limit of [`Trial::clearance`], metres. A larger distance does not make a grasp safer.
pub const MAX_CLEARANCE: f32 = 0.02;

/// The trial of a grasp, in the frame of the volume. Lengths are in voxels, except the clearance.
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
    /// For a success, the other yaws that succeeded too: bit k for k · 180° / [`DISTINCT_YAWS`], from k = 1. 0 in the
    /// formats of VGN and GIGA, which do not store yaws.
    pub yaws: u8,
    /// Share of successful executions, in [0, 1]. A grasp whose first execution succeeds is repeated with small pose
    /// errors, and is a success if nearly all executions succeed. With a single execution the share is 1 or 0. Of the
    /// grasps of a planner (`grasp-sim proposals`), which are executed once, it is also 1 for failures that touched
    /// something on the approach and then lifted an object.
    pub share: f32,
    /// Smallest distance between the open hand on its approach and the objects, metres, at most [`MAX_CLEARANCE`]. 0 if
    /// it is unknown or the hand touches something.
    pub clearance: f32,
}

impl Trial {
    /// The trial of `grasp`, which is in the volume's frame in metres. `voxel_size` is in metres. The trial has no other
    /// yaws, one execution, and an unknown clearance.
    #[must_use]
    pub fn new(grasp: &Grasp, success: bool, voxel_size: f64) -> Self {
        Self {
            position: Point3::from(grasp.pose.translation.vector / voxel_size),
            rotation: grasp.pose.rotation,
            width: grasp.width / voxel_size,
            success,
            yaws: 0,
            share: if success { 1.0 } else { 0.0 },
            clearance: 0.0,
        }
    }

    /// The valid rotations: that of the grasp, and those of the other successful [yaws](Self::yaws).
    pub fn rotations(&self) -> impl Iterator<Item = UnitQuaternion<f64>> {
        let about_approach = |k: usize| {
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), k as f64 * std::f64::consts::PI / DISTINCT_YAWS as f64)
        };
        let (own, yaws) = (self.rotation, self.yaws);
        (0..DISTINCT_YAWS).filter(move |&k| k == 0 || yaws & (1 << k) != 0).map(move |k| own * about_approach(k))
    }

    /// The grasp in metres; `voxel_size` is in metres. Its quality is 1 for a success and 0 for a failure.
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
