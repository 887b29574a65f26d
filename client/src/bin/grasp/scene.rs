use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use grasp::{DepthImage, Fusion, Intrinsics, RESOLUTION, View, Volume, WORKSPACE_SIZE, seen_from};
use grasp_client::{Client, CloudView, Depth, DepthView, Detection, Error, Extrinsics, Options, Workspace};
use nalgebra::{Isometry3, Point3};

use crate::numbers::Numbers;
use crate::{cloud, image, pose, volume};

/// The observation: a volume, depth images with camera poses, or point clouds with camera positions.
#[derive(Args, Clone)]
pub(crate) struct SceneArgs {
    /// Volume, depth images or point clouds. A volume is a .npy file, or a .npz file with one array or an array `grid`:
    /// N×N×N values in [0, 1] (u8: 0 to 255), indexed x, y, z, 0.5 on the surface, 0 if unobserved. With --intrinsics
    /// the files are depth images: 16-bit PNG or u16 .npy in millimetres, or f32 .npy in metres; 0 and NaN mean no
    /// reading. With --camera-position they are point clouds: .npy, or .npz with one array or an array `points`, N×3 or
    /// H×W×3, metres.
    #[arg(required = true)]
    files: Vec<PathBuf>,

    /// Edge of a voxel of the volume, metres. Default: 0.3 m / N.
    #[arg(long, value_name = "METRES", conflicts_with_all = ["intrinsics", "camera_position"])]
    voxel_size: Option<f64>,

    /// Intrinsic matrix of the cameras: 3×3 .npy, or JSON with the nine numbers `k` of ROS's CameraInfo.
    #[arg(long, value_name = "FILE", conflicts_with = "camera_position")]
    intrinsics: Option<PathBuf>,

    /// T_camera_task of each image: 4×4 or N×4×4 .npy, JSON with such matrices, or JSON with poses
    /// {"position": [x, y, z], "orientation": [x, y, z, w]}.
    #[arg(long, value_name = "FILE", requires = "intrinsics", conflicts_with = "frame_from_camera")]
    camera_from_task: Option<PathBuf>,

    /// T_frame_camera of each image, as hand-eye calibration returns it, instead of T_camera_task. Same formats.
    #[arg(long, value_name = "FILE", requires = "intrinsics")]
    frame_from_camera: Option<PathBuf>,

    /// Camera position of a point cloud in the frame of its points, metres: 0,0,0 for points in the camera frame. Give
    /// it once for all point clouds, or once for each.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    camera_position: Vec<Numbers<3>>,

    /// T_frame_cloud of each point cloud, formats as for --camera-from-task. Default: identity.
    #[arg(long, value_name = "FILE", requires = "camera_position")]
    frame_from_cloud: Option<PathBuf>,

    /// T_frame_task: pose of the workspace's corner, formats as for --camera-from-task. Default: identity.
    #[arg(long, value_name = "FILE")]
    workspace: Option<PathBuf>,

    /// Name of the frame of the grasps.
    #[arg(long, default_value = "", hide_default_value = true)]
    frame_id: String,
}

/// The observation as read from its files.
#[derive(Clone)]
pub(crate) enum Scene {
    Volume(Box<Volume>),
    Depth(Vec<DepthView>, Workspace),
    Clouds(Vec<CloudView>, Workspace),
}

impl SceneArgs {
    /// All input files.
    pub fn files(&self) -> impl Iterator<Item = &PathBuf> {
        let Self { files, intrinsics, camera_from_task, frame_from_camera, frame_from_cloud, workspace, .. } = self;
        files
            .iter()
            .chain(intrinsics)
            .chain(camera_from_task)
            .chain(frame_from_camera)
            .chain(frame_from_cloud)
            .chain(workspace)
    }

    pub fn frame_id(&self) -> String {
        self.frame_id.clone()
    }

    pub fn read(&self) -> anyhow::Result<Scene> {
        let pose = self.workspace.as_deref().map(pose::one).transpose()?.unwrap_or_default();
        let workspace = Workspace { pose, size: None };
        if let Some(intrinsics) = &self.intrinsics {
            return Ok(Scene::Depth(self.images(intrinsics)?, workspace));
        }
        if !self.camera_position.is_empty() {
            return Ok(Scene::Clouds(self.clouds()?, workspace));
        }
        let [file] = &self.files[..] else {
            bail!(
                "{} files given, but a volume is one file; add --intrinsics for depth images or --camera-position for \
                 point clouds",
                self.files.len()
            )
        };
        Ok(Scene::Volume(Box::new(volume::read(file, self.voxel_size, pose)?)))
    }

    fn images(&self, intrinsics: &Path) -> anyhow::Result<Vec<DepthView>> {
        let k = pose::intrinsics(intrinsics)?;
        let (path, direction): (_, fn(Isometry3<f64>) -> Extrinsics) =
            match (&self.camera_from_task, &self.frame_from_camera) {
                (Some(path), _) => (path, Extrinsics::CameraFromTask),
                (None, Some(path)) => (path, Extrinsics::FrameFromCamera),
                (None, None) => bail!("depth images need --camera-from-task or --frame-from-camera"),
            };
        let poses = pose::each(path, self.files.len(), "images")?;
        let view = |(file, pose): (&PathBuf, Isometry3<f64>)| {
            let (depth, width, height) = image::read(file)?;
            Ok(DepthView { depth, width, height, k, extrinsics: direction(pose) })
        };
        self.files.iter().zip(poses).map(view).collect()
    }

    fn clouds(&self) -> anyhow::Result<Vec<CloudView>> {
        let count = self.files.len();
        let positions = match &self.camera_position[..] {
            [of_all] => vec![*of_all; count],
            of_each if of_each.len() == count => of_each.to_vec(),
            other => bail!(
                "--camera-position is given {} times for {count} point clouds; give it once for all or once for each",
                other.len()
            ),
        };
        let poses = match &self.frame_from_cloud {
            Some(path) => pose::each(path, count, "point clouds")?,
            None => vec![Isometry3::identity(); count],
        };
        let view = |((file, Numbers(camera_position)), frame_from_cloud): ((&PathBuf, _), _)| {
            Ok(CloudView { points: cloud::read(file)?, frame_from_cloud, camera_position })
        };
        self.files.iter().zip(positions).zip(poses).map(view).collect()
    }
}

impl Scene {
    /// Detects grasps in the observation.
    pub async fn detect(&self, client: &Client, options: Options) -> Result<Detection, Error> {
        match self {
            Self::Volume(volume) => client.detect(volume, options).await,
            Self::Depth(views, workspace) => client.detect_from_depth(views, workspace, options).await,
            Self::Clouds(views, workspace) => client.detect_from_cloud(views, workspace, options).await,
        }
    }

    /// The volume to draw: the given one, or the fused images or points.
    pub fn volume(&self) -> anyhow::Result<Volume> {
        let (views, workspace) = match self {
            Self::Volume(volume) => return Ok((**volume).clone()),
            Self::Depth(views, workspace) => {
                (views.iter().map(|view| depth_view(view, workspace)).collect(), workspace)
            }
            Self::Clouds(views, workspace) => {
                let views = views.iter().map(|view| rendered_view(view, workspace));
                (views.collect::<anyhow::Result<Vec<_>>>()?, workspace)
            }
        };
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        for view in views {
            fusion.integrate(&DepthImage::new(view.intrinsics, &view.depth)?, &view.camera_from_task);
        }
        Ok(fusion.volume(workspace.pose)?)
    }
}

fn depth_view(view: &DepthView, workspace: &Workspace) -> View {
    let depth = match &view.depth {
        Depth::Metres(depth) => depth.clone(),
        Depth::Millimetres(depth) => depth.iter().map(|&depth| f32::from(depth) * 1e-3).collect(),
    };
    let [fx, _, cx, _, fy, cy, ..] = view.k;
    let (width, height) = (view.width as usize, view.height as usize);
    let camera_from_task = match view.extrinsics {
        Extrinsics::CameraFromTask(pose) => pose,
        Extrinsics::FrameFromCamera(pose) => pose.inverse() * workspace.pose,
    };
    View { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, depth, camera_from_task }
}

/// Renders a cloud to a depth image, as the server does.
fn rendered_view(view: &CloudView, workspace: &Workspace) -> anyhow::Result<View> {
    let task_from_cloud = workspace.pose.inverse() * view.frame_from_cloud;
    let points: Vec<_> = view.points.iter().map(|&point| task_from_cloud * Point3::from(point).cast::<f64>()).collect();
    let eye = task_from_cloud * Point3::from(view.camera_position);
    seen_from(&points, &eye, WORKSPACE_SIZE)
        .context("a camera sees no point of its cloud; check --camera-position and the poses")
}
