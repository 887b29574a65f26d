use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use grasp::{Fusion, Intrinsics, RESOLUTION, Volume, WORKSPACE_SIZE};
use grasp_client::{
    Candidate, Client, CloudView, Depth, DepthView, Detection, Error, Extrinsics, FindTable, Observation, Options,
    Scores, Workspace,
};
use grasp_perception::{Cloud, View, overview, seen_from};
use nalgebra::{Isometry3, Point3, Vector3};

use crate::camera::{self, Camera};
use crate::document::listed;
use crate::image::{self, Scale};
use crate::labels::{self, Labels};
use crate::numbers::{Numbers, counted};
use crate::pose::Poses;
use crate::{UnitFlag, cloud, volume};

/// The observation: a volume, depth images with camera poses, or point clouds with camera positions.
#[derive(Args, Clone)]
#[command(next_help_heading = "Input")]
pub(crate) struct SceneArgs {
    /// Volume, depth images or point clouds. A volume is a .npy file, or a .npz file with one array or an array `grid`:
    /// N×N×N values in [0, 1] (u8: 0 to 255), indexed x, y, z, 0.5 on the surface, 0 if unobserved. With --intrinsics
    /// the files are depth images: PNG, TIFF or .npy with 16 bits per pixel (see --depth-scale), or TIFF, EXR or .npy
    /// with floats in metres; 0 and NaN mean no reading. With --camera-position they are point clouds: PCD, PLY, text
    /// with a point in each line, .npy, or .npz with one array or an array `points` or `xyz`, N×3 or H×W×3.
    #[arg(required = true)]
    files: Vec<PathBuf>,

    /// Edge of a voxel of the volume, metres. Default: 0.3 m / N.
    #[arg(long, value_name = "METRES", conflicts_with_all = ["intrinsics", "camera_position"])]
    voxel_size: Option<f64>,

    /// Intrinsics of the cameras: JSON, YAML or text of ROS (CameraInfo), OpenCV, Open3D, librealsense, kalibr or BOP,
    /// a matrix in a .npy or .npz, or the numbers FX,FY,CX,CY. Images of a lens with distortion are rectified.
    #[arg(long, value_name = "FILE|NUMBERS", conflicts_with = "camera_position", allow_hyphen_values = true)]
    intrinsics: Option<String>,

    /// The images are rectified already, as those of image_rect: their matrix is `p` of a CameraInfo, or `k` if the file
    /// has none, and its distortion is not applied.
    #[arg(long, requires = "intrinsics", conflicts_with = "camera_position")]
    rectified: bool,

    /// Unit of the depths, metres: 0.0001 for tenths of a millimetre. Default: that of the file of the intrinsics, or
    /// else 0.001 for integers and 1 for floats.
    #[arg(long, value_name = "METRES", value_parser = image::parse_scale, requires = "intrinsics", conflicts_with = "camera_position", allow_hyphen_values = true)]
    depth_scale: Option<f64>,

    /// Send depth images as PNG files: fewer bytes on a slow network. They must be in millimetres.
    #[arg(long, requires = "intrinsics", conflicts_with = "camera_position")]
    png: bool,

    /// T_camera_task of each image: matrices (.npy, .npz, JSON, YAML or text), or poses
    /// {"position": [x, y, z], "orientation": [x, y, z, w]} (JSON, or YAML of ROS and easy_handeye); of one image also
    /// the numbers X,Y,Z or X,Y,Z,QX,QY,QZ,QW.
    #[arg(
        long,
        value_name = "FILE|NUMBERS",
        requires = "intrinsics",
        conflicts_with_all = ["frame_from_camera", "camera_position"],
        allow_hyphen_values = true
    )]
    camera_from_task: Option<Poses>,

    /// T_frame_camera of each image, as hand-eye calibration returns it, instead of T_camera_task. Same formats.
    /// Default for one image: identity, the grasps are then in the frame of the camera.
    #[arg(
        long,
        value_name = "FILE|NUMBERS",
        requires = "intrinsics",
        conflicts_with = "camera_position",
        allow_hyphen_values = true
    )]
    frame_from_camera: Option<Poses>,

    /// Find the table in the first depth image or point cloud, and place the workspace over the objects on it: all of
    /// them, if there is no --extent.
    #[arg(long, conflicts_with_all = ["workspace", "camera_from_task", "voxel_size"])]
    find_table: bool,

    /// Direction of gravity in the frame of the grasps, for --find-table: the reversed reading of an accelerometer at
    /// rest. Without it a wall that fills the image is taken for a table.
    #[arg(long, value_name = "X,Y,Z", requires = "find_table", allow_hyphen_values = true)]
    gravity: Option<Numbers<3>>,

    /// Camera position of a point cloud in the frame of its points, metres: 0,0,0 for points in the camera frame. Give
    /// it once for all point clouds, or once for each.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    camera_position: Vec<Numbers<3>>,

    /// Unit of the points, metres: 0.001 for millimetres. Default: 0.001 for integers and 1 for floats.
    #[arg(long, value_name = "METRES", value_parser = image::parse_scale, requires = "camera_position", conflicts_with = "intrinsics", allow_hyphen_values = true)]
    cloud_scale: Option<f64>,

    /// T_frame_cloud of each point cloud, formats as for --camera-from-task. Default: identity.
    #[arg(
        long,
        value_name = "FILE|NUMBERS",
        requires = "camera_position",
        conflicts_with = "intrinsics",
        allow_hyphen_values = true
    )]
    frame_from_cloud: Option<Poses>,

    /// Labels of the objects in each depth image or point cloud, in the order of these files: 8- or 16-bit grey PNG, or
    /// .npy with whole numbers or truth values; 0 is no object. Give it once for each.
    #[arg(long, value_name = "FILE")]
    labels: Vec<PathBuf>,

    /// Lengths of the workspace along x and y, metres, at most 2: larger than one cube. Default: one cube.
    #[arg(long, alias = "size", value_name = "X,Y")]
    extent: Option<Numbers<2>>,

    /// T_frame_task: pose of the workspace's corner, formats as for --camera-from-task. Default: identity.
    #[arg(long, value_name = "FILE|NUMBERS", allow_hyphen_values = true)]
    workspace: Option<Poses>,

    /// Multiply the depths of each image or point cloud by one factor, so that the table is at its height; `=false`:
    /// never. Default: only of depth images whose table is level and at most 3 cm from its height.
    #[arg(
        long,
        value_name = "BOOL",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "true",
        conflicts_with = "find_table"
    )]
    correct_depth_scale: Option<bool>,

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
    pub fn files(&self) -> impl Iterator<Item = PathBuf> {
        let Self { files, intrinsics, camera_from_task, frame_from_camera, frame_from_cloud, workspace, .. } = self;
        let poses = [camera_from_task, frame_from_camera, frame_from_cloud, workspace].into_iter().flatten();
        let intrinsics = intrinsics.as_deref().and_then(camera::file);
        let labels = self.labels.iter().cloned();
        files.iter().cloned().chain(labels).chain(intrinsics).chain(poses.filter_map(Poses::file).cloned())
    }

    pub fn unit(&self) -> UnitFlag {
        let flag = if self.camera_position.is_empty() { "--depth-scale" } else { "--cloud-scale" };
        UnitFlag { flag, given: self.cloud_scale.or(self.depth_scale) }
    }

    pub fn frame_id(&self) -> String {
        self.frame_id.clone()
    }

    pub fn read(&self) -> anyhow::Result<Scene> {
        let pose = self.workspace.as_ref().map(Poses::one).transpose()?.unwrap_or_default();
        let find_table = self.find_table.then(|| FindTable { gravity: self.gravity.map(|Numbers(gravity)| gravity) });
        let extent = self.extent.map(|Numbers(extent)| extent);
        let correct_depth_scale = self.correct_depth_scale;
        let workspace = Workspace { pose, size: None, find_table, extent, correct_depth_scale };
        if let Some(intrinsics) = &self.intrinsics {
            return Ok(Scene::Depth(self.images(intrinsics)?, workspace));
        }
        if !self.camera_position.is_empty() {
            return Ok(Scene::Clouds(self.clouds()?, workspace));
        }
        ensure!(
            find_table.is_none() && correct_depth_scale.is_none(),
            "--find-table and --correct-depth-scale need depth images (--intrinsics) or point clouds (--camera-position)"
        );
        let [file] = &self.files[..] else {
            bail!(
                "{} files given, but a volume is one file; add --intrinsics for depth images or --camera-position for \
                 point clouds",
                self.files.len()
            )
        };
        ensure!(extent.is_none() && self.labels.is_empty(), "--extent and --labels need depth images or point clouds");
        Ok(Scene::Volume(Box::new(volume::read(file, self.voxel_size, pose)?)))
    }

    /// The labels of each file, if given.
    fn labels(&self) -> anyhow::Result<Vec<Option<Labels>>> {
        if self.labels.is_empty() {
            return Ok(self.files.iter().map(|_| None).collect());
        }
        ensure!(
            self.labels.len() == self.files.len(),
            "--labels is given {} for {}; give it once for each",
            counted(self.labels.len(), "time"),
            counted(self.files.len(), "file")
        );
        self.labels.iter().map(|path| labels::read(path).map(Some)).collect()
    }

    fn images(&self, intrinsics: &str) -> anyhow::Result<Vec<DepthView>> {
        let camera = Camera::read(intrinsics, self.rectified)?;
        let scale = Scale { given: self.depth_scale, of_camera: camera.depth_scale };
        let of_camera = Poses::Numbers(Isometry3::identity());
        let (poses, direction): (_, fn(Isometry3<f64>) -> Extrinsics) =
            match (&self.camera_from_task, &self.frame_from_camera) {
                (Some(poses), _) => (poses, Extrinsics::CameraFromTask),
                (None, Some(poses)) => (poses, Extrinsics::FrameFromCamera),
                (None, None) if self.files.len() == 1 && (self.find_table || self.workspace.is_some()) => {
                    (&of_camera, Extrinsics::FrameFromCamera)
                }
                (None, None) => bail!(
                    "depth images need --camera-from-task or --frame-from-camera; one image without them needs \
                     --find-table, or the --workspace in the frame of the camera that `grasp table` finds"
                ),
            };
        let poses = poses.each(self.files.len(), "image")?;
        let view = |((file, pose), labels): ((&PathBuf, Isometry3<f64>), Option<Labels>)| {
            let view = camera.view(file, scale, labels, direction(pose))?;
            let depth = match view.depth {
                Depth::Millimetres(depth) if self.png => Depth::Png(depth),
                Depth::Metres(_) if self.png => {
                    bail!("{}: --png needs depths in millimetres, in a PNG, TIFF or .npy with 16 bits", file.display())
                }
                depth => depth,
            };
            Ok(DepthView { depth, ..view })
        };
        self.files.iter().zip(poses).zip(self.labels()?).map(view).collect()
    }

    fn clouds(&self) -> anyhow::Result<Vec<CloudView>> {
        let count = self.files.len();
        let positions = match &self.camera_position[..] {
            [of_all] => vec![*of_all; count],
            of_each if of_each.len() == count => of_each.to_vec(),
            other => bail!(
                "--camera-position is given {} for {}; give it once for all or once for each",
                counted(other.len(), "time"),
                counted(count, "point cloud")
            ),
        };
        let poses = match &self.frame_from_cloud {
            Some(poses) => poses.each(count, "point cloud")?,
            None => vec![Isometry3::identity(); count],
        };
        let view =
            |(((file, Numbers(camera_position)), frame_from_cloud), labels): (((&PathBuf, _), _), Option<Labels>)| {
                let labels = labels.map(|Labels { values, .. }| values);
                Ok(CloudView {
                    points: cloud::read(file, self.cloud_scale)?,
                    frame_from_cloud,
                    camera_position,
                    labels,
                })
            };
        self.files.iter().zip(positions).zip(poses).zip(self.labels()?).map(view).collect()
    }
}

impl Scene {
    /// Checks that the labels of the files have one of these objects, if there are labels.
    pub fn check_objects(&self, objects: &[u32]) -> anyhow::Result<()> {
        let labels: Vec<&Vec<u16>> = match self {
            Self::Volume(_) => return Ok(()),
            Self::Depth(views, _) => views.iter().filter_map(|view| view.labels.as_ref()).collect(),
            Self::Clouds(views, _) => views.iter().filter_map(|view| view.labels.as_ref()).collect(),
        };
        let found: BTreeSet<u32> = labels.iter().flat_map(|labels| labels.iter().map(|&label| label.into())).collect();
        let is_found = objects.iter().any(|label| found.contains(label));
        let names: Vec<String> = found.iter().filter(|&&label| label != 0).map(ToString::to_string).collect();
        ensure!(
            labels.is_empty() || objects.is_empty() || is_found,
            "--objects {}: not in --labels; labels there: {}",
            objects.iter().map(ToString::to_string).collect::<Vec<_>>().join(","),
            if names.is_empty() { "none but 0".to_owned() } else { listed(names.iter().map(String::as_str)) }
        );
        Ok(())
    }

    /// The first depth image and the pose of the workspace, to draw over an image of that camera.
    pub fn first_view(&self, detection: &Detection) -> anyhow::Result<(View, Isometry3<f64>)> {
        let Self::Depth(views, workspace) = self else { bail!("--color needs depth images") };
        let workspace = found(workspace, detection)?;
        let view = views.first().context("no depth image")?;
        Ok((depth_view(view, 0, &workspace)?, workspace.pose))
    }

    /// Detects grasps in the observation.
    pub async fn detect(&self, client: &Client, options: Options) -> Result<Detection, Error> {
        match self {
            Self::Volume(volume) => client.detect(volume, options).await,
            Self::Depth(views, workspace) => client.detect_from_depth(views, workspace, options).await,
            Self::Clouds(views, workspace) => client.detect_from_cloud(views, workspace, options).await,
        }
    }

    /// Scores grasps in the observation.
    pub async fn score(&self, client: &Client, candidates: &[Candidate], options: Options) -> Result<Scores, Error> {
        let observation = match self {
            Self::Volume(volume) => Observation::Volume(volume),
            Self::Depth(views, workspace) => Observation::Depth(views, workspace),
            Self::Clouds(views, workspace) => Observation::Clouds(views, workspace),
        };
        client.score_candidates(observation, candidates, options).await
    }

    /// Pose of the workspace in the frame of the grasps (`T_frame_task`), and its lengths, metres.
    pub fn workspace(&self, detection: &Detection) -> anyhow::Result<(Isometry3<f64>, Vector3<f64>)> {
        let workspace = match self {
            Self::Volume(volume) => {
                return Ok((*volume.pose(), Vector3::repeat(volume.voxel_size() * volume.resolution() as f64)));
            }
            Self::Depth(_, workspace) | Self::Clouds(_, workspace) => found(workspace, detection)?,
        };
        let [x, y] = workspace.extent.unwrap_or([WORKSPACE_SIZE; 2]);
        Ok((workspace.pose, Vector3::new(x, y, WORKSPACE_SIZE)))
    }

    /// About `most` of the points that the cameras measured, in the frame of the grasps, with depths corrected as in
    /// the server; `None` for a volume.
    pub fn points(&self, detection: &Detection, most: usize) -> anyhow::Result<Option<Vec<Point3<f64>>>> {
        let mut points = Vec::new();
        match self {
            Self::Volume(_) => return Ok(None),
            Self::Depth(views, workspace) => {
                let workspace = found(workspace, detection)?;
                let pixels: usize = views.iter().map(|view| view.width as usize * view.height as usize).sum();
                let every = (pixels as f64 / most as f64).sqrt().ceil().max(1.0) as usize;
                for (index, view) in views.iter().enumerate() {
                    let mut view = depth_view(view, index, &workspace)?;
                    view.image.scale(depth_factor(detection, index));
                    let frame_from_camera = workspace.pose * view.camera_from_task.inverse();
                    let Intrinsics { width, height, .. } = view.intrinsics();
                    let rows = (0..height).step_by(every);
                    let pixels = rows.flat_map(|v| (0..width).step_by(every).map(move |u| (u, v)));
                    points.extend(pixels.filter_map(|(u, v)| Some(frame_from_camera * view.image.point(u, v)?)));
                }
            }
            Self::Clouds(views, _) => {
                let every = views.iter().map(|view| view.points.len()).sum::<usize>().div_ceil(most).max(1);
                for (index, view) in views.iter().enumerate() {
                    let mut cloud = cloud_view(view, index)?;
                    cloud.scale(depth_factor(detection, index));
                    points.extend(cloud.points.into_iter().step_by(every));
                }
            }
        }
        Ok(Some(points))
    }

    /// The volume to draw: the given one, or the fused images or points, with depths corrected as in the server.
    pub fn volume(&self, detection: &Detection) -> anyhow::Result<Volume> {
        let (views, workspace) = match self {
            Self::Volume(volume) => return Ok((**volume).clone()),
            Self::Depth(views, workspace) => {
                let workspace = found(workspace, detection)?;
                let views = views.iter().enumerate().map(|(index, view)| {
                    let mut view = depth_view(view, index, &workspace)?;
                    view.image.scale(depth_factor(detection, index));
                    anyhow::Ok(view)
                });
                (views.collect::<anyhow::Result<Vec<_>>>()?, workspace)
            }
            Self::Clouds(views, workspace) => {
                let workspace = found(workspace, detection)?;
                let views = views
                    .iter()
                    .enumerate()
                    .map(|(index, view)| rendered_view(view, index, &workspace, depth_factor(detection, index)));
                (views.collect::<anyhow::Result<Vec<_>>>()?, workspace)
            }
        };
        let [x, y] = workspace.extent.unwrap_or_default();
        let size = x.max(y).max(WORKSPACE_SIZE);
        let resolution = (size / WORKSPACE_SIZE * RESOLUTION as f64).ceil() as usize;
        let mut fusion = Fusion::new(resolution.min(Volume::MAX_RESOLUTION), size);
        for view in views {
            fusion.integrate(&view.image, &view.camera_from_task);
        }
        Ok(fusion.volume(workspace.pose)?)
    }
}

/// The workspace, with the pose and the extent that the server found if it searched for the table.
fn found(workspace: &Workspace, detection: &Detection) -> anyhow::Result<Workspace> {
    let table = detection.table.as_ref();
    let found = table.and_then(|table| table.workspace.as_ref());
    let extent = table.and_then(|table| table.extent).map(|extent| [extent.x, extent.y]);
    let pose = found.map(|pose| grasp_proto::pose(pose, "table.workspace")).transpose()?;
    Ok(Workspace { pose: pose.unwrap_or(workspace.pose), extent: workspace.extent.or(extent), ..*workspace })
}

/// Factor by which the server multiplied the depths of a view.
fn depth_factor(detection: &Detection, index: usize) -> f64 {
    detection.depth_factors.get(index).copied().unwrap_or(1.0)
}

/// Depth view `index` as the server reads it, with the same checks and errors.
pub(crate) fn depth_view(view: &DepthView, index: usize, workspace: &Workspace) -> anyhow::Result<View> {
    let frame = grasp_proto::frame(&view.into()).and_then(|frame| frame.in_task(&workspace.pose));
    Ok(frame.map_err(|error| error.inside(format_args!("views[{index}]")))?)
}

/// Cloud `index` in the frame of the grasps, as the server reads it.
fn cloud_view(view: &CloudView, index: usize) -> anyhow::Result<Cloud> {
    Ok(grasp_proto::cloud(&view.into()).map_err(|error| error.inside(format_args!("views[{index}]")))?)
}

/// Renders cloud `index`, whose distances from its camera are multiplied by `factor`, to a depth image.
fn rendered_view(view: &CloudView, index: usize, workspace: &Workspace, factor: f64) -> anyhow::Result<View> {
    let mut cloud = cloud_view(view, index)?.in_task(&workspace.pose);
    cloud.scale(factor);
    let seen = match workspace.extent {
        // As the server does.
        None => seen_from(&cloud.points, &cloud.eye, WORKSPACE_SIZE),
        // The server renders each of its cubes. The bounding sphere of all of them may contain the camera, and
        // `seen_from` then has no image.
        Some(_) => overview(&cloud.points, &cloud.eye),
    };
    seen.context("a camera sees no point of its cloud; check --camera-position and the poses")
}

#[cfg(test)]
mod tests {
    use grasp_client::pb;

    use super::*;

    /// Factor by which the distances that the cameras measure must be multiplied.
    const FACTOR: f64 = 1.02;

    /// Height of the camera and of the table below it, metres.
    const HEIGHTS: [f64; 2] = [0.65, 0.05];

    /// Mean height of the surface that is drawn after a reply with these factors, metres.
    fn drawn(scene: &Scene, depth_factors: &[f64]) -> f64 {
        let response = pb::DetectGraspsResponse { depth_factors: depth_factors.to_vec(), ..Default::default() };
        let detection = Detection::try_from(response).unwrap();
        let surface = scene.volume(&detection).unwrap().surface();
        surface.iter().map(|point| point.position.z).sum::<f64>() / surface.len() as f64
    }

    /// What a camera that looks straight down at the middle of the workspace measures.
    fn image() -> DepthView {
        let [eye, table] = HEIGHTS;
        let turned = Vector3::new(std::f64::consts::PI, 0.0, 0.0);
        DepthView {
            depth: Depth::Metres(vec![((eye - table) / FACTOR) as f32; 64 * 64]),
            width: 64,
            height: 64,
            k: [100.0, 0.0, 31.5, 0.0, 100.0, 31.5, 0.0, 0.0, 1.0],
            extrinsics: Extrinsics::CameraFromTask(Isometry3::new(Vector3::new(-0.15, 0.15, eye), turned)),
            labels: None,
        }
    }

    #[test]
    fn depth_images_are_drawn_with_corrected_depths() {
        let [_, table] = HEIGHTS;
        let scene = Scene::Depth(vec![image()], Workspace::default());
        let (corrected, uncorrected) = (drawn(&scene, &[FACTOR]), drawn(&scene, &[]));
        assert!((corrected - table).abs() < 2e-3 && uncorrected > table + 8e-3, "{corrected} m, {uncorrected} m");
    }

    #[test]
    fn a_transposed_intrinsic_matrix_is_refused_as_by_the_server() {
        let transposed = DepthView { k: [100.0, 0.0, 0.0, 0.0, 100.0, 0.0, 31.5, 31.5, 1.0], ..image() };
        let error = depth_view(&transposed, 0, &Workspace::default()).unwrap_err().to_string();
        assert!(error.starts_with("views[0].camera.k is") && error.ends_with("not transposed"), "{error}");
    }

    #[test]
    fn the_clouds_of_a_large_workspace_are_drawn_with_corrected_depths() {
        let [height, table] = HEIGHTS;
        // Inside the bounding sphere of the cube that contains the workspace.
        let eye = Point3::new(0.45, 0.3, height);
        let point = |index: usize| -> [f32; 3] {
            let at = Point3::new((index / 120) as f64 * 0.005, (index % 120) as f64 * 0.005, table);
            (eye + (at - eye) / FACTOR).coords.cast::<f32>().into()
        };
        let view = CloudView {
            points: (0..180 * 120).map(point).collect(),
            frame_from_cloud: Isometry3::identity(),
            camera_position: eye.coords.into(),
            labels: None,
        };
        let workspace = Workspace { extent: Some([0.9, 0.6]), ..Workspace::default() };
        let scene = Scene::Clouds(vec![view], workspace);
        let (corrected, uncorrected) = (drawn(&scene, &[FACTOR]), drawn(&scene, &[]));
        assert!((corrected - table).abs() < 2e-3 && uncorrected > table + 8e-3, "{corrected} m, {uncorrected} m");
    }
}
