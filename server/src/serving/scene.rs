use std::f64::consts::PI;
use std::fmt::Display;

use grasp::{Fusion, RESOLUTION, SurfacePoint, Volume, WORKSPACE_SIZE};
use grasp_models::Metadata;
use grasp_planner::Source;
use grasp_proto::FieldError;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// The voxel grid that views are fused into, and its pose.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FusionGrid {
    resolution: usize,
    size: f64,
    /// `T_frame_cube`.
    frame_from_cube: Isometry3<f64>,
    /// `T_cube_grid`: for a network trained with the camera on one side, the grid is rotated so that the camera is on
    /// that side.
    cube_from_grid: Isometry3<f64>,
    /// Azimuth of the camera in the grid, degrees, if the network was trained with a fixed one.
    azimuth: Option<f64>,
    /// Whether the planner has a network. Planners without one need the observed points besides the volume.
    is_of_network: bool,
}

impl FusionGrid {
    /// The grid that a planner requires for a cube at `frame_from_cube` with an edge of `size` metres. `cameras` are the
    /// camera positions in the frame of the cube, metres.
    pub fn of(
        source: &Source,
        frame_from_cube: &Isometry3<f64>,
        size: Option<f64>,
        cameras: &[Point3<f64>],
    ) -> Result<Self, FieldError> {
        let frame_from_cube = *frame_from_cube;
        let Some(network) = source.network() else {
            let size = size.unwrap_or(WORKSPACE_SIZE);
            let cube_from_grid = Isometry3::identity();
            return Ok(Self {
                resolution: RESOLUTION,
                size,
                frame_from_cube,
                cube_from_grid,
                azimuth: None,
                is_of_network: false,
            });
        };
        let resolution = network.metadata.resolution;
        let trained = resolution as f64 * network.metadata.voxel_size;
        if let Some(size) = size
            && (size - trained).abs() > 1e-3 * trained
        {
            let needed = format_args!("must be {trained} m (±0.1 %) or 0 for the model {}", source.name());
            return Err(FieldError::new("workspace.size", size, needed));
        }
        let azimuth = network.metadata.camera_azimuth;
        let cube_from_grid = azimuth.map_or_else(Isometry3::identity, |azimuth| rotated(azimuth, trained, cameras));
        Ok(Self { resolution, size: trained, frame_from_cube, cube_from_grid, azimuth, is_of_network: true })
    }

    /// Checks that a planner can use this grid.
    pub fn check(&self, source: &Source) -> Result<(), FieldError> {
        match source.network().map(|entry| &entry.metadata) {
            Some(network) if !self.fits(network) => {
                let value = format_args!("`{}`", source.name());
                let needed =
                    "which requires a different grid than the stream's volume; send a workspace to start a new one";
                Err(FieldError::new("options.model", value, needed))
            }
            _ => Ok(()),
        }
    }

    fn fits(&self, network: &Metadata) -> bool {
        let trained = network.resolution as f64 * network.voxel_size;
        network.resolution == self.resolution
            && (self.size - trained).abs() <= 1e-3 * trained
            && network.camera_azimuth == self.azimuth
    }

    /// Edge of the cube, metres.
    pub fn size(&self) -> f64 {
        self.size
    }

    /// Whether the grid is rotated in its cube.
    pub fn is_rotated(&self) -> bool {
        self.cube_from_grid != Isometry3::identity()
    }

    /// Whether the planner needs the observed points besides the volume.
    pub fn needs_points(&self) -> bool {
        !self.is_of_network
    }

    /// `T_camera_grid` of a camera with the pose `T_camera_cube`.
    pub fn camera_from_grid(&self, camera_from_cube: &Isometry3<f64>) -> Isometry3<f64> {
        camera_from_cube * self.cube_from_grid
    }

    /// An empty field of this grid.
    pub fn fusion(&self) -> Fusion {
        Fusion::new(self.resolution, self.size)
    }

    /// The fused volume; `None` if no surface was observed.
    pub fn volume(&self, fusion: &Fusion) -> Option<Volume> {
        // The only error of a field is that it is empty.
        fusion.volume(self.frame_from_cube * self.cube_from_grid).ok()
    }
}

/// The error for views that show no surface.
pub(crate) fn empty() -> FieldError {
    let reason = "none shows a surface in the workspace; check workspace.pose and the camera poses";
    FieldError::refused("views", reason)
}

/// Observed points, subsampled evenly to at most [`LIMIT`](Self::LIMIT): images may have millions of pixels, and the
/// points of queued requests would fill the memory.
pub(crate) struct PointSampler {
    points: Vec<SurfacePoint>,
    /// One of every `stride` points is kept.
    stride: usize,
    count: usize,
}

impl PointSampler {
    /// 10 MB, and far more points than the planners use.
    const LIMIT: usize = 200_000;

    pub fn add(&mut self, point: SurfacePoint) {
        if self.count.is_multiple_of(self.stride) {
            self.points.push(point);
        }
        self.count += 1;
        if self.points.len() == Self::LIMIT {
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
    }

    pub fn into_points(self) -> Vec<SurfacePoint> {
        self.points
    }
}

impl Default for PointSampler {
    fn default() -> Self {
        Self { points: Vec::new(), stride: 1, count: 0 }
    }
}

/// The error for a view that sees none of the workspace. It contains the camera's position, which shows wrong poses.
pub(crate) fn sees_nothing(index: usize, camera: &Point3<f64>, reason: impl Display) -> FieldError {
    let position = format!("({:.3}, {:.3}, {:.3})", camera.x, camera.y, camera.z);
    let reason = format!("camera at {position} in the task frame sees none of the workspace; {reason}");
    FieldError::refused(format!("views[{index}]"), reason)
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
    fn points_are_subsampled_evenly() {
        let mut sampler = PointSampler::default();
        let point = |x: usize| SurfacePoint { position: Point3::new(x as f64, 0.0, 0.0), normal: Vector3::z() };
        (0..5 * PointSampler::LIMIT).for_each(|x| sampler.add(point(x)));
        assert!((PointSampler::LIMIT / 2..PointSampler::LIMIT).contains(&sampler.points.len()));
        assert!(sampler.points.windows(2).all(|pair| pair[1].position.x - pair[0].position.x == 8.0));
    }

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
