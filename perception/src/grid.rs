use std::borrow::Cow;
use std::f64::consts::PI;

use grasp::{DepthImage, Fusion, RESOLUTION, RequestError, Volume, WORKSPACE_SIZE};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// The grid that a planner reads.
#[derive(Clone, Debug, PartialEq)]
pub struct InputGrid {
    /// Name of the model, for errors.
    pub model: String,
    /// The grid of the network. Planners without one accept cubes of every size, and need the observed points besides the
    /// volume.
    pub network: Option<NetworkGrid>,
    /// Whether the planner reads the [details](Volume::details) of volumes.
    pub reads_details: bool,
}

/// The grid that a network was trained with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetworkGrid {
    /// Voxels along an edge.
    pub resolution: usize,
    /// Edge of a voxel, metres.
    pub voxel_size: f64,
    /// Azimuth of the camera in the grid, degrees, if it was always the same.
    pub camera_azimuth: Option<f64>,
}

impl InputGrid {
    /// Edge of a cube for this grid, metres: the network's, or else `requested`.
    #[must_use]
    pub fn edge(&self, requested: Option<f64>) -> f64 {
        requested.unwrap_or(self.network.map_or(WORKSPACE_SIZE, |network| network.size()))
    }

    /// Checks the requested edge of a cube, metres.
    pub(crate) fn check_size(&self, requested: Option<f64>) -> Result<(), RequestError> {
        match (self.network, requested) {
            (Some(network), Some(size)) if (size - network.size()).abs() > 1e-3 * network.size() => {
                let needed = format_args!("must be {} m (±0.1 %) or 0 for the model {}", network.size(), self.model);
                Err(RequestError::invalid("workspace.size", size, needed))
            }
            _ => Ok(()),
        }
    }
}

impl NetworkGrid {
    /// Edge of the grid, metres.
    fn size(&self) -> f64 {
        self.resolution as f64 * self.voxel_size
    }
}

/// The voxel grid that views are fused into, and its pose.
#[derive(Clone, Debug)]
pub(crate) struct FusionGrid {
    /// Edge of the cube, metres.
    pub size: f64,
    /// The grid of the planner's network.
    network: Option<NetworkGrid>,
    reads_details: bool,
    /// `T_frame_cube`.
    frame_from_cube: Isometry3<f64>,
    /// `T_cube_grid`: for a network trained with the camera on one side, the grid is rotated so that the camera is on
    /// that side.
    cube_from_grid: Isometry3<f64>,
    /// Voxels that are fused around the cube on each side.
    pub padding: usize,
}

/// Distance around a cube in which surfaces are fused, metres: as far as an evaluator and the collision check read around a
/// grasp [`OBJECT_MARGIN`](crate::layout::OBJECT_MARGIN) from the side.
const PADDING: f64 = 0.09;

impl FusionGrid {
    /// The grid that a planner needs for a cube at `frame_from_cube` with an edge of `size` metres. `eyes` are the camera
    /// positions in the frame of the cube, metres. With `is_padded` also what is around the cube is fused.
    pub fn new(
        input: &InputGrid,
        frame_from_cube: Isometry3<f64>,
        size: f64,
        eyes: &[Point3<f64>],
        is_padded: bool,
    ) -> Self {
        let azimuth = input.network.and_then(|network| network.camera_azimuth);
        let cube_from_grid = azimuth.map_or_else(Isometry3::identity, |azimuth| rotated(azimuth, size, eyes));
        let voxel_size = size / resolution(input.network) as f64;
        let padding = if is_padded { (PADDING / voxel_size).ceil().min(MAX_PADDING) as usize } else { 0 };
        Self {
            size,
            network: input.network,
            reads_details: input.reads_details,
            frame_from_cube,
            cube_from_grid,
            padding,
        }
    }

    /// Whether a planner can read this grid.
    pub fn fits(&self, input: &InputGrid) -> bool {
        match (input.network, self.network) {
            (Some(other), Some(own)) => {
                other.resolution == own.resolution
                    && (self.size - other.size()).abs() <= 1e-3 * other.size()
                    && other.camera_azimuth == own.camera_azimuth
            }
            (Some(_), None) => false,
            (None, _) => true,
        }
    }

    /// Whether the grid is rotated in its cube.
    pub fn is_rotated(&self) -> bool {
        self.cube_from_grid != Isometry3::identity()
    }

    /// Whether the planner needs the observed points besides the volume.
    pub fn needs_points(&self) -> bool {
        self.network.is_none()
    }

    /// `T_camera_grid` of a camera with the pose `T_camera_cube`.
    pub fn camera_from_grid(&self, camera_from_cube: &Isometry3<f64>) -> Isometry3<f64> {
        camera_from_cube * self.cube_from_grid * self.grid_from_field()
    }

    /// `T_grid_field`: the field extends beyond the grid by the padding.
    fn grid_from_field(&self) -> Translation3<f64> {
        let offset = -(self.padding as f64) * self.voxel_size();
        Translation3::new(offset, offset, offset)
    }

    fn voxel_size(&self) -> f64 {
        self.size / resolution(self.network) as f64
    }

    /// An empty field of this grid.
    pub fn fusion(&self) -> Fusion {
        Fusion::of_voxels(resolution(self.network) + 2 * self.padding, self.voxel_size())
    }

    /// The volume fused from `views`, images with their `T_camera_field`; `None` if no surface was observed in it. If the
    /// planner reads details, it has those of the views.
    pub fn volume<'a>(&self, fusion: &Fusion, views: &[(Cow<'_, DepthImage<'a>>, Isometry3<f64>)]) -> Option<Volume> {
        let pose = self.frame_from_cube * self.cube_from_grid * self.grid_from_field();
        let has_details = self.reads_details && !views.is_empty();
        // The only error of a field is that it is empty.
        let volume = if has_details { fusion.detailed_volume(pose, views) } else { fusion.volume(pose) }.ok()?;
        if self.padding == 0 { Some(volume) } else { volume.middle(self.padding) }
    }
}

/// Most voxels of padding, which bounds the memory for networks with small voxels.
const MAX_PADDING: f64 = 16.0;

/// Voxels along an edge of the grid that a planner reads.
fn resolution(network: Option<NetworkGrid>) -> usize {
    network.map_or(RESOLUTION, |network| network.resolution)
}

/// Checks that a margin leaves space for grasps in a cube with this edge, metres.
///
/// # Errors
/// [`RequestError`] names the margin.
pub fn check_margin(margin: f64, edge: f64) -> Result<(), RequestError> {
    if 2.0 * margin < edge {
        return Ok(());
    }
    let needed = format_args!("must be below {} m, half of the cube's edge", edge / 2.0);
    Err(RequestError::invalid("options.margin", margin, needed))
}

/// `T_cube_grid` of a cube of `size` metres, rotated about its vertical axis so that the mean azimuth of `cameras` in
/// the grid is `azimuth`, degrees. The identity if the cameras surround the workspace.
fn rotated(azimuth: f64, size: f64, cameras: &[Point3<f64>]) -> Isometry3<f64> {
    /// Smallest length of the mean of the unit directions at which the cameras count as being on one side.
    const ONE_SIDED: f64 = 0.5;
    let middle = Vector3::new(size / 2.0, size / 2.0, 0.0);
    let directions = cameras.iter().filter_map(|camera| (camera.coords - middle).xy().try_normalize(1e-9));
    let sum: nalgebra::Vector2<f64> = directions.sum();
    if sum.norm() < ONE_SIDED * cameras.len() as f64 {
        return Isometry3::identity();
    }
    let turn = sum.y.atan2(sum.x) - azimuth * PI / 180.0;
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
    Isometry3::from_parts(Translation3::from(middle - rotation * middle), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_rotated_to_the_camera_azimuth_of_the_training() {
        let camera = Point3::new(0.15, -0.45, 0.4);
        for (azimuth, expected) in [(-90.0, 0.0), (0.0, -90.0), (90.0, 180.0)] {
            let cube_from_grid = rotated(azimuth, 0.3, &[camera]);
            let in_grid = cube_from_grid.inverse() * camera;
            let actual = (in_grid.y - 0.15).atan2(in_grid.x - 0.15) * 180.0 / PI;
            assert!((actual - azimuth).rem_euclid(360.0).min((azimuth - actual).rem_euclid(360.0)) < 1e-6, "{actual}");
            assert!((cube_from_grid.rotation.angle() * 180.0 / PI - f64::abs(expected)).abs() < 1e-6);
            let centre = Point3::new(0.15, 0.15, 0.1);
            assert!((cube_from_grid * centre - centre).norm() < 1e-12, "the rotation is about the grid's own axis");
        }
        let around = [Point3::new(0.65, 0.15, 0.4), Point3::new(-0.35, 0.15, 0.4)];
        assert_eq!(rotated(0.0, 0.3, &around), Isometry3::identity());
    }
}
