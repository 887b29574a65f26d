use std::f64::consts::PI;
use std::fmt::Display;

use grasp::{
    Constraints, DepthImage, Fusion, RESOLUTION, Region, SurfacePoint, View, VolumeError, WORKSPACE_SIZE, Warning,
    seen_from,
};
use grasp_models::Metadata;
use grasp_proto::{FieldError, Points, Workspace};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use grasp_planner::{Scene, Source};

/// The voxel grid that views are fused into, and its pose.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FusionGrid {
    resolution: usize,
    size: f64,
    /// `T_frame_task`.
    frame_from_task: Isometry3<f64>,
    /// `T_task_grid`: for a network trained with the camera on one side, the grid is rotated so that the camera is on
    /// that side.
    task_from_grid: Isometry3<f64>,
    /// Azimuth of the camera in the grid, degrees, if the network was trained with a fixed one.
    azimuth: Option<f64>,
    /// Whether the planner has a network. Planners without one need the observed points besides the volume.
    is_of_network: bool,
}

/// What the views of a request show besides the fused volume.
pub(crate) struct Integrated {
    /// The observed points in the workspace, if the planner needs them.
    pub points: Option<Vec<SurfacePoint>>,
    /// Signs that the geometry is wrong.
    pub warnings: Vec<Warning>,
}

impl FusionGrid {
    /// The grid that a planner requires for a workspace. `cameras` are the camera positions in the task frame, metres.
    pub fn of(source: &Source, workspace: &Workspace, cameras: &[Point3<f64>]) -> Result<Self, FieldError> {
        let Workspace { frame_from_task, size, .. } = *workspace;
        let Some(network) = source.network() else {
            let size = size.unwrap_or(WORKSPACE_SIZE);
            let task_from_grid = Isometry3::identity();
            return Ok(Self {
                resolution: RESOLUTION,
                size,
                frame_from_task,
                task_from_grid,
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
        let task_from_grid = azimuth.map_or_else(Isometry3::identity, |azimuth| rotated(azimuth, trained, cameras));
        Ok(Self { resolution, size: trained, frame_from_task, task_from_grid, azimuth, is_of_network: true })
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

    /// Adds the constraint that grasps are in the workspace, if the grid is rotated and extends beyond it.
    pub fn within(&self, constraints: Constraints) -> Constraints {
        let region = Region { frame: self.frame_from_task, lower: [0.0; 3], upper: [self.size; 3] };
        let workspace = (self.task_from_grid != Isometry3::identity()).then_some(region);
        Constraints { workspace, ..constraints }
    }

    /// An empty volume of this grid.
    pub fn fusion(&self) -> Fusion {
        Fusion::new(self.resolution, self.size)
    }

    /// Integrates views, each of which must see a part of the grid.
    pub fn integrate(&self, fusion: &mut Fusion, views: &[View]) -> Result<Integrated, FieldError> {
        let mut points = PointSampler::default();
        let mut warnings = Vec::new();
        for (index, view) in views.iter().enumerate() {
            let image = DepthImage::new(view.intrinsics, &view.depth);
            let image = image.map_err(|error| FieldError::refused(format!("views[{index}]"), error))?;
            let camera_from_grid = view.camera_from_task * self.task_from_grid;
            if self.is_of_network {
                warnings.extend(Warning::of_camera(index, &view.camera_from_task, self.size));
            }
            warnings.extend(Warning::of_view(index, fusion, &image, &camera_from_grid));
            if fusion.integrate(&image, &camera_from_grid) == 0 {
                let reason = fusion.blind(&image, &camera_from_grid);
                let camera = view.camera_from_task.inverse().translation;
                return Err(sees_nothing(index, &camera.vector.into(), reason));
            }
            if !self.is_of_network {
                let inside = |point: &SurfacePoint| point.position.iter().all(|c| (0.0..=self.size).contains(c));
                image.points(&view.camera_from_task).filter(inside).for_each(|point| points.add(point));
            }
        }
        warnings.extend(Warning::of_coverage(fusion));
        Ok(Integrated { points: (!self.is_of_network).then_some(points.points), warnings })
    }

    /// The scene for the planner.
    pub fn scene(&self, fusion: &Fusion, points: Option<Vec<SurfacePoint>>) -> Result<Scene, FieldError> {
        let volume = fusion.volume(self.frame_from_task * self.task_from_grid).map_err(|error| match error {
            VolumeError::Empty => {
                let reason = "none shows a surface in the workspace; check workspace.pose and the camera poses";
                FieldError::refused("views", reason)
            }
            error => FieldError::refused("workspace", error),
        })?;
        Ok(Scene { volume, points })
    }
}

/// Observed points, subsampled evenly to at most [`LIMIT`](Self::LIMIT): images may have millions of pixels, and the
/// points of queued requests would fill the memory.
struct PointSampler {
    points: Vec<SurfacePoint>,
    /// One of every `stride` points is kept.
    stride: usize,
    count: usize,
}

impl PointSampler {
    /// 10 MB, and far more points than the planners use.
    const LIMIT: usize = 200_000;

    fn add(&mut self, point: SurfacePoint) {
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
}

impl Default for PointSampler {
    fn default() -> Self {
        Self { points: Vec::new(), stride: 1, count: 0 }
    }
}

/// Renders point clouds as depth images from their camera positions, for a cube of `size` metres.
pub(crate) fn rendered(clouds: &[Points], size: f64) -> Result<Vec<View>, FieldError> {
    let view = |(index, cloud): (usize, &Points)| {
        seen_from(&cloud.points, &cloud.eye, size).ok_or_else(|| {
            let reason = "no point is visible, or the camera is inside the cloud; check camera_position and the poses";
            sees_nothing(index, &cloud.eye, reason)
        })
    };
    clouds.iter().enumerate().map(view).collect()
}

/// The error for a view that sees none of the workspace. It contains the camera's position, which shows wrong poses.
fn sees_nothing(index: usize, camera: &Point3<f64>, reason: impl Display) -> FieldError {
    let position = format!("({:.3}, {:.3}, {:.3})", camera.x, camera.y, camera.z);
    let reason = format!("camera at {position} in the task frame sees none of the workspace; {reason}");
    FieldError::refused(format!("views[{index}]"), reason)
}

/// Edge length of the cube that point clouds are rendered for, metres: the workspace's size, or the model's.
pub(crate) fn size(source: &Source, workspace: &Workspace) -> f64 {
    let own = source
        .network()
        .map_or(WORKSPACE_SIZE, |network| network.metadata.resolution as f64 * network.metadata.voxel_size);
    workspace.size.unwrap_or(own)
}

/// Camera positions in the task frame, metres.
pub(crate) fn camera_positions(views: &[View]) -> Vec<Point3<f64>> {
    views.iter().map(|view| Point3::from(view.camera_from_task.inverse().translation.vector)).collect()
}

/// `T_task_grid` of a cube of `size` metres, rotated about its vertical axis so that the mean azimuth of `cameras` in
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
            let task_from_grid = rotated(azimuth, 0.3, &[camera]);
            let in_grid = task_from_grid.inverse() * camera;
            let actual = (in_grid.y - 0.15).atan2(in_grid.x - 0.15) * 180.0 / PI;
            assert!((actual - azimuth).rem_euclid(360.0).min((azimuth - actual).rem_euclid(360.0)) < 1e-6, "{actual}");
            assert!((task_from_grid.rotation.angle() * 180.0 / PI - f64::abs(expected)).abs() < 1e-6);
            let centre = Point3::new(0.15, 0.15, 0.1);
            assert!((task_from_grid * centre - centre).norm() < 1e-12, "the rotation is about the grid's own axis");
        }
        let around = [Point3::new(0.65, 0.15, 0.4), Point3::new(-0.35, 0.15, 0.4)];
        assert_eq!(rotated(0.0, 0.3, &around), Isometry3::identity());
    }
}
