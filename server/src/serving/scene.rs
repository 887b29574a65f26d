use std::f64::consts::PI;

use grasp::{
    Constraints, DepthImage, Fusion, RESOLUTION, Region, SurfacePoint, View, VolumeError, WORKSPACE_SIZE, seen_from,
};
use grasp_models::Metadata;
use grasp_proto::{FieldError, Points, Workspace};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use grasp_planner::{Scene, Source};

/// The cube that depth is fused into, and how it stands.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FusionGrid {
    resolution: usize,
    size: f64,
    /// `T_frame_task`.
    frame_from_task: Isometry3<f64>,
    /// `T_task_grid`: for a network that was trained with a camera on one side, the cube is turned so that the camera
    /// stands there.
    task_from_grid: Isometry3<f64>,
    /// Where cameras stand in it, if that matters to who reads it: degrees about the vertical.
    azimuth: Option<f64>,
    /// Whether a planner wants more than the volume.
    sights: bool,
}

impl FusionGrid {
    /// The one that a planner reads, of a workspace that cameras look at from these points of the task frame.
    pub fn of(source: &Source, workspace: &Workspace, eyes: &[Point3<f64>]) -> Result<Self, FieldError> {
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
                sights: true,
            });
        };
        let resolution = network.metadata.resolution;
        let trained = resolution as f64 * network.metadata.voxel_size;
        if let Some(size) = size
            && (size - trained).abs() > 1e-3 * trained
        {
            let needed = format_args!("the model {} takes {trained} m, to one in a thousand, or 0", source.name());
            return Err(FieldError::new("workspace.size", size, needed));
        }
        let azimuth = network.metadata.camera_azimuth;
        let task_from_grid = azimuth.map_or_else(Isometry3::identity, |azimuth| turned(azimuth, trained, eyes));
        Ok(Self { resolution, size: trained, frame_from_task, task_from_grid, azimuth, sights: false })
    }

    /// Whether a planner reads what was fused into this one.
    pub fn check(&self, source: &Source) -> Result<(), FieldError> {
        match source.network().map(|entry| &entry.metadata) {
            Some(network) if !self.is_read_by(network) => {
                let value = format_args!("`{}`", source.name());
                let needed = "which reads another volume than the one that is kept; send a workspace to start one";
                Err(FieldError::new("options.model", value, needed))
            }
            _ => Ok(()),
        }
    }

    fn is_read_by(&self, network: &Metadata) -> bool {
        let trained = network.resolution as f64 * network.voxel_size;
        network.resolution == self.resolution
            && (self.size - trained).abs() <= 1e-3 * trained
            && network.camera_azimuth == self.azimuth
    }

    /// What is asked of grasps, and that they lie in the cube that was asked about, where the grid reaches beyond it.
    pub fn within(&self, constraints: Constraints) -> Constraints {
        let region = Region { frame: self.frame_from_task, lower: [0.0; 3], upper: [self.size; 3] };
        let workspace = (self.task_from_grid != Isometry3::identity()).then_some(region);
        Constraints { workspace, ..constraints }
    }

    /// An empty field.
    pub fn fusion(&self) -> Fusion {
        Fusion::new(self.resolution, self.size)
    }

    /// Adds views, each of which must see something of the cube. Returns what planners on point clouds want.
    pub fn integrate(&self, fusion: &mut Fusion, views: &[View]) -> Result<Vec<SurfacePoint>, FieldError> {
        let mut sights = PointSampler::default();
        for (index, view) in views.iter().enumerate() {
            let image = DepthImage::new(view.intrinsics, &view.depth);
            let image = image.map_err(|error| FieldError::refused(format!("views[{index}]"), error))?;
            let camera_from_grid = view.camera_from_task * self.task_from_grid;
            if fusion.integrate(&image, &camera_from_grid) == 0 {
                let reason = fusion.blind(&image, &camera_from_grid);
                let eye = view.camera_from_task.inverse().translation;
                return Err(FieldError::new(format!("views[{index}]"), blind(&eye.vector.into()), reason));
            }
            if self.sights {
                let inside = |point: &SurfacePoint| point.position.iter().all(|c| (0.0..=self.size).contains(c));
                image.points(&view.camera_from_task).filter(inside).for_each(|point| sights.add(point));
            }
        }
        Ok(sights.points)
    }

    /// What a planner looks at.
    pub fn scene(&self, fusion: &Fusion, sights: Option<Vec<SurfacePoint>>) -> Result<Scene, FieldError> {
        let volume = fusion.volume(self.frame_from_task * self.task_from_grid).map_err(|error| match error {
            VolumeError::Empty => {
                let reason = "none shows a surface in the workspace; check workspace.pose and the poses of the cameras";
                FieldError::refused("views", reason)
            }
            error => FieldError::refused("workspace", error),
        })?;
        Ok(Scene { volume, points: sights.filter(|_| self.sights) })
    }
}

/// Points that were seen, thinned out evenly once there are [`MOST`](Self::MOST): images may have millions of pixels, and a
/// queue of requests that hold them would fill the memory.
struct PointSampler {
    points: Vec<SurfacePoint>,
    /// One of so many is kept.
    every: usize,
    passed: usize,
}

impl PointSampler {
    /// Far more than the planners, which thin them again, look at: 10 MB.
    const MOST: usize = 200_000;

    fn add(&mut self, point: SurfacePoint) {
        if self.passed.is_multiple_of(self.every) {
            self.points.push(point);
        }
        self.passed += 1;
        if self.points.len() == Self::MOST {
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.every *= 2;
        }
    }
}

impl Default for PointSampler {
    fn default() -> Self {
        Self { points: Vec::new(), every: 1, passed: 0 }
    }
}

/// What the cameras of point clouds would have seen.
pub(crate) fn rendered(clouds: &[Points], size: f64) -> Result<Vec<View>, FieldError> {
    let view = |(index, cloud): (usize, &Points)| {
        seen_from(&cloud.points, &cloud.eye, size).ok_or_else(|| {
            let needed =
                "no point is in sight there, or the camera stands inside of it; check camera_position and the poses";
            FieldError::new(format!("views[{index}]"), blind(&cloud.eye), needed)
        })
    };
    clouds.iter().enumerate().map(view).collect()
}

/// A view that sees nothing of the cube, with where its camera is said to stand: who reads it knows better.
fn blind(eye: &Point3<f64>) -> String {
    format!("blind from ({:.3}, {:.3}, {:.3}) of the task frame", eye.x, eye.y, eye.z)
}

/// The edge of the cube that clouds are looked at in before a planner is known to want another.
pub(crate) fn size(source: &Source, workspace: &Workspace) -> f64 {
    let own = source
        .network()
        .map_or(WORKSPACE_SIZE, |network| network.metadata.resolution as f64 * network.metadata.voxel_size);
    workspace.size.unwrap_or(own)
}

/// Where the cameras of views stand in the task frame.
pub(crate) fn eyes(views: &[View]) -> Vec<Point3<f64>> {
    views.iter().map(|view| Point3::from(view.camera_from_task.inverse().translation.vector)).collect()
}

/// `T_task_grid` of a cube of `size` metres, turned about its vertical axis so that cameras which stand at `eyes` stand at
/// `azimuth`, degrees, in the mean. Not at all, where they stand all around.
fn turned(azimuth: f64, size: f64, eyes: &[Point3<f64>]) -> Isometry3<f64> {
    /// Length of the mean of the directions below which they have no common one.
    const COMMON: f64 = 0.5;
    let middle = Vector3::new(size / 2.0, size / 2.0, 0.0);
    let directions = eyes.iter().filter_map(|eye| (eye.coords - middle).xy().try_normalize(1e-9));
    let sum: nalgebra::Vector2<f64> = directions.sum();
    if sum.norm() < COMMON * eyes.len() as f64 {
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
    fn points_are_thinned_out_evenly() {
        let mut sights = PointSampler::default();
        let point = |x: usize| SurfacePoint { position: Point3::new(x as f64, 0.0, 0.0), normal: Vector3::z() };
        (0..5 * PointSampler::MOST).for_each(|x| sights.add(point(x)));
        assert!((PointSampler::MOST / 2..PointSampler::MOST).contains(&sights.points.len()));
        assert!(sights.points.windows(2).all(|pair| pair[1].position.x - pair[0].position.x == 8.0));
    }

    #[test]
    fn the_cube_turns_until_the_camera_stands_where_the_network_was_trained() {
        let eye = Point3::new(0.15, -0.45, 0.4);
        for (azimuth, wanted) in [(-90.0, 0.0), (0.0, -90.0), (90.0, 180.0)] {
            let task_from_grid = turned(azimuth, 0.3, &[eye]);
            let seen = task_from_grid.inverse() * eye;
            let stands = (seen.y - 0.15).atan2(seen.x - 0.15) * 180.0 / PI;
            assert!((stands - azimuth).rem_euclid(360.0).min((azimuth - stands).rem_euclid(360.0)) < 1e-6, "{stands}");
            assert!((task_from_grid.rotation.angle() * 180.0 / PI - f64::abs(wanted)).abs() < 1e-6);
            let centre = Point3::new(0.15, 0.15, 0.1);
            assert!((task_from_grid * centre - centre).norm() < 1e-12, "about its own axis");
        }
        let around = [Point3::new(0.65, 0.15, 0.4), Point3::new(-0.35, 0.15, 0.4)];
        assert_eq!(turned(0.0, 0.3, &around), Isometry3::identity());
    }
}
