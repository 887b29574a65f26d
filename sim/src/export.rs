//! Scenes and trials as JSON lines, so that another simulator can replay them.
//!
//! A line a scene: `scene`, its number; `objects`, each `object` (its name), `scale` and `pose`; `trials`, each `pose`,
//! `label`, `width`, `object` (an index into the objects: whose surface the point was drawn from), and of the yaws that
//! were tried `yaws`, what came of each, and `yaw`, which of them `pose` has. Yaw k is k · 36° about the grasp's z. A pose
//! is `[x, y, z, qx, qy, qz, qw]` in the task frame, metres.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::label::{LabelledScene, YAWS};

/// A scene with its trials.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Its number.
    pub scene: u64,
    /// What stands in it.
    pub objects: Vec<Object>,
    /// The grasp points.
    pub trials: Vec<Trial>,
}

/// An object of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// Its name, as in its set or its folder; `grasp-sim objects` writes our own sets as files.
    pub object: String,
    /// The factor its mesh was scaled by.
    pub scale: f64,
    /// `T_task_object`.
    pub pose: [f64; 7],
}

/// A grasp point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// `T_task_grasp` of the yaw to learn.
    pub pose: [f64; 7],
    /// 1 if any yaw lifted an object.
    pub label: u8,
    /// Opening after the lift, metres; the greatest for a failure.
    pub width: f64,
    /// The object whose surface the point was drawn from.
    pub object: Option<usize>,
    /// Which yaw `pose` has.
    pub yaw: usize,
    /// What came of each yaw.
    pub yaws: [u8; YAWS],
}

impl Line {
    /// What there is to say of a scene.
    #[must_use]
    pub fn of(number: u64, scene: &LabelledScene) -> Self {
        let objects = scene.objects.iter();
        let points = scene.points.iter();
        Self {
            scene: number,
            objects: objects
                .map(|placed| Object { object: placed.name.clone(), scale: placed.scale, pose: numbers(&placed.pose) })
                .collect(),
            trials: points
                .map(|point| Trial {
                    pose: numbers(&point.grasp.pose),
                    label: u8::from(point.success()),
                    width: point.grasp.width,
                    object: point.object,
                    yaw: point.yaw,
                    yaws: point.lifted.map(u8::from),
                })
                .collect(),
        }
    }
}

fn numbers(pose: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
}

/// Appends scenes to a file.
pub struct Export {
    path: PathBuf,
    file: File,
}

impl Export {
    /// Opens a file, new or left by an earlier run; scenes from number `next` on are dropped, to be written again.
    ///
    /// # Errors
    /// When the file cannot be read or written.
    pub fn open(path: &Path, next: u64) -> anyhow::Result<Self> {
        let file = open(path, next).with_context(|| path.display().to_string())?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Appends a scene.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&mut self, line: &Line) -> anyhow::Result<()> {
        let text = serde_json::to_string(line)? + "\n";
        self.file.write_all(text.as_bytes()).with_context(|| self.path.display().to_string())
    }
}

fn open(path: &Path, next: u64) -> io::Result<File> {
    #[derive(Deserialize)]
    struct Number {
        scene: u64,
    }
    let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
    let mut reader = BufReader::new(&file);
    let (mut kept, mut line) = (0, String::new());
    while reader.read_line(&mut line)? > 0 {
        let number = serde_json::from_str::<Number>(&line).ok().filter(|_| line.ends_with('\n'));
        if number.is_none_or(|number| number.scene >= next) {
            break;
        }
        kept += line.len() as u64;
        line.clear();
    }
    file.set_len(kept)?;
    file.seek(SeekFrom::End(0))?;
    Ok(file)
}

/// Reads the scenes of a file.
///
/// # Errors
/// Names the file and the line that cannot be read.
pub fn read(path: &Path) -> anyhow::Result<Vec<Line>> {
    let file = File::open(path).with_context(|| path.display().to_string())?;
    let lines = BufReader::new(file).lines().enumerate();
    lines
        .map(|(index, line)| {
            let context = || format!("{}, line {}", path.display(), index + 1);
            serde_json::from_str(&line.with_context(context)?).with_context(context)
        })
        .collect()
}
