use grasp::Grasp;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};

/// A grasp that was tried, in the volume's frame, lengths in voxels.
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
}

impl Trial {
    /// A grasp in the volume's frame (metres), in voxels of `voxel_size` metres.
    #[must_use]
    pub fn new(grasp: &Grasp, success: bool, voxel_size: f64) -> Self {
        Self {
            position: Point3::from(grasp.pose.translation.vector / voxel_size),
            rotation: grasp.pose.rotation,
            width: grasp.width / voxel_size,
            success,
        }
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
