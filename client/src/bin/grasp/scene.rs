use std::fs::File;
use std::io::{BufRead, BufReader, Seek};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::Args;
use grasp::{DepthImage, Fusion, Intrinsics, RESOLUTION, Volume, WORKSPACE_SIZE};
use grasp_client::{Client, Depth, DepthView, Detection, Error, Extrinsics, Options, Workspace};
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion};
use npyz::{NpyFile, TypeChar};
use serde_json::Value;

use crate::volume;

/// What is looked at: a volume, or depth images with their cameras.
#[derive(Args, Clone)]
pub(crate) struct SceneArgs {
    /// A volume: a .npy file, or a .npz file with one array or one called `grid`, N×N×N values in [0, 1] (u8: 0 to 255),
    /// indexed x, y, z, 0.5 on the surface and 0 where nothing was observed. Or, with --intrinsics, depth images: PNG with
    /// 16 bits or .npy with u16, both in millimetres, or .npy with f32, in metres; 0 and NaN are no reading.
    #[arg(required = true)]
    files: Vec<PathBuf>,

    /// Edge of a voxel of the volume, metres. By default that of a cube of 0.3 m.
    #[arg(long, value_name = "METRES", conflicts_with = "intrinsics")]
    voxel_size: Option<f64>,

    /// The cameras' intrinsic matrix: .npy with 3×3 numbers, or JSON with the nine numbers of `k`, as ROS's CameraInfo has
    /// them.
    #[arg(long, value_name = "FILE")]
    intrinsics: Option<PathBuf>,

    /// T_camera_task of each image: .npy with 4×4 or N×4×4 numbers, or JSON with such matrices, or with poses as
    /// {"position": [x, y, z], "orientation": [x, y, z, w]}.
    #[arg(long, value_name = "FILE", requires = "intrinsics", conflicts_with = "frame_from_camera")]
    camera_from_task: Option<PathBuf>,

    /// T_frame_camera of each image instead, as hand-eye calibration gives it.
    #[arg(long, value_name = "FILE", requires = "intrinsics")]
    frame_from_camera: Option<PathBuf>,

    /// T_frame_task: where the workspace's corner is, one pose in such a file. By default the frame's origin.
    #[arg(long, value_name = "FILE")]
    workspace: Option<PathBuf>,

    /// The frame in which the grasps will be; only a name.
    #[arg(long, default_value = "", hide_default_value = true)]
    frame_id: String,
}

/// What was read.
#[derive(Clone)]
pub(crate) enum Scene {
    Volume(Box<Volume>),
    Depth(Vec<DepthView>, Workspace),
}

impl SceneArgs {
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    pub fn frame_id(&self) -> String {
        self.frame_id.clone()
    }

    pub fn read(&self) -> anyhow::Result<Scene> {
        let pose = match &self.workspace {
            Some(path) => match in_file(path, poses)?[..] {
                [pose] => pose,
                ref poses => bail!("{}: holds {} poses, one is needed", path.display(), poses.len()),
            },
            None => Isometry3::identity(),
        };
        let Some(intrinsics) = &self.intrinsics else {
            let [file] = &self.files[..] else {
                bail!("several files need --intrinsics: they are depth images, a volume is one file")
            };
            return Ok(Scene::Volume(Box::new(volume::read(file, self.voxel_size, pose)?)));
        };
        let k = in_file(intrinsics, matrix_k)?;
        let (path, direction): (_, fn(Isometry3<f64>) -> Extrinsics) =
            match (&self.camera_from_task, &self.frame_from_camera) {
                (Some(path), _) => (path, Extrinsics::CameraFromTask),
                (None, Some(path)) => (path, Extrinsics::FrameFromCamera),
                (None, None) => bail!("depth images need --camera-from-task or --frame-from-camera"),
            };
        let poses = in_file(path, poses)?;
        ensure!(
            poses.len() == self.files.len(),
            "{}: holds {} poses for {} images",
            path.display(),
            poses.len(),
            self.files.len()
        );
        let view = |(file, pose): (&PathBuf, Isometry3<f64>)| {
            let (depth, width, height) = in_file(file, image)?;
            Ok(DepthView { depth, width, height, k, extrinsics: direction(pose) })
        };
        let views = self.files.iter().zip(poses).map(view).collect::<anyhow::Result<_>>()?;
        Ok(Scene::Depth(views, Workspace { pose, size: None }))
    }
}

impl Scene {
    /// Asks for the grasps in it.
    pub async fn detect(&self, client: &Client, options: Options) -> Result<Detection, Error> {
        match self {
            Self::Volume(volume) => client.detect(volume, options).await,
            Self::Depth(views, workspace) => client.detect_from_depth(views, workspace, options).await,
        }
    }

    /// The volume that it is, or that its images make, to look at.
    pub fn volume(&self) -> anyhow::Result<Volume> {
        let (views, workspace) = match self {
            Self::Volume(volume) => return Ok((**volume).clone()),
            Self::Depth(views, workspace) => (views, workspace),
        };
        let mut fusion = Fusion::new(RESOLUTION, WORKSPACE_SIZE);
        for view in views {
            let depth = match &view.depth {
                Depth::Metres(depth) => depth.clone(),
                Depth::Millimetres(depth) => depth.iter().map(|&depth| f32::from(depth) * 1e-3).collect(),
            };
            let [fx, _, cx, _, fy, cy, ..] = view.k;
            let (width, height) = (view.width as usize, view.height as usize);
            let image = DepthImage::new(Intrinsics { width, height, fx, fy, cx, cy }, &depth)?;
            let camera_from_task = match view.extrinsics {
                Extrinsics::CameraFromTask(pose) => pose,
                Extrinsics::FrameFromCamera(pose) => pose.inverse() * workspace.pose,
            };
            fusion.integrate(&image, &camera_from_task);
        }
        Ok(fusion.volume(workspace.pose)?)
    }
}

/// Says which file it was, if it is not what it must be.
fn in_file<T>(path: &Path, read: impl FnOnce(&Path) -> anyhow::Result<T>) -> anyhow::Result<T> {
    read(path).with_context(|| path.display().to_string())
}

/// A depth image, its width and its height.
fn image(path: &Path) -> anyhow::Result<(Depth, u32, u32)> {
    let file = BufReader::new(File::open(path)?);
    if path.extension().is_some_and(|extension| extension == "png") {
        return png_image(file);
    }
    let array = NpyFile::new(file)?;
    let &[height, width] = array.shape() else { bail!("its shape is {:?}, height × width is needed", array.shape()) };
    let dtype = array.dtype();
    let npyz::DType::Plain(plain) = &dtype else { bail!("its dtype is {dtype:?}, f32 or u16 is needed") };
    let depth = match (plain.type_char(), plain.size_field()) {
        (TypeChar::Float, 4) => Depth::Metres(array.into_vec()?),
        (TypeChar::Float, 8) => Depth::Metres(array.into_vec::<f64>()?.into_iter().map(|depth| depth as f32).collect()),
        (TypeChar::Uint, 2) => Depth::Millimetres(array.into_vec()?),
        _ => bail!("its dtype is {plain}, f32 (metres) or u16 (millimetres) is needed"),
    };
    Ok((depth, u32::try_from(width)?, u32::try_from(height)?))
}

fn png_image(file: impl BufRead + Seek) -> anyhow::Result<(Depth, u32, u32)> {
    let mut reader = png::Decoder::new(file).read_info()?;
    let png::Info { width, height, bit_depth, color_type, .. } = *reader.info();
    ensure!(
        (color_type, bit_depth) == (png::ColorType::Grayscale, png::BitDepth::Sixteen),
        "is {color_type:?} with {bit_depth:?} bits, a depth image is Grayscale with Sixteen"
    );
    let mut bytes = vec![0; reader.output_buffer_size().context("is too large")?];
    reader.next_frame(&mut bytes)?;
    let millimetres = bytes.as_chunks().0.iter().map(|&bytes| u16::from_be_bytes(bytes)).collect();
    Ok((Depth::Millimetres(millimetres), width, height))
}

/// The numbers of a .npy file of any floating type.
fn numbers(path: &Path) -> anyhow::Result<Vec<f64>> {
    let array = NpyFile::new(BufReader::new(File::open(path)?))?;
    let dtype = array.dtype();
    let npyz::DType::Plain(plain) = &dtype else { bail!("its dtype is {dtype:?}, f64 or f32 is needed") };
    Ok(match (plain.type_char(), plain.size_field()) {
        (TypeChar::Float, 8) => array.into_vec()?,
        (TypeChar::Float, 4) => array.into_vec::<f32>()?.into_iter().map(f64::from).collect(),
        _ => bail!("its dtype is {plain}, f64 or f32 is needed"),
    })
}

fn is_npy(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "npy")
}

fn json(path: &Path) -> anyhow::Result<Value> {
    Ok(serde_json::from_reader(BufReader::new(File::open(path)?))?)
}

/// Every number in it, in their order.
fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Number(number) => number.as_f64().into_iter().collect(),
        Value::Array(values) => values.iter().flat_map(flat).collect(),
        _ => Vec::new(),
    }
}

fn matrix_k(path: &Path) -> anyhow::Result<[f64; 9]> {
    let numbers = if is_npy(path) {
        numbers(path)?
    } else {
        let value = json(path)?;
        let k = ["k", "K"].iter().find_map(|key| value.get(key)).unwrap_or(&value);
        flat(k)
    };
    let count = numbers.len();
    numbers.try_into().ok().with_context(|| format!("holds {count} numbers, nine are needed, row by row"))
}

/// One or more poses.
fn poses(path: &Path) -> anyhow::Result<Vec<Isometry3<f64>>> {
    if is_npy(path) {
        return matrices(&numbers(path)?);
    }
    match json(path)? {
        value @ Value::Object(_) => Ok(vec![named(&value)?]),
        Value::Array(values) if values.iter().all(Value::is_object) => values.iter().map(named).collect(),
        value => matrices(&flat(&value)),
    }
}

fn named(value: &Value) -> anyhow::Result<Isometry3<f64>> {
    let part = |key: &str| value.get(key).map(flat).unwrap_or_default();
    let (position, orientation) = (part("position"), part("orientation"));
    let (&[x, y, z], &[qx, qy, qz, qw]) = (&position[..], &orientation[..]) else {
        bail!("a pose needs `position` with three numbers and `orientation` with four: x, y, z, w")
    };
    let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6);
    let rotation = rotation.context("an orientation is a quaternion of unit length")?;
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

fn matrices(numbers: &[f64]) -> anyhow::Result<Vec<Isometry3<f64>>> {
    ensure!(
        !numbers.is_empty() && numbers.len().is_multiple_of(16),
        "holds {} numbers, 4×4 for each pose are needed",
        numbers.len()
    );
    let pose = |numbers: &[f64]| {
        let matrix = Matrix4::from_row_slice(numbers);
        let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let orthonormal = (rotation * rotation.transpose() - Matrix3::identity()).norm() < 1e-3;
        ensure!(
            orthonormal && rotation.determinant() > 0.0 && numbers[12..] == [0.0, 0.0, 0.0, 1.0],
            "a matrix is no pose: its upper left must be a rotation, its last row 0 0 0 1"
        );
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Ok(Isometry3::from_parts(Translation3::new(numbers[3], numbers[7], numbers[11]), rotation))
    };
    numbers.chunks(16).map(pose).collect()
}
